"""Full disks, quotas, read-only and vanished folders: one line, exit code 1, and earlier results as they were."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from servotrack.__main__ import main
from servotrack.baselines.evaluation.bench import evaluate
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.reporting.files import ResultsError, StorageError, atomic_path, locked_folder

resource = pytest.importorskip("resource", reason="limits of a process need a Unix system")
SHORT = {"level": 0, "horizon": 80}
CELL = ("UncalibServo-v0", "random", "-l", "0", "-s", "horizon=80")
LIMIT = 12_000
"""Largest file that a limited command can write, bytes: a cell of 20 episodes fits, of 60 does not."""
NOBODY = 65534


@pytest.fixture
def results() -> Iterator[Path]:
    """A folder with 20 episodes of an agent, which other users can read."""
    folder = Path(tempfile.mkdtemp())
    try:
        evaluate("UncalibServo-v0", "random", take("tune", 20), SHORT, folder=ResultsFolder(folder), timing=False)
        folder.chmod(0o755)
        yield folder
    finally:
        shutil.rmtree(folder)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


def command(*arguments: str, limit: int | None = None, rehearsal: Path | None = None) -> tuple[int, str]:
    """Run a command in a forked process.

    Args:
        arguments: The command; its last argument is the folder.
        limit: Largest size of a file that it can write, bytes.
        rehearsal: Folder in which the command runs first, to import everything while it may. Then the process becomes
            a user without rights.

    Returns:
        Exit code, and what it says on stderr, without progress bars.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        code = 99
        try:
            os.dup2(writer, 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
            if limit is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            if rehearsal is not None:
                sys.argv = ["servotrack", *arguments[:-1], str(rehearsal)]
                with contextlib.suppress(SystemExit):
                    main()
                os.setresuid(NOBODY, NOBODY, NOBODY)
            sys.argv = ["servotrack", *arguments]
            main()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        finally:
            sys.stderr.flush()
            os._exit(code)
    os.close(writer)
    with open(reader) as stream:
        said = stream.read()
    _, status = os.waitpid(child, 0)
    lines = [line for line in said.splitlines() if line.strip() and not any(sign in line for sign in "━╸0:")]
    return os.waitstatus_to_exitcode(status), "\n".join([*lines, *_messages(said, lines)])


def _messages(said: str, lines: list[str]) -> list[str]:
    """Messages that hold a sign of a progress bar."""
    return [line for line in said.splitlines() if line.startswith("servotrack: ") and line not in lines]


def check(outcome: tuple[int, str], reason: str) -> None:
    code, said = outcome
    assert code == 1, said
    assert said.startswith("servotrack: ") and said.count("\n") == 0 and reason in said, said


def test_a_limit_leaves_the_earlier_results(results: Path) -> None:
    before = contents(results)
    check(command("evaluate", *CELL, "-n", "60", "--split", "tune", "-o", str(results), limit=LIMIT), "File too large")
    assert contents(results) == before
    check(command("leaderboard", str(results), limit=400), "leaderboard.md cannot be written (File too large)")
    assert contents(results) == before
    assert command("evaluate", *CELL, "-n", "60", "--split", "tune", "-o", str(results))[0] == 0
    cell = ResultsFolder(results).load("UncalibServo-v0", SHORT, "random")
    assert cell is not None and cell.seeds == take("tune", 60)


def test_a_read_only_folder_leaves_the_earlier_results(results: Path, tmp_path: Path) -> None:
    (results / ".lock").touch()
    before = contents(results)
    for path in (results, *results.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    rehearsal = tmp_path / "rehearsal" if os.geteuid() == 0 else None
    arguments = ("evaluate", *CELL, "-n", "60", "--split", "tune", "-o", str(results))
    check(command(*arguments, rehearsal=rehearsal), f"{results} is not writable (Permission denied)")
    assert contents(results) == before
    for path in (results, *results.iterdir()):
        path.chmod(0o755)


@pytest.mark.parametrize("number", ["ENOSPC", "EDQUOT", "EROFS", "EIO", "EFBIG", "ESTALE"])
def test_trouble_while_a_file_is_written_is_named(tmp_path: Path, number: str) -> None:
    target = tmp_path / "a.json"
    target.write_text("earlier")
    code = getattr(errno, number)
    with pytest.raises(StorageError, match="run the command again") as caught, atomic_path(target):
        raise OSError(code, os.strerror(code))
    assert f"{target} cannot be written ({os.strerror(code)})" in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"] and target.read_text() == "earlier"


def test_errors_that_have_nothing_to_do_with_the_file_pass(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a.json"):
        open("/nonexistent/another file")  # noqa: SIM115
    assert not list(tmp_path.iterdir())


def test_a_folder_that_vanishes_while_a_file_is_written_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    with pytest.raises(StorageError, match=r"a\.json cannot be written \(No such file"), atomic_path(folder / "a.json"):
        shutil.rmtree(folder)


def test_a_folder_without_locks_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fcntl

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(StorageError, match=r"\.lock cannot be locked \(No locks available\)"), locked_folder(tmp_path):
        pass


def test_a_file_where_a_folder_should_be_is_the_user_s_error(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("a file")
    for use in (locked_folder(tmp_path / "results"), atomic_path(tmp_path / "results" / "a.json")):
        with pytest.raises(ResultsError, match="cannot be a folder") as caught, use:
            pass
        assert not isinstance(caught.value, StorageError)


FULL_DISK = """
mount -t tmpfs -o size=40k tmpfs {folder} || exit 77
{servotrack} evaluate {cell} -n 20 --split tune -o {folder}/r || exit 76
dd if=/dev/zero of={folder}/rest bs=1k
sha256sum {folder}/r/*/*.json > {notes}/before
i=0
while read arguments; do
    {servotrack} $arguments > {notes}/out 2> {notes}/err < /dev/null
    echo "$? $arguments" >> {notes}/codes
    grep '^servotrack: ' {notes}/err >> {notes}/said
    grep Traceback {notes}/err >> {notes}/tracebacks
done < {notes}/commands
sha256sum {folder}/r/*/*.json > {notes}/after
find {folder} -name '.unfinished*' > {notes}/litter
"""


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("unshare") is None, reason="a small disk needs the superuser")
def test_every_command_that_writes_reports_a_full_disk(tmp_path: Path) -> None:
    folder, notes = tmp_path / "disk", tmp_path / "notes"
    folder.mkdir()
    notes.mkdir()
    commands = [
        f"evaluate {' '.join(CELL)} -n 200 --split tune -o {folder}/r",
        f"bench -o {folder}/r -a random,kf -l 0 -s horizon=80 -n 200 -j 1 --split tune --no-video",
        f"bench -o {folder}/r -a random,kf -l 0 -s horizon=80 -n 200 -j 2 --split tune --no-video",
        f"leaderboard {folder}/r",
        f"tune student-t-kf -n 1 -o {folder}/t.json",
        f"reproduce unscented_jacobian -o {folder}/reproduced --runs 2",
        f"play UncalibServo-v0 --agent kf --level 0 --video {folder}/film.mp4",
        f"render {folder}/walk -s horizon=20",
        f"train UncalibServo-v0 --steps 2000 -o {folder}/train -l 0",
        f"track {notes}/points.csv -o {folder}/points",
    ]
    rows = [f"{t},{3 * t},{k * 100 + t % 3}" for t in range(100) for k in range(5)]
    (notes / "points.csv").write_text("\n".join(["time,x,y", *rows]))
    (notes / "commands").write_text("\n".join(commands) + "\n")
    script = FULL_DISK.format(
        folder=folder, notes=notes, servotrack=f"{sys.executable} -m servotrack", cell=" ".join(CELL)
    )
    done = subprocess.run(["unshare", "-m", "sh", "-c", script], capture_output=True, check=False, text=True)
    if done.returncode == 77:
        pytest.skip("no tmpfs can be mounted here")
    assert (notes / "codes").read_text().splitlines() == [f"1 {line}" for line in commands], done.stderr
    said = (notes / "said").read_text().splitlines()
    assert len(said) == len(commands) and all("No space left on device" in line for line in said)
    assert (notes / "after").read_text() == (notes / "before").read_text() != ""
    assert (notes / "litter").read_text() == (notes / "tracebacks").read_text() == ""
