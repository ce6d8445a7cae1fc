"""Readers of strangers' files on damaged input: their own errors, no crash, no hang, and no row lost in silence.

`SERVOTRACK_FUZZED_INPUTS` sets the number of inputs of the slow tests: text files, default one million, of which one in
twenty is a video or an image.
"""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hostile_files import READERS, damaged, films, mutated, pictures

from servotrack.envs.track.files.frames import open_frames
from servotrack.envs.track.files.recorded import SequenceError

INPUTS = int(os.environ.get("SERVOTRACK_FUZZED_INPUTS", "1000000"))
LIMIT = 5.0
"""Longest time for one input, s."""


@contextlib.contextmanager
def time_limit() -> Iterator[None]:
    def stop(number: int, frame: object) -> None:
        raise AssertionError(f"no answer within {LIMIT} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def check_reader(path: Path, content: bytes) -> bool:
    """Return True if the content was read, False if it was refused; anything else fails."""
    reader, _, check = READERS[path.name]
    path.write_bytes(content)
    try:
        with time_limit():
            found = reader(path)
    except SequenceError as error:
        assert str(path) in str(error) and "\n" not in str(error), error
        if path.name not in ("seqinfo.ini", "points.csv"):
            assert f"{path}, line " in str(error), error
        return False
    check(content, found)
    return True


def fuzz_reader(name: str, count: int, folder: Path) -> tuple[int, int]:
    """Return the numbers of inputs that were read and refused."""
    read = 0
    valid = READERS[name][1]
    for seed in range(count):
        content = mutated(random.Random(seed), valid)
        try:
            read += check_reader(folder / name, content)
        except BaseException as error:
            raise AssertionError(f"{name}, input {seed}: {content!r}") from error
    return read, count - read


HOSTILE = {
    "points.csv": [
        b"",
        b"\n\n",
        b"\xef\xbb\xbftime,x,y\r\n0,1,2\r\n1,1,2\r\n",
        b"time,x,y\n0,1,2\n1,1,2",
        b"time,x,y\n0,1\x00,2\n1,1,2\n",
        b"time,x,y\n0;1;2\n",
        b'time,x,y,note\n0,1,2,"a\nb"\n1,1,2,""""\n',
        b'time,x,y\n0,"1,2\n1,1,2\n',
        b"time,x,y\n0,1,2\n0,1,2\n1,1,2\n",
        b"time,x,y\n1,1,2\n0,1,2\n",
        b"time,x,y\n0,nan,2\n1,1,2\n",
        b"time,x,y\n0,1e300,2\n1,1,2\n",
        b"time,x,y\n1e300,1,2\n",
        b"time,x,y\n-1e-320,1,2\n0,1,2\n",
        b"time,lat,lon\n0,91,2\n1,1,2\n",
        b"time,lat,lon\n0,89.9,2\n1,1,2\n",
        b"time,lat,lon\n0,1,361\n1,1,2\n",
        b"time,x,y,cov_xx,cov_xy,cov_yy\n0,1,2,1,1,1\n1,1,2,1,0,1\n",
        b"time,x,y,cov_xx,cov_xy,cov_yy\n0,1,2,-1,0,-1\n1,1,2,1,0,1\n",
        b"time,x,y" + b",a" * 3000 + b"\n0,1,2\n",
        "time,x,y\n0,1,\uff12\n1,1,2\n".encode(),
        b"\x1f\x8b\x08\x00",
        b"\xff\xfet\x00",
        b"time,x,y\n0,1,2\n9999-12-31T23:59:59,1,2\n",
        b"time,x,y\n0001-01-01,1,2\n0001-01-02,1,2\n",
    ],
    "gt.txt": [
        b"",
        b"\n\n",
        b"\xef\xbb\xbf1,1,0,0,1,1\n",
        b"1,1,0,0,1,1\r\n2,1,0,0,1,1\r\n",
        b"1 1 0 0 1 1 1\r2 1 0 0 1 1 1\r",
        b"1\t1\t0\t0\t1\t1\n",
        b"1;1;0;0;1;1\n",
        b"1,1,0,0,1,1,1,,\n",
        b"1,1,,0,1,1\n",
        b"frame,id,x,y,w,h\n",
        b"\x00" * 99,
        b"1,1,0,0,1,1\x00\n",
        b"1,1,0,0,1,1\n\x00",
        b"1,1,0,0,1,1\x0b2,1,0,0,1,1\n",
        b"1,1,0,0,1,1" + b",1" * 3000 + b"\n",
        b"1" * 4096 + b"\n",
        b"1,1,0,0,1,1\n" * 2,
        b"1e0,1E0,+0,-0,1.,.5\n",
        b"0x1,1,0,0,1,1\n",
        b"1,1,0,0,infinity,1\n",
        b"1,1,0,0,1,1,nan\n",
        b"1,1,0,0,1,1,1,1,2\n",
        b"10000001,1,0,0,1,1\n",
        b"1,9007199254740993,0,0,1,1\n",
        b"1,-1,0,0,1,1\n",
        b"1,1.5,0,0,1,1\n",
        b"1,1,0,0,-1,1\n",
        "1,1,0,0,1,\uff11\n".encode(),
        b"1,1,0,0,1,1\xa0\n",
        b"<dataset></dataset>",
        b"PK\x03\x04",
        b"\xff\xfe1\x00,\x00",
        b"#1,1,0,0,1,1\n",
        b"1,1,0,0,1,1 2,1,0,0,1,1\n",
    ],
    "truth.xml": [
        b"",
        b"<dataset",
        b"<dataset/>",
        b"<dataset/><dataset/>",
        b"<dataset/>x",
        b"\xef\xbb\xbf<dataset/>",
        b"\x00" * 99,
        b"<dataset><frame/></dataset>",
        b"<dataset><frame number='1'/></dataset>",
        b"<dataset><frame number='1.5'/></dataset>",
        b"<dataset><frame number='1'><objectlist><object id='1'/></objectlist></frame></dataset>",
        b"<dataset a='1' a='2'/>",
        b"<dataset xmlns:a='b'><a:frame number='x'/></dataset>",
        b"<a/>",
        b"1,1,0,0,1,1\n",
        "<?xml version='1.0' encoding='utf-16'?><dataset/>".encode("utf-16"),
        b"<dataset>&amp;&#0;</dataset>",
        b"<?xml version='1.0' encoding='zlib_codec'?><dataset/>",
        b"<?xml version='1.0' encoding='rot13'?><dataset/>",
        b"<?xml version='1.0' encoding='utf-7'?><dataset/>",
        b"<?xml version='1.1'?><dataset/>",
        b"<!DOCTYPE dataset><dataset/>",
        b"<!DOCTYPE d [<!ENTITY a 'b'>]><dataset>&a;</dataset>",
        b"<dataset><![CDATA[<frame number='x'>]]></dataset>",
        b"<dataset>" * 70,
        b"<dataset>" + b"<a>" * 60 + b"</a>" * 60 + b"</dataset>",
        b"<dataset><!--" + b"a" * 300_000,
        b"<dataset " + b" ".join(b"a%d='1'" % k for k in range(3000)) + b"/>",
    ],
    "seqinfo.ini": [
        b"",
        b"[Sequence]",
        b"[Sequence]\n[Sequence]\n",
        b"[Sequence]\nframeRate=1\nframeRate=2\n",
        b"[Sequence\n",
        b"[Sequence]\nframeRate=%(a)s\n",
        b"[Sequence]\nimDir=\n",
        b"[Sequence]\nimDir=a\x00b\n",
        b"[Sequence]\nimDir=a/../b\n",
        b"[Sequence]\nimWidth=1e6\nimHeight=1\n",
        b"[Sequence]\nimWidth=0\n",
        b"[Sequence]\nseqLength=-1\n",
        b"\xff" * 99,
        b"[Sequence]\nframeRate=nan\n",
        b"[Sequence]\nframeRate=25 fps\n",
        b"[Sequence]\n frameRate=25\n",
        b"=\n",
        b"\x00",
    ],
}
HOSTILE["det.txt"] = HOSTILE["flags.txt"] = HOSTILE["gt.txt"]
HOSTILE["labels.txt"] = [
    b"0 2 Pedestrian 0 0 0 1 2 3 4\n",
    b"0 2 Pedestrian 0 0 0 1 2 3 4\n" * 2,
    b"0 2.5 Pedestrian 0 0 0 1 2 3 4\n",
    b"0.5 2 Pedestrian 0 0 0 1 2 3 4\n",
    b"0 1e300 Pedestrian 0 0 0 1 2 3 4\n",
    b"0 9007199254740993 Pedestrian 0 0 0 1 2 3 4\n",
    b"nan 2 Pedestrian 0 0 0 1 2 3 4\n",
    b"0 2 Pedestrian 0.5 0 0 1 2 3 4\n",
    b"0 2 Pedestrian 1e400 0 0 1 2 3 4\n",
    b"0 2 Pedestrian 0 0 0 3 2 1 4\n",
    b"0 2 Pedestrian 0 0 0 1 2 inf 4\n",
    b"0 2 Pedestrian 0 0 0 -1e308 2 1e308 4\n",
    b"0 2 Pedestrian 0 0 0 1 2 3\n",
    b"0 2 Pedestrian 0 0 0 1 2 3 4" + b" 1" * 99 + b"\n",
    b"0 2 Pedestrian 0 0 0 1 2 3 4" + b" " * 5000 + b"\n",
    b"0 2 Pedestrian 0 0 0 1 2 3 4\n0 3 Alien 0 0 0 1 2 3 4\n",
    b"0 -1 DontCare -1 -1 -10 1 2 3 4\n",
    b"0 -1 DontCare -1 -1 -10 nan 2 3 4\n",
    b"-5 2 Pedestrian 0 0 0 1 2 3 4\n",
    b"10000001 2 Pedestrian 0 0 0 1 2 3 4\n",
]


@pytest.mark.parametrize("name", READERS)
def test_hostile_files_are_read_as_written_or_refused(tmp_path, name):
    read = [check_reader(tmp_path / name, content) for content in HOSTILE[name]]
    assert 0 < sum(read) < len(read)


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_as_written_or_refused(tmp_path, name):
    read, refused = fuzz_reader(name, 300, tmp_path)
    assert read > 5 and refused > 5


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_files_are_read_as_written_or_refused(tmp_path, name):
    read, refused = fuzz_reader(name, INPUTS * 19 // 100, tmp_path)
    print(f"{name}: {read} read, {refused} refused")
    assert read > 0 and refused > 0


def decode_damaged(folder: Path, first: int, last: int) -> None:
    """Decode damaged videos and images; print the number of each input before it is opened, and a summary."""
    valid = [(path, path.read_bytes()) for path in [*films(folder), *pictures(folder)]]
    read = 0
    for seed in range(first, last):
        print(seed, flush=True)
        rng = random.Random(seed)
        path, content = valid[rng.randrange(len(valid))]
        inner = folder / "damaged"
        inner.mkdir(exist_ok=True)
        target = inner / path.name
        target.write_bytes(damaged(rng, content))
        started = time.monotonic()
        try:
            source = open_frames(inner if path.name.startswith("p.") else target)
            for k, image in enumerate(source):
                assert image.dtype == np.uint8 and image.shape == (*source.size[::-1], 3)
                if k == 100:
                    break
            read += 1
        except SequenceError as error:
            assert str(target) in str(error) or str(inner) in str(error), error
            assert "\n" not in str(error)
        finally:
            target.unlink()
        assert time.monotonic() - started < LIMIT, f"{target.name}: {time.monotonic() - started} s"
    print(f"{read} read, {last - first - read} refused")


def fuzz_decoders(first: int, last: int, folder: Path) -> str:
    """Run `decode_damaged` in a process of its own, which a crash of a decoder ends; return its summary."""
    code = f"import test_reader_fuzzing as f, pathlib; f.decode_damaged(pathlib.Path({str(folder)!r}), {first}, {last})"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent), "OPENCV_FFMPEG_LOGLEVEL": "-8"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, errors="replace", timeout=3600
    )
    assert done.returncode == 0, f"{done.returncode}, input {done.stdout[-200:].split()[-1:]}: {done.stderr[-3000:]}"
    return done.stdout.splitlines()[-1]


def test_damaged_videos_and_images_are_decoded_or_refused(tmp_path):
    assert "read" in fuzz_decoders(0, 80, tmp_path)


@pytest.mark.slow
def test_many_damaged_videos_and_images_are_decoded_or_refused(tmp_path):
    count = INPUTS // 20
    for first in range(0, count, 1000):
        print(fuzz_decoders(first, min(first + 1000, count), tmp_path))
