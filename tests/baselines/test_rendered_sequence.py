"""`servotrack render`: a rendered crowd in MOTChallenge's form is the environment's own frames and truth."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.reporting.temporary import unfinished_folder
from servotrack.baselines.track_command.rendered import ENVIRONMENT, render_sequence
from servotrack.envs.track.files.frames import open_frames
from servotrack.envs.track.files.mot_files import find_mot_folder
from servotrack.envs.track.files.read import read_tracks

AXES = {"level": 1, "width": 160, "height": 120, "horizon": 12, "empty_frames": 4}


def test_images_truth_and_seqinfo_are_those_of_the_episode(tmp_path: Path) -> None:
    folder = tmp_path / "crossing"
    left: list[int] = []
    assert render_sequence(folder, AXES, 3, left.append) == 12
    assert left == list(range(11, -1, -1))
    found = find_mot_folder(folder)
    assert found is not None and found.info[2:] == (25.0, 12, 160, 120)
    frames = list(open_frames(folder))
    tracks = read_tracks(folder).tracks
    env = gym.make(ENVIRONMENT, **AXES)
    image, info = env.reset(seed=3)
    for step, frame in enumerate(frames):
        assert np.abs(frame.astype(int) - image).mean() < 4.0
        truth = info["truth"]
        boxes = [track.states[track.steps == step][0] for track in tracks if (track.steps == step).any()]
        expected = truth["boxes"][truth["exists"]]
        assert len(boxes) == len(expected)
        if boxes:
            np.testing.assert_allclose(np.sort(boxes, axis=0), np.sort(expected, axis=0), atol=0.006)
        image, _, _, _, info = env.step(np.zeros(env.action_space.shape))
    assert len(frames) == 12 and tracks


def test_only_a_rendered_sequence_is_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    render_sequence(folder, {**AXES, "horizon": 3}, 0)
    render_sequence(folder, {**AXES, "horizon": 2}, 0)
    assert len(list((folder / "img1").iterdir())) == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("all of it")
    with pytest.raises(ResultsError, match=r"mine holds files that are not a rendered sequence; choose another folder"):
        render_sequence(tmp_path / "mine", AXES, 0)
    with pytest.raises(ValueError, match="observation must be 'pixels'"):
        render_sequence(tmp_path / "new", {**AXES, "observation": "blobs"}, 0)


def test_what_a_killed_rendering_left_behind_is_removed_by_the_next(tmp_path: Path) -> None:
    code = (
        "import os, sys\nfrom pathlib import Path\n"
        "from servotrack.baselines.reporting.temporary import unfinished_folder\n"
        "with unfinished_folder(Path(sys.argv[1])) as folder:\n"
        "    (folder / 'img1').mkdir()\n    (folder / 'img1' / '000001.jpg').touch()\n    os._exit(9)\n"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False).returncode == 9
    (abandoned,) = tmp_path.iterdir()
    assert abandoned.is_dir()
    with unfinished_folder(tmp_path) as growing:
        assert [entry.name for entry in tmp_path.iterdir()] == [growing.name]
        render_sequence(tmp_path / "scene", {**AXES, "horizon": 2}, 0)
        assert growing.is_dir(), "the folder of a writer that still runs"
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"]
