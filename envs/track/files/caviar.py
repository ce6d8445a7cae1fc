"""CAVIAR's truth, CVML: an XML file of frames, objects and boxes, as some other sequences' truth has it, too."""

from __future__ import annotations

import math
from pathlib import Path
from xml.sax import SAXException
from xml.sax.handler import ContentHandler
from xml.sax.xmlreader import AttributesImpl, Locator

import defusedxml
import defusedxml.sax

from servotrack.envs.track.files.recorded import RecordedTracks, SequenceError, TrackRows, check_file

_BOX = ("dataset", "frame", "objectlist", "object", "box")
_OBJECT, _FRAME = _BOX[:-1], _BOX[:-3]
_MAX_DEPTH = 64


def read_caviar(path: str | Path) -> RecordedTracks:
    """Tracks out of a CVML file; groups, orientations and hypotheses about behavior are passed over.

    Args:
        path: `<dataset>` of `<frame number>`, `<objectlist>`, `<object id>`, `<box xc yc w h>`, center and size in px;
            frames count from 0. Entities are refused, so that a file cannot grow while it is read.

    Raises:
        SequenceError: Missing, not XML, of another schema, or with a bad value.

    References:
        List and Fisher, "CVML - an XML-based computer vision markup language", ICPR 2004.
    """
    file = check_file(Path(path))
    handler = _Handler(file)
    try:
        with file.open("rb") as stream:
            defusedxml.sax.parse(stream, handler)
    except defusedxml.DefusedXmlException as error:
        raise SequenceError(
            f"{file}, line {handler.line}: entities are refused in a file of truth ({error}); remove them"
        ) from error
    except SAXException as error:
        raise SequenceError(f"{file}, line {handler.line}: this is no well-formed XML ({_reason(error)})") from error
    except OSError as error:
        raise SequenceError(f"{file} cannot be read ({error.strerror}); check its permissions") from error
    # Expat looks encodings up among Python's codecs, which may fail in ways of their own.
    except (LookupError, UnicodeError) as error:
        raise SequenceError(f"{file}, line {handler.line}: the encoding cannot be read ({error})") from error
    return handler.rows.finish()


class _Handler(ContentHandler):
    """Follows the elements, and takes boxes in where the schema has them."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.rows = TrackRows(path)
        self._place: list[str] = []
        self._locator: Locator | None = None
        self._frame = self._identity = 0
        self._boxes = 0

    @property
    def line(self) -> int:
        """Where the parser is."""
        number = None if self._locator is None else self._locator.getLineNumber()
        return number or 1

    def setDocumentLocator(self, locator: Locator) -> None:
        """Keep what tells the line."""
        self._locator = locator

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        """One more element opens."""
        if not self._place and name != _BOX[0]:
            raise self.rows.fail(
                self.line, f"the outermost element must be <dataset>, as in CAVIAR's CVML, got <{name[:40]}>"
            )
        self._place.append(name)
        if len(self._place) > _MAX_DEPTH:
            raise self.rows.fail(self.line, f"elements must not be nested deeper than {_MAX_DEPTH}")
        place = tuple(self._place)
        if place == _FRAME:
            self._frame = self._whole(attrs, "number")
        elif place == _OBJECT:
            self._identity, self._boxes = self._whole(attrs, "id"), 0
        elif place == _BOX:
            self._boxes += 1
            xc, yc, width, height = (self._number(attrs, key) for key in ("xc", "yc", "w", "h"))
            box = (xc - width / 2.0, yc - height / 2.0, width, height)
            self.rows.add(self.line, self._frame, self._identity, box, 1.0)

    def endElement(self, name: str) -> None:
        """The innermost element closes."""
        if tuple(self._place) == _OBJECT and self._boxes != 1:
            raise self.rows.fail(self.line, f"<object> must hold one <box xc yc w h>, got {self._boxes}")
        self._place.pop()

    def _number(self, attrs: AttributesImpl, key: str) -> float:
        text = attrs.get(key)
        if text is None:
            raise self.rows.fail(self.line, f"<{self._place[-1]}> must have the attribute {key!r}")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.rows.fail(self.line, f"{key} must be a finite number, got {text[:40]!r}")
        return value

    def _whole(self, attrs: AttributesImpl, key: str) -> int:
        value = self._number(attrs, key)
        if not value.is_integer():
            raise self.rows.fail(self.line, f"{key} must be a whole number, got {value:g}")
        return int(value)


def _reason(error: SAXException) -> str:
    return " ".join(error.getMessage().split())[:120]
