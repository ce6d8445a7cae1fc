"""Reader of CAVIAR's CVML: ground truth as an XML file of frames, objects and boxes. Other data sets use it, too."""

from __future__ import annotations

import math
from pathlib import Path
from xml.sax import SAXException
from xml.sax.handler import ContentHandler
from xml.sax.xmlreader import AttributesImpl

import defusedxml
import defusedxml.expatreader

from servotrack.envs.track.files.bounded import parse_number, read_bounded
from servotrack.envs.track.files.recorded import RecordedTracks, SequenceError, TrackRows

MAX_XML = 1 << 29
"""Largest accepted size of a file, bytes."""
_MAX_TAG = 1 << 16
"""Length of a tag or comment that is always accepted, bytes. One of twice the length is refused: Expat reads a tag that
it has only in part again with every block, so that its time would grow with the square of the length."""
_BOX = ("dataset", "frame", "objectlist", "object", "box")
_OBJECT, _FRAME = _BOX[:-1], _BOX[:-3]
_MAX_DEPTH = 64


def read_caviar(path: str | Path) -> RecordedTracks:
    """Read the tracks of a CVML file. Groups, orientations and behavior hypotheses are skipped.

    Args:
        path: XML file with `<dataset>`, `<frame number>`, `<objectlist>`, `<object id>` and `<box xc yc w h>`: center
            and size in px. Frames are counted from 0. At most 512 MiB, and 5000 boxes in a frame. A document type (DTD)
            and entities are not allowed, because they can expand to any size.

    Returns:
        Tracks of all identities.

    Raises:
        SequenceError: If the file is missing, is too large, is not XML, has another schema or contains an invalid
            value.

    References:
        List and Fisher, "CVML - an XML-based computer vision markup language", ICPR 2004.
    """
    file = Path(path)
    handler = _Handler(file)
    content = memoryview(read_bounded(file, MAX_XML, "split the file"))
    try:
        for start in range(0, max(len(content), 1), _MAX_TAG):
            handler.feed(content[start : start + _MAX_TAG])
        handler.close()
    except SequenceError:
        raise
    except defusedxml.DefusedXmlException as error:
        raise handler.fail(
            "entities are not allowed in ground-truth files, nor a document type that could declare them; "
            "remove <!DOCTYPE ...>"
        ) from error
    except SAXException as error:
        raise handler.fail(f"not well-formed XML ({_reason(error)})") from error
    # Expat looks encodings up among Python's codecs, which raise their own errors.
    except (LookupError, ValueError) as error:
        raise handler.fail(f"the encoding cannot be read ({error}); convert the file to UTF-8") from error
    return handler.rows.finish()


class _Handler(ContentHandler):
    """Handler that follows the elements and collects the boxes at the places of the schema."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.rows = TrackRows(path)
        self._parser = defusedxml.expatreader.create_parser(forbid_dtd=True)
        self._parser.setContentHandler(self)
        self._place: list[str] = []
        self._frame = self._identity = 0
        self._boxes = 0
        self._moved = True

    def feed(self, block: memoryview) -> None:
        """Parse the next block of the file, of `_MAX_TAG` bytes, or less at the end."""
        began_inside_tag = not self._moved
        self._moved = False
        self._parser.feed(block)
        if began_inside_tag and not self._moved:
            raise self.fail(f"tags and comments must be shorter than {_MAX_TAG} bytes")

    def close(self) -> None:
        """Parse the end of the file."""
        self._parser.close()

    def fail(self, message: str) -> SequenceError:
        """Return the error to raise for the line that the parser is at."""
        return self.rows.fail(self._parser.getLineNumber() or 1, message)

    def characters(self, content: str) -> None:
        """Handle text between two tags."""
        self._moved = True

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        """Handle the start of an element."""
        self._moved = True
        if not self._place and name != _BOX[0]:
            raise self.fail(f"the outermost element must be <dataset>, as in CAVIAR's CVML, got <{name[:40]}>")
        self._place.append(name)
        if len(self._place) > _MAX_DEPTH:
            raise self.fail(f"elements must not be nested deeper than {_MAX_DEPTH}")
        place = tuple(self._place)
        if place == _FRAME:
            self._frame = self._whole(attrs, "number")
        elif place == _OBJECT:
            self._identity, self._boxes = self._whole(attrs, "id"), 0
        elif place == _BOX:
            self._boxes += 1
            xc, yc, width, height = (self._number(attrs, key) for key in ("xc", "yc", "w", "h"))
            box = (xc - width / 2.0, yc - height / 2.0, width, height)
            self.rows.add(self._parser.getLineNumber(), self._frame, self._identity, box, 1.0)

    def endElement(self, name: str) -> None:
        """Handle the end of the innermost element."""
        if tuple(self._place) == _OBJECT and self._boxes != 1:
            raise self.fail(f"<object> must hold one <box xc yc w h>, got {self._boxes}")
        self._place.pop()

    def _number(self, attrs: AttributesImpl, key: str) -> float:
        text = attrs.get(key)
        if text is None:
            raise self.fail(f"<{self._place[-1][:40]}> must have the attribute {key!r}")
        try:
            value = parse_number(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.fail(f"{key} must be a finite number, got {text[:40]!r}")
        return value

    def _whole(self, attrs: AttributesImpl, key: str) -> int:
        value = self._number(attrs, key)
        if not value.is_integer():
            raise self.fail(f"{key} must be a whole number, got {value:g}")
        return int(value)


def _reason(error: SAXException) -> str:
    return " ".join(error.getMessage().split())[:120]
