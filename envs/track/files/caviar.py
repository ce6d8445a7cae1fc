"""Reader of CAVIAR's CVML: ground truth as an XML file of frames, objects and boxes. Other data sets use it, too."""

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
    """Read the tracks of a CVML file. Groups, orientations and behavior hypotheses are skipped.

    Args:
        path: XML file with `<dataset>`, `<frame number>`, `<objectlist>`, `<object id>` and `<box xc yc w h>`: center
            and size in px. Frames are counted from 0. Entities are not allowed, because they can expand to any size.

    Returns:
        Tracks of all identities.

    Raises:
        SequenceError: If the file is missing, is not XML, has another schema or contains an invalid value.

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
            f"{file}, line {handler.line}: entities are not allowed in ground-truth files ({error}); remove them"
        ) from error
    except SAXException as error:
        raise SequenceError(f"{file}, line {handler.line}: not well-formed XML ({_reason(error)})") from error
    except OSError as error:
        raise SequenceError(f"{file} cannot be read ({error.strerror}); check its permissions") from error
    # Expat looks encodings up among Python's codecs, which raise their own errors.
    except (LookupError, UnicodeError) as error:
        raise SequenceError(f"{file}, line {handler.line}: the encoding cannot be read ({error})") from error
    return handler.rows.finish()


class _Handler(ContentHandler):
    """Handler that follows the elements and collects the boxes at the places of the schema."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.rows = TrackRows(path)
        self._place: list[str] = []
        self._locator: Locator | None = None
        self._frame = self._identity = 0
        self._boxes = 0

    @property
    def line(self) -> int:
        """Line number of the parser."""
        number = None if self._locator is None else self._locator.getLineNumber()
        return number or 1

    def setDocumentLocator(self, locator: Locator) -> None:
        """Store the locator, which gives line numbers."""
        self._locator = locator

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        """Handle the start of an element."""
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
        """Handle the end of the innermost element."""
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
