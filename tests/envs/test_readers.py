"""Readers of ground truth and detections: content, and errors that name file and line."""

import os
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hostile_files import CVML, GT, SEQINFO

from servotrack.envs.track.files import recorded
from servotrack.envs.track.files.bounded import read_bounded
from servotrack.envs.track.files.caviar import read_caviar
from servotrack.envs.track.files.frames import open_frames
from servotrack.envs.track.files.mot_files import mot_row, read_mot_detections, read_mot_tracks, read_seqinfo
from servotrack.envs.track.files.read import read_tracks
from servotrack.envs.track.files.recorded import SequenceError


def write(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def test_rows_with_flag_are_tracks_from_step_zero(tmp_path):
    found = read_mot_tracks(write(tmp_path, "gt.txt", GT))
    assert found.ids.tolist() == [2, 7]
    assert found.tracks[0].steps.tolist() == [0, 2]
    np.testing.assert_array_equal(found.tracks[0].states, [[10, 20, 30, 40], [12, 21, 30, 40]])
    np.testing.assert_array_equal(found.visibilities[0], [0.5, 0.25])
    assert found.length == 3


def test_people_of_a_frame(tmp_path):
    found = read_mot_tracks(write(tmp_path, "gt.txt", GT)).by_frame()
    assert list(found) == [0, 2]
    np.testing.assert_array_equal(found[0].ids, [2, 7])
    np.testing.assert_array_equal(found[0].boxes, [[10, 20, 30, 40], [0, 0, 5.5, 6]])
    np.testing.assert_array_equal(found[0].visibilities, [0.5, 1.0])
    np.testing.assert_array_equal(found[2].boxes, [[12, 21, 30, 40]])


def test_third_last_column_of_ten_is_a_coordinate_not_a_visibility(tmp_path):
    found = read_mot_tracks(write(tmp_path, "gt.txt", b"1,1,0,0,5,5,1,17.5,-23.5,0\n"))
    np.testing.assert_array_equal(found.visibilities[0], [1.0])


@pytest.mark.parametrize("content", [b"\xef\xbb\xbf1, 1, 0, 0, 5, 5, 1\r\n\r\n", b"1 1 0 0 5 5 1", b"1,1,0,0,5,5,1,\n"])
def test_spellings_of_a_row(tmp_path, content):
    assert read_mot_tracks(write(tmp_path, "gt.txt", content)).ids.tolist() == [1]


def test_empty_file_holds_no_tracks(tmp_path):
    assert read_mot_tracks(write(tmp_path, "gt.txt", b"")).length == 0


def test_written_rows_are_read_back(tmp_path):
    path = write(tmp_path, "tracks.txt", (mot_row(2, 5, [1.25, -2, 3, 4.5], 0.75)).encode())
    found = read_mot_tracks(path)
    assert found.ids.tolist() == [5] and found.tracks[0].steps.tolist() == [1]
    np.testing.assert_array_equal(found.tracks[0].states, [[1.25, -2, 3, 4.5]])
    assert path.read_text() == "2,5,1.25,-2.00,3.00,4.50,0.75,-1,-1,-1\n"


def test_detections_by_step_with_confidences(tmp_path):
    found = read_mot_detections(
        write(tmp_path, "det.txt", b"3,-1,1,2,3,4,0.5,-1,-1,-1\n1,-1,0,0,1,1\n3,-1,5,6,7,8,9\n")
    )
    assert list(found) == [0, 2]
    np.testing.assert_array_equal(found[2].confidences, [0.5, 9.0])
    np.testing.assert_array_equal(found[2].boxes[1], [5, 6, 7, 8])
    np.testing.assert_array_equal(found[0].confidences, [1.0])


BAD_ROWS = {
    b"1,1,0,0,5,5,1\n1,2,nan,0,5,5,1\n": "line 2: boxes must be finite",
    b"1,1,0,0,5,-5,1\n": "line 1: width and height must be at least 0, got 0, 0, 5, -5",
    b"1,1,0,0,1e30,5,1\n": "within 1e+06 px",
    b"0,1,0,0,5,5,1\n": "frame must be one of the first",
    b"99999999999,1,0,0,5,5,1\n": "frame must be one of the first",
    b"1.5,1,0,0,5,5,1\n": "frame must be a whole number, got 1.5",
    b"1,-1,0,0,5,5,1\n": "ids of tracks must be whole numbers of at least 0, got -1",
    b"1,1,0,0,5\n": "at least frame, id, left, top, width, height, got 5",
    b"1,1,a,0,5,5,1\n": "rows must contain numbers separated by commas, got '1,1,a",
    b"1,1,0,0,5,5,1\n2,1,0,0,5,5,1\n1,1,9,9,5,5,1\n": "line 3: id 1 is in this frame already, in line 1",
    b"1,1,0,0,5,5,1,1,1.5\n": "visibility must lie in",
    b"\x00\x01\x02\xff": "rows must contain numbers",
    b"x" * 5000: "lines must be shorter than 4096 bytes",
    b"1 1 0 0 5 5 1\r2 1 0 0 5 5 1\r": "rows must contain numbers separated by commas, got '1 1 0 0 5 5 1",
    b"1,1,0,0,1_0,5,1\n": "rows must contain numbers",
    "1,1,0,0,\u0665,5,1\n".encode(): "rows must contain numbers",
    "1,1,0,0,5,5,1\n".encode("utf-16"): "rows must contain numbers",
    b"1,1,0,0,5,5,1\n1,2,0,0,5,5," + b"9" * 400 + b"\n": "line 2: flag or confidence must be finite",
}


@pytest.mark.parametrize(("content", "message"), BAD_ROWS.items())
def test_bad_rows_name_file_and_line(tmp_path, content, message):
    with pytest.raises(SequenceError, match=r"gt\.txt, line \d+: ") as caught:
        read_mot_tracks(write(tmp_path, "gt.txt", content))
    assert message in str(caught.value)


def test_too_many_rows_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(recorded, "MAX_ROWS", 2)
    with pytest.raises(SequenceError, match="line 3: a file must hold at most 2 boxes"):
        read_mot_detections(write(tmp_path, "det.txt", b"1,-1,0,0,1,1,1\n" * 3))


@pytest.mark.parametrize("reader", [read_mot_tracks, read_mot_detections, read_caviar])
def test_frame_with_too_many_boxes_is_named(tmp_path, monkeypatch, reader):
    monkeypatch.setattr(recorded, "MAX_IN_FRAME", 2)
    rows = b"".join(b"%d,%d,0,0,1,1,1\n" % (frame, k) for frame, count in ((1, 2), (4, 3)) for k in range(count))
    boxes = b"".join(b'<object id="%d"><box xc="1" yc="1" w="1" h="1"/></object>' % k for k in range(3))
    xml = b'<dataset><frame number="3"><objectlist>' + boxes + b"</objectlist></frame></dataset>"
    path = write(tmp_path, "boxes", xml if reader is read_caviar else rows)
    with pytest.raises(SequenceError, match=r"boxes: frame 3 \(counted from 0\) holds 3 boxes, the limit is 2"):
        reader(path)


@pytest.mark.parametrize(("reader", "limit"), [(read_mot_tracks, 1 << 30), (read_mot_detections, 1 << 30),
                                               (read_caviar, 1 << 29), (read_seqinfo, 65536)])  # fmt: skip
def test_file_that_is_too_large_is_refused_before_it_is_read(tmp_path, reader, limit):
    path = write(tmp_path, "large", b"")
    with path.open("wb") as file:
        file.truncate(limit + 1)
    with pytest.raises(SequenceError, match=f"large has {limit + 1} bytes, the limit is {limit}; "):
        reader(path)


@pytest.mark.parametrize("reader", [read_mot_tracks, read_mot_detections, read_caviar, read_seqinfo])
def test_pipes_and_devices_are_refused_without_waiting(tmp_path, reader):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "endless").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to("loop")
    for name, message in (("pipe", "not a regular file"), ("endless", "not a regular file"), ("loop", "not exist")):
        with pytest.raises(SequenceError, match=f"{name}.*{message}"):
            reader(tmp_path / name)


