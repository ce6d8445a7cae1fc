"""MkDocs hooks: formulas as MathML, pages from the checkout's root, and names for the theme's landmarks.

Formulas are TeX in the Markdown files. MathML needs no script and no font from another host.
"""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT_PAGES = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
"""Pages of the site that are files of the checkout's root."""

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)

_TEST_COMMENT = re.compile(r"^<!-- (?:(?:check|file): .*?|run) -->\n", re.DOTALL | re.MULTILINE)
_UNNAMED_DIALOG = '<div class="md-search" data-md-component="search" role="dialog">'
_NAVIGATION = re.compile(
    r'(<nav class="md-nav" data-md-level="\d+") aria-labelledby="[^"]*"(?: aria-expanded="\w+")?'
    r'(>\s*<label class="md-nav__title" for="[^"]*">\s*<span class="md-nav__icon md-icon"></span>\s*)'
    r"([^<]*?)(\s*</label>)"
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the checkout's root, their links rewritten for the site."""
    root = Path(config.config_file_path).parent
    for page, source in ROOT_PAGES.items():
        text = (root / source).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Leave out the comments that the tests read."""
    return _TEST_COMMENT.sub("", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Replace formulas by MathML."""
    return _FORMULA.sub(_mathml, html)


def on_post_template(output_content: str, **_: Any) -> str:
    """Name the landmarks of pages without a source, such as 404.html."""
    return on_post_page(output_content)


def on_post_page(output: str, **_: Any) -> str:
    """Name the theme's search dialog and its nested navigation for screen readers."""
    output = output.replace(_UNNAMED_DIALOG, _UNNAMED_DIALOG[:-1] + ' aria-label="Search">')
    return _NAVIGATION.sub(r'\1 aria-label="Pages: \3"\2\3\4', output)


def _mathml(match: re.Match[str]) -> str:
    display = "block" if match[2] == "[" else "inline"
    return convert(unescape(match[3]), display=display)
