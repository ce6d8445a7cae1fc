"""Text from files made harmless for terminals and documents: no control characters, no markup, no missing symbols."""

from __future__ import annotations

import codecs
import re
import unicodedata
from typing import Any

ENCODING_ERRORS = "servotrack-plain"
"""Name of the error handler that writes the closest ASCII text for symbols that a terminal's encoding lacks."""

_CLOSEST = {
    "†": "+", "×": "x", "−": "-", "–": "-", "—": "-", "·": ".", "µ": "u", "μ": "u", "±": "+-", "≥": ">=", "≤": "<=",
    "≈": "~", "…": "...", "°": "deg", "→": "->", "‘": "'", "’": "'", "“": '"', "”": '"',
    "━": "-", "╸": "-", "╺": "-", "─": "-", "│": "|", "•": "*", "ß": "ss",
}  # fmt: skip
_LAYOUT = "\n\t"
_OF_ENTITY = re.compile(r"&(?=#?\w+;)")
_OF_TAG = re.compile(r"<(?=[A-Za-z/!?])")
_OF_MARKDOWN = re.compile(r"([\\`*_\[\]|])")


def printable(text: str) -> str:
    """Return text without control characters: those that move a cursor or turn the writing direction become escapes."""
    return text if text.isprintable() else "".join(_escaped(c) if _controls(c) else c for c in text)


def _controls(character: str) -> bool:
    return character not in _LAYOUT and unicodedata.category(character) in ("Cc", "Cf", "Cs")


def encodable(text: str, encoding: str) -> str:
    """Return text in which symbols that an encoding lacks are replaced by the closest ASCII text.

    Args:
        text: Any text.
        encoding: Name of a codec, such as "cp1252".
    """
    return text if text.isascii() else text.encode(encoding, ENCODING_ERRORS).decode(encoding)


def markdown_text(text: str) -> str:
    """Return text that Markdown shows as it is, also inside a table: no HTML, links, emphasis, code or columns."""
    line = printable(text).replace("\n", " ").replace("\t", " ")
    return markdown_cell(_OF_MARKDOWN.sub(r"\\\1", line))


def markdown_cell(text: str) -> str:
    """Return Markdown for one cell of a table: HTML and column separators are escaped, other markup is kept."""
    text = _OF_TAG.sub("&lt;", _OF_ENTITY.sub("&amp;", text)).replace("\n", " ")
    return re.sub(r"(?<!\\)\|", r"\\|", text)


def markdown_code(text: str) -> str:
    """Return text as a code span of Markdown, whatever backticks it contains."""
    line = printable(text).replace("\n", " ")
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", line)), default=0))
    space = " " if line.startswith("`") or line.endswith("`") else ""
    return f"{fence}{space}{line}{space}{fence}"


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def _closest(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    missing = error.object[error.start : error.end]
    return "".join(_CLOSEST.get(c) or _ascii_part(c) for c in missing), error.end


def _ascii_part(character: str) -> str:
    """Return the ASCII part of a character's decomposition, "?" where it has none."""
    decomposed: Any = unicodedata.normalize("NFKD", character)
    return decomposed.encode("ascii", "ignore").decode("ascii") or "?"


codecs.register_error(ENCODING_ERRORS, _closest)