def test_file_that_is_written_while_it_is_read_is_refused(tmp_path):
    path = write(tmp_path, "growing.txt", GT * 20_000)
    done = threading.Event()

    def append() -> None:
        with path.open("ab", buffering=0) as file:
            while not done.is_set():
                file.write(b"9,9,1,1,1,1,0\n")

    writer = threading.Thread(target=append)
    writer.start()
    try:
        with pytest.raises(SequenceError, match=r"growing\.txt changed while it was read"):
            for _ in range(1000):
                read_bounded(path, 1 << 30, "")
    finally:
        done.set()
        writer.join()


@pytest.fixture
def locked() -> Iterator[Path]:
    """A folder with files and a folder that may not be read, by a user without privileges."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        for file in ("gt.txt", "truth.xml", "v.avi", "images/1.png", "closed/gt.txt"):
            (folder / file).parent.mkdir(exist_ok=True)
            (folder / file).write_bytes(GT)
            (folder / file).chmod(0)
        (folder / "closed").chmod(0)
        before = os.geteuid()
        if before == 0:
            os.seteuid(65534)
        try:
            yield folder
        finally:
            os.seteuid(before)
            (folder / "closed").chmod(0o700)


@pytest.mark.parametrize(
    ("reader", "name"),
    [(reader, name) for reader in (read_tracks, open_frames) for name in ("gt.txt", "closed", "closed/gt.txt")]
    + [(read_tracks, "truth.xml"), (read_mot_detections, "gt.txt"), (open_frames, "v.avi"), (open_frames, "images")],
)
def test_what_may_not_be_read_is_named(locked, reader, name):
    with pytest.raises(SequenceError, match=rf"{locked / name}.*Permission denied"):
        reader(locked / name)


def test_missing_files_and_folders_are_named(tmp_path):
    with pytest.raises(SequenceError, match=r"nowhere\.txt does not exist"):
        read_tracks(tmp_path / "nowhere.txt")
    with pytest.raises(SequenceError, match=r"gt\.txt does not exist"):
        read_tracks(tmp_path)
    with pytest.raises(SequenceError, match="is a folder"):
        read_mot_detections(tmp_path)


def test_cvml_boxes_are_by_center_and_groups_do_not_count(tmp_path):
    found = read_tracks(write(tmp_path, "truth.XML", CVML))
    assert found.ids.tolist() == [0, 4]
    assert found.tracks[1].steps.tolist() == [0, 2]
    np.testing.assert_array_equal(found.tracks[1].states, [[9, 16, 3, 8], [10.5, 16, 3, 8]])
    np.testing.assert_array_equal(found.tracks[0].states, [[4, 4, 2, 2]])


BOMB = b"""<?xml version="1.0"?><!DOCTYPE dataset [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">
<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]><dataset>&c;</dataset>"""
BAD_XML = {
    BOMB: "line 1: entities are not allowed",
    b'<!DOCTYPE d [<!ENTITY x SYSTEM "file:///etc/passwd">]><dataset>&x;</dataset>': "line 1: entities are not allowed",
    b"<annotation><object/></annotation>": "line 1: the outermost element must be <dataset>, .*got <annotation>",
    CVML[:400]: "not well-formed XML",
    b"": "not well-formed XML",
    CVML.replace(b'xc="10.5"', b'xc="nan"'): "line 5: xc must be a finite number, got 'nan'",
    CVML.replace(b' w="3"', b' w="-3"', 1): "line 5: width and height must be at least 0",
    CVML.replace(b' w="3"', b"", 1): "line 5: <box> must have the attribute 'w'",
    CVML.replace(b'object id="0"', b'object id="4"'): "line 11: id 4 is in this frame already",
    CVML.replace(b'number="2"', b'number="-2"'): "frame must be one of the first",
    CVML.replace(b'<box xc="5" yc="5" w="2" h="2"/>', b""): "<object> must hold one <box xc yc w h>, got 0",
    b"<dataset>" + b"<a>" * 100: "nested deeper than 64",
    b'<?xml version="1.0" encoding="nothing-such"?><dataset/>': "line 1",
    b'<?xml version="1.0" encoding="shift_jis"?><dataset/>': "line 1: the encoding cannot be read",
    b'<!DOCTYPE dataset [<!ATTLIST box xc CDATA "5">]><dataset/>': "line 1: entities are not allowed .*document type",
    b'<!DOCTYPE dataset SYSTEM "http://localhost/cvml.dtd"><dataset/>': "line 1: entities are not allowed",
    b'<!DOCTYPE dataset [<!ENTITY % p SYSTEM "file:///etc/passwd">%p;]><dataset/>': "line 1: entities are not allowed",
    CVML.replace(b'xc="10.5"', b'xc="1_0"'): "line 5: xc must be a finite number, got '1_0'",
    CVML.replace(b'xc="10.5"', 'xc="\u0661"'.encode()): "line 5: xc must be a finite number",
    CVML.replace(b'xc="10.5"', b'xc="' + b"9" * 10_000 + b'"'): "line 5: xc must be a finite number, got '9{40}'$",
    b"<dataset>\n<a " + b'b="' + b">" * 200_000 + b'"/></dataset>': "line 2: tags and comments must be shorter than",
    b"<dataset>\n<!--" + b"-> " * 70_000 + b"--></dataset>": "line 2: tags and comments must be shorter than",
}


@pytest.mark.parametrize(("content", "message"), BAD_XML.items())
def test_bad_xml_names_file_and_line(tmp_path, content, message):
    with pytest.raises(SequenceError, match=r"truth\.xml, line \d+: ") as caught:
        read_caviar(write(tmp_path, "truth.xml", content))
    assert caught.match(message)


def test_long_but_allowed_tags_and_texts_are_read_in_linear_time(tmp_path):
    """Expat 2.5 takes 8 s for an attribute of 40 MB, because it reads an unfinished tag again with every block."""
    filler = b'<a b="' + b">" * 65_000 + b'"/>' + b"text " * 40_000
    path = write(tmp_path, "long.xml", CVML.replace(b"</dataset>", filler * 20 + b"</dataset>"))
    started = time.process_time()
    assert read_caviar(path).ids.tolist() == [0, 4]
    assert time.process_time() - started < 2.0
    path.write_bytes(b'<dataset a="' + b"x" * 40_000_000 + b'"/>')
    started = time.process_time()
    with pytest.raises(SequenceError, match="tags and comments must be shorter"):
        read_caviar(path)
    assert time.process_time() - started < 2.0


def test_seqinfo(tmp_path):
    info = read_seqinfo(write(tmp_path, "seqinfo.ini", SEQINFO))
    assert info == ("Toy", "img1", 25.0, 3, 64, 48)
    assert read_seqinfo(write(tmp_path, "seqinfo.ini", b"[Sequence]\n")).frame_rate is None


BAD_INI = {
    b"": "must have a section",
    b"frameRate=25": "must have a section",
    b"[Sequence]\nframeRate=0\n": "frameRate must be a positive number from 0.1 to 1000, got '0'",
    b"[Sequence]\nframeRate=fast\n": "frameRate must be a positive number from 0.1 to 1000, got 'fast'",
    b"[Sequence]\nframeRate=1e9\n": "frameRate must be a positive number from 0.1 to 1000, got '1e9'",
    "[Sequence]\nframeRate=\u0662\u0665\n".encode(): "frameRate must be a positive number",
    b"[Sequence]\nimWidth=0.5\n": "imWidth must be a positive number from 1 to 1e",
    b"[Sequence]\nseqLength=3.5\n": "seqLength must be a whole number, got 3.5",
    b"[Sequence]\nimDir=../../etc\n": "imDir must be a folder inside",
    b"[Sequence]\nimDir=/etc\n": "imDir must be a folder inside",
    b"\xff\xfe\x00": "must have a section",
    b"#" * 70000: "has 70000 bytes, the limit is 65536",
}


@pytest.mark.parametrize(("content", "message"), BAD_INI.items())
def test_bad_seqinfo_names_the_file(tmp_path, content, message):
    with pytest.raises(SequenceError, match=r"seqinfo\.ini.*" + message):
        read_seqinfo(write(tmp_path, "seqinfo.ini", content))
