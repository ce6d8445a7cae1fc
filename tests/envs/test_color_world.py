"""Color tracking: true boxes enclose the drawn head, scenarios have their effects, scores are exact."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.envs.streams import Streams
from servotrack.envs.track.color.config import LEVEL_NAMES, color_config
from servotrack.envs.track.color.scene import Painter, draw_scene
from servotrack.envs.track.color.scoring import center_errors, failures, overlaps, precision, success_curve
from servotrack.envs.track.color.scripts import draw_script, wander

ENV_ID = "ColorTracking-v0"


def script(seed: int = 3, **keywords):
    return draw_script(color_config(**keywords), Streams(seed))


@pytest.mark.parametrize("level", range(8))
def test_the_head_stays_inside_and_starts_at_its_size(level: int) -> None:
    config = color_config(level)
    for seed in range(3):
        boxes = draw_scene(config, seed).boxes
        assert (boxes[:, :2] > -3.0).all()
        assert (boxes[:, :2] + boxes[:, 2:] < np.array([303.0, 248.0])).all()
        assert 0.7 < boxes[0, 3] / config.head_height < 1.6


@pytest.mark.parametrize("level", [0, 3, 6, 7])
def test_the_true_box_is_where_the_head_is_drawn(level: int) -> None:
    # Without noise, the frame with a head less the frame with another head in its place differs inside the box only.
    config = color_config(level, sensor_noise=0.0)
    scene = draw_scene(config, 5)
    bare = scene._replace(target=scene.target._replace(**{
        name: layer._replace(pixels=np.zeros_like(layer.pixels))
        for name, layer in scene.target._asdict().items() if name != "body"
    }))  # fmt: skip
    # On level 6 the head is seen from every side by then.
    for k in (0, 40, 111, 150, 199):
        apart = (Painter(config, scene).frame(k) != Painter(config, bare).frame(k)).any(axis=2)
        rows, columns = np.nonzero(apart)
        left, top, width, height = scene.boxes[k]
        drawn = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        assert np.abs(drawn - [left, top, left + width, top + height]).max() < 1.5


def test_levels_do_what_their_names_say() -> None:
    fast, slow = (np.hypot(*np.diff(script(level=level).target.centers, axis=0).T).mean() for level in (0, 1))
    assert fast > 2.0 * slow
    assert len(script(level=1).occluders) == 3
    assert len(script(level=2).distractors) == 1
    zooms = np.concatenate([script(seed, level=3).zooms for seed in range(6)])
    assert zooms.max() > 1.4
    assert zooms.min() < 0.75
    turns = np.concatenate([script(seed, level=6).target.turns for seed in range(6)])
    assert turns.max() > np.pi and turns.min() < -np.pi
    growing = [script(seed, level=7).target.heights for seed in range(6)]
    assert np.concatenate(growing).max() > 1.4 * 48.0 > 2.0 * np.concatenate(growing).min()
    assert max(np.abs(np.diff(np.log(heights))).max() for heights in growing) > 0.06, "within tenths of a second"
    gains = np.concatenate([script(seed, level=4).gains for seed in range(6)])
    assert gains.max() > 1.5
    assert gains.min() < 0.65
    pan = script(level=5).pans
    assert np.ptp(pan, axis=0).min() > 15.0
    assert np.array_equal(script(level=0).zooms, np.ones(201))


def test_what_passes_hides_the_head_for_about_as_long_as_asked() -> None:
    config = color_config(1, occlusion_frames=8.0, sensor_noise=0.0)
    durations = []
    for seed in range(6):
        scene = draw_scene(config, seed)
        for motion in scene.script.occluders:
            apart = np.abs(motion.centers[:, 0] - scene.script.target.centers[:, 0])
            reach = 0.5 * (2.3 - 1.0) * 0.8 * scene.script.target.heights
            durations.append(int((apart < reach).sum()))
    assert 6.0 < np.mean(durations) < 10.0


def test_distractors_stay_near_and_look_alike() -> None:
    s = script(level=2)
    apart = np.hypot(*(s.distractors[0].centers - s.target.centers).T) / s.target.heights
    assert np.median(apart) < 2.2
    assert apart.min() < 0.5
    assert apart.max() > 1.2


def test_each_quantity_has_a_stream_of_its_own() -> None:
    plain, busy = script(level=1), script(level=1, distractors=2, zoom=1.3, pan=20.0, light_change=2.0)
    assert np.array_equal(plain.target.rolls, busy.target.rolls)
    more = script(level=1, occlusions=4)
    assert np.array_equal(plain.target.centers, more.target.centers)
    noisy, still = (draw_scene(color_config(2, sensor_noise=noise), 4) for noise in (0.0, 9.0))
    assert np.array_equal(noisy.boxes, still.boxes)
    assert np.array_equal(noisy.backdrop, still.backdrop)


def test_wandering_has_unit_variance_and_does_not_look_ahead() -> None:
    values = wander(np.random.default_rng(0), 400, 10.0, 200)
    assert values.std() == pytest.approx(1.0, abs=0.05)
    assert np.array_equal(wander(np.random.default_rng(1), 50, 10.0), wander(np.random.default_rng(1), 90, 10.0)[:50])


def test_answers_do_not_change_the_frames_and_frames_differ_by_seed() -> None:
    first, second = gym.make(ENV_ID, level=2), gym.make(ENV_ID, level=2)
    a, _ = first.reset(seed=4)
    b, _ = second.reset(seed=4)
    for k in range(5):
        assert np.array_equal(a["frame"], b["frame"])
        a, *_ = first.step(a["first_box"])
        b, *_ = second.step(np.full(4, 10.0 * k))
    other, _ = second.reset(seed=5)
    assert not np.array_equal(a["frame"], other["frame"])


def test_overlaps_and_center_errors_by_hand() -> None:
    box = np.array([10.0, 20.0, 10.0, 20.0])
    others = np.array([box, [15.0, 20.0, 10.0, 20.0], [40.0, 20.0, 10.0, 20.0], [12.0, 25.0, 5.0, 10.0], [1, 1, 0, 0]])
    assert overlaps(others, np.tile(box, (5, 1))).tolist() == [1.0, pytest.approx(1 / 3), 0.0, 0.25, 0.0]
    assert center_errors(box, box + np.array([3.0, 4.0, 0.0, 0.0])) == pytest.approx(5.0)


def test_episode_scores_by_hand() -> None:
    iou = np.array([1.0, 0.5, 0.0, 0.0, 0.5, 0.0])
    curve = success_curve(iou)
    assert curve[0] == pytest.approx(0.5)
    assert curve[9] == pytest.approx(0.5)
    assert curve[10] == pytest.approx(1 / 6)
    assert curve[20] == 0.0
    assert failures(iou) == 2
    assert precision(np.array([0.0, 20.0, 20.1, 90.0])) == 0.5


def test_an_episode_reports_its_scores_at_the_end_and_counts_the_first_frame() -> None:
    env = gym.make(ENV_ID, horizon=6)
    observation, info = env.reset(seed=2)
    assert {key: value for key, value in info.items() if key != "truth"} == {
        "iou": 0.0, "center_error": 0.0, "episode_scored": False, "auc": 0.0, "precision": 0.0, "failures": 0,
    }  # fmt: skip
    box = info["truth"]["box"]
    assert np.array_equal(box, observation["first_box"])
    total = 0.0
    for k in range(6):
        answer = np.array([0.0, 0.0, 1.0, 1.0]) if k in (2, 3) else info["truth"]["box"]
        _, reward, terminated, truncated, info = env.step(answer)
        assert reward == info["iou"] == (0.0 if k in (2, 3) else 1.0)
        assert not terminated
        assert truncated == info["episode_scored"] == (info["auc"] > 0.0) == (k == 5)
        total += reward
    assert info["failures"] == 1
    assert info["auc"] == pytest.approx(4 / 6 * 20 / 21)
    assert info["precision"] == pytest.approx(4 / 6)


@pytest.mark.parametrize(
    ("keywords", "match"),
    [
        ({"level": 8}, "level must be a whole number from 0 to 7"),
        ({"scenario": "fog"}, "scenario must be one of irregular, occlusion"),
        ({"zoom": 0.5}, r"zoom must lie in \[1, 2.5\], got 0.5"),
        ({"sensor_noise": float("nan")}, "sensor_noise must lie in"),
        ({"horizon": 2.5}, "horizon must be a whole number"),
        ({"head_height": 100.0, "zoom": 2.0}, "the head must fit into the frame"),
        ({"head_height": 100.0, "width": 96, "height": 400}, "0.75 of its width = 72 px, got 100"),
        ({"render_mode": "text"}, "render_mode must be None or one of"),
    ],
)
def test_bad_arguments_are_named(keywords, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        gym.make(ENV_ID, **keywords)


def test_scenarios_are_the_levels_and_unknown_keywords_suggest_the_nearest() -> None:
    for level, name in enumerate(LEVEL_NAMES):
        assert gym.make(ENV_ID, scenario=name).unwrapped.config == color_config(level)
    with pytest.raises(TypeError, match="did you mean 'occlusions'"):
        color_config(0, oclusions=3)


def test_bad_answers_are_named() -> None:
    env = gym.make(ENV_ID, width=120, height=96, head_height=24.0).unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(4))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must have shape \(4,\)"):
        env.step(np.zeros(5))
    with pytest.raises(ValueError, match="action must be finite"):
        env.step([0.0, np.nan, 1.0, 1.0])
    with pytest.raises(ValueError, match="action must be numbers"):
        env.step(["left"] * 4)


@pytest.mark.filterwarnings("error")
def test_absurd_answers_are_scored() -> None:
    env = gym.make(ENV_ID, width=120, height=96, head_height=24.0).unwrapped
    env.reset(seed=0)
    for answer in ([1e308] * 4, [-1e308, -1e308, 1e308, 1e308], [0.0, 0.0, -5.0, -5.0], np.zeros(4, np.int8)):
        _, reward, _, _, info = env.step(answer)
        assert reward == pytest.approx(0.0, abs=1e-9)
        assert np.isfinite(info["center_error"])
