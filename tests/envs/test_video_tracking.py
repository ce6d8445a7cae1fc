"""VideoTracking-v0: frames are unchanged, scores need ground truth, and Gymnasium's checkers pass."""

import os
import warnings
from pathlib import Path

import cv2
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.envs.track.files.recorded import SequenceError

ENV_ID = "VideoTracking-v0"
FRAMES = 6
TRUTH = "".join(f"{k + 1},{7 if k < 4 else 3},{8 + k},10,12,24,1,1,1\n" for k in range(FRAMES))
HIDDEN = "2,9,40,10,12,24,1,1,0.1\n3,9,41,10,12,24,0,1,1\n"
DETECTIONS = "1,-1,8,10,12,24,0.9\n1,-1,30,10,10,20,0.1\n3,-1,10,10,12,24,0.9\n3,-1,500,-500,12,24,0.8\n"


def sequence(folder: Path, images: bool = True) -> str:
    for name in ("gt", "det", *(["img1"] if images else [])):
        (folder / name).mkdir()
    (folder / "gt" / "gt.txt").write_text(TRUTH + HIDDEN)
    (folder / "det" / "det.txt").write_text(DETECTIONS)
    (folder / "seqinfo.ini").write_text(
        "[Sequence]\nname=Toy\nimDir=img1\nframeRate=10\nseqLength=999\nimWidth=64\nimHeight=48\n"
    )
    if images:
        for k in range(FRAMES):
            cv2.imwrite(str(folder / "img1" / f"{k + 1:06}.png"), np.full((48, 64, 3), 10 * k, np.uint8))
    return str(folder)


def answer(env: gym.Env, info: dict) -> np.ndarray:
    """Return the ground truth as an answer, one row per identity."""
    out = np.zeros(env.action_space.shape)
    truth = info["truth"]
    for row in np.flatnonzero(truth["exists"]):
        out[truth["ids"][row], 0] = 1.0
        out[truth["ids"][row], 1:] = truth["boxes"][row]
    return out


def episode(env: gym.Env, correct: bool = True) -> tuple[list, list[float], dict]:
    observation, info = env.reset(seed=0)
    seen, rewards, over = [observation], [], False
    while not over:
        observation, reward, _, over, info = env.step(
            answer(env, info) if correct else np.zeros(env.action_space.shape)
        )
        seen.append(observation)
        rewards.append(reward)
    return seen, rewards, info


def test_gymnasiums_checker_is_content_with_and_without_truth(tmp_path):
    source = sequence(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ENV_ID, horizon=8).unwrapped, skip_render_check=True)
        check_env(gym.make(ENV_ID, source=source, observation="detections", render_mode="rgb_array").unwrapped)
        check_env(gym.make(ENV_ID, source=source + "/img1", render_mode="rgb_array").unwrapped, skip_render_check=True)


def test_vector_environment_keeps_the_rules_and_is_the_single_one(tmp_path):
    source = sequence(tmp_path)
    check_vector_env(ENV_ID, source=source, steps=14, max_estimates=3)
    check_vector_matches_single(ENV_ID, source=source, max_estimates=3)


def test_frames_come_in_order_and_the_last_one_twice_whatever_the_seed(tmp_path):
    source = sequence(tmp_path)
    env = gym.make(ENV_ID, source=source)
    assert env.unwrapped.scene_model.frame_rate == 10.0
    for seed in (0, 1):
        env.reset(seed=seed)
        seen, _, _ = episode(env)
        assert [int(image.mean()) for image in seen] == [0, 10, 20, 30, 40, 50, 50]
    env = gym.make(ENV_ID, source=source, start=1, stride=2, horizon=2, width=32)
    seen, rewards, _ = episode(env)
    assert [int(image.mean()) for image in seen] == [10, 30, 30] and seen[0].shape == (24, 32, 3)
    assert rewards == pytest.approx([0.0, 0.0], abs=1e-12)


def test_truth_is_scored_and_hidden_people_do_not_count(tmp_path):
    env = gym.make(ENV_ID, source=sequence(tmp_path))
    _, rewards, info = episode(env)
    assert rewards == pytest.approx([0.0] * FRAMES, abs=1e-12)
    assert info["scored"] is True
    assert (info["ospa2"], info["mota"], info["idf1"]) == (pytest.approx(0.0), 1.0, 1.0)
    _, rewards, info = episode(env, correct=False)
    assert rewards == [-0.5] * FRAMES and info["cardinality_error"] == -1
    _, info = env.reset()
    _, _, _, _, info = env.step(answer(env, info))
    assert info["truth"]["ids"][info["truth"]["visibility"] < 0.2].tolist() == [3]  # 3, 7 and 9 of the file are 1 to 3
    assert info["truth"]["exists"].sum() == 1


