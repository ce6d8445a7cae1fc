"""Pages of environments are up to date, links lead somewhere, prose is plain, and every page is in the navigation."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from servotrack.envs.registration import ENVIRONMENTS

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
WRITTEN = [path for path in DOCUMENTS if "environments" not in path.parts and path.name != "README.md"]
PERSON = re.compile(r"\b(told|asked|nobody|whoever|whom|somebody|everybody|anybody)\b", re.IGNORECASE)


def test_generated_pages_are_up_to_date() -> None:
    run = subprocess.run(
        [sys.executable, str(ROOT / "docs" / "generate.py"), "--check"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, f"run scripts/docs and commit what it wrote:\n{run.stdout}{run.stderr}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_relative_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", document.read_text(encoding="utf-8")):
        if not re.match(r"[a-z]+:", target):
            assert (document.parent / target).exists(), f"{document.name} links to {target}, which does not exist"


def test_every_package_of_estimators_has_an_api_page() -> None:
    shown = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md"))
    packages = [path.parent.name for path in (ROOT / "estimators").glob("*/__init__.py")]
    missing = [name for name in packages if f"::: servotrack.estimators.{name}\n" not in shown]
    assert not missing, f"add a page in docs/api, and mkdocs.yml's nav: {', '.join(missing)}"


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_every_environment_has_a_small_animation(env_id: str) -> None:
    animation = ROOT / "docs" / "images" / "environments" / f"{env_id}.webp"
    assert animation.is_file(), "run scripts/docs --pictures"
    assert animation.stat().st_size < 400_000


@pytest.mark.parametrize("document", WRITTEN, ids=lambda path: str(path.relative_to(ROOT)))
def test_prose_is_plain(document: Path) -> None:
    text = re.sub(r"<!-- (\w+):begin -->.*?<!-- \1:end -->", "", document.read_text(encoding="utf-8"), flags=re.DOTALL)
    text = re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.DOTALL)
    found = sorted({word.lower() for word in PERSON.findall(text)})
    assert not found, f"{', '.join(found)}: write known, given, passed, computed, no agent, the caller"


def test_the_navigation_has_every_page_once() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    listed = re.findall(r"([\w/.-]+\.md)$", text, re.MULTILINE)
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted([*pages, "changelog.md", "contributing.md"])