def test_without_truth_nothing_is_scored(tmp_path):
    sequence(tmp_path)
    env = gym.make(ENV_ID, source=str(tmp_path / "img1"))
    _, rewards, info = episode(env, correct=False)
    assert rewards == [0.0] * FRAMES
    assert info["scored"] is False and "ospa" not in info and "mota" not in info


def test_detections_are_those_of_the_file_scaled_with_the_frames(tmp_path):
    source = sequence(tmp_path, images=False)
    env = gym.make(ENV_ID, source=source, observation="detections")
    assert env.unwrapped.scene_model.observation == "blobs"
    seen, rewards, _ = episode(env)
    assert len(rewards) == FRAMES
    np.testing.assert_array_equal(seen[0], [[1, 8, 10, 12, 24], [1, 30, 10, 10, 20]])
    np.testing.assert_array_equal(seen[1], np.zeros((2, 5)))
    np.testing.assert_array_equal(seen[2][1], [1, 128, -48, 12, 24])  # cut to the space
    env = gym.make(ENV_ID, source=source, observation="detections", width=32, least_confidence=0.5)
    seen, rewards, _ = episode(env)
    np.testing.assert_array_equal(seen[0], [[1, 4, 5, 6, 12], [0, 0, 0, 0, 0]])
    assert rewards == pytest.approx([0.0] * FRAMES, abs=1e-12)


def test_crowded_files_of_many_frames_are_refused_before_they_take_memory(tmp_path):
    source = sequence(tmp_path, images=False)
    rows = "".join(f"1,{k},{k % 60},10,2,4,1,1,1\n" for k in range(5000)) + "5000,1,8,10,12,24,1,1,1\n"
    (tmp_path / "det" / "det.txt").write_text(rows)
    with pytest.raises(SequenceError, match=r"detections: 5000 frames of up to 5000 boxes .* the limit is 20000000"):
        gym.make(ENV_ID, source=source, observation="detections", horizon=5000)
    (tmp_path / "det" / "det.txt").write_text(DETECTIONS + "5000,-1,8,10,12,24,1\n")
    (tmp_path / "gt" / "gt.txt").write_text(rows)
    with pytest.raises(SequenceError, match="truth: 5000 frames of up to 5000 boxes"):
        gym.make(ENV_ID, source=source, observation="detections", horizon=5000)
    assert gym.make(ENV_ID, source=source, observation="detections", horizon=4000) is not None


def test_files_that_are_no_video_are_refused_in_one_line(tmp_path):
    (tmp_path / "empty.avi").touch()
    (tmp_path / "folder.avi").mkdir()
    (tmp_path / "script.mp4").write_text("ffconcat version 1.0\nfile other.avi\n")
    (tmp_path / "endless.avi").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.avi")
    for name in ("empty.avi", "folder.avi", "script.mp4", "endless.avi", "pipe.avi", "nowhere.avi"):
        for make in (lambda path: gym.make(ENV_ID, source=path), lambda path: gym.make_vec(ENV_ID, 2, source=path)):
            with pytest.raises(SequenceError, match=name) as caught:
                make(str(tmp_path / name))
            assert "\n" not in str(caught.value)


def test_a_source_that_breaks_ends_the_episode_with_a_warning(tmp_path):
    env = gym.make(ENV_ID, source=sequence(tmp_path))
    (tmp_path / "img1" / "000004.png").write_bytes(b"broken")
    with pytest.warns(UserWarning, match=r"ends after 3 of 6 frames: .*000004\.png cannot be decoded as an image"):
        seen, _, info = episode(env)
    assert len(seen) == 4 and info["mota"] == 1.0


def test_rendered_frames_serve_where_there_is_no_source():
    env = gym.make(ENV_ID, horizon=12)
    first, _, info = episode(env)
    second, _, _ = episode(env)
    assert len(first) == 13 and first[0].shape == (288, 384, 3)
    np.testing.assert_array_equal(first, second)
    assert info["truth"]["exists"].any()


@pytest.mark.parametrize(
    ("axes", "error", "message"),
    [
        ({"sorce": "x"}, TypeError, "did you mean 'source'"),
        ({"observation": "blobs"}, ValueError, "observation must be one of pixels, detections"),
        ({"width": 64}, ValueError, "width needs a source, got 64"),
        ({"source": "x", "stride": 0}, ValueError, "stride must lie in"),
        ({"source": "x", "horizon": 1.5}, ValueError, "horizon must be a whole number, got 1.5"),
        ({"source": "nowhere.avi"}, SequenceError, "does not exist"),
        ({"source": "nowhere", "observation": "detections"}, SequenceError, "holds no det/det.txt"),
    ],
)
def test_mistakes_are_named(axes, error, message):
    with pytest.raises(error, match=message):
        gym.make(ENV_ID, **axes)
