"""Pictures of UncalibServo: their contents, determinism, and no effect on the episode."""

import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled, ResetNeeded

import servotrack  # noqa: F401
from servotrack.envs.drawing.glyphs import put_text, text_width
from servotrack.envs.drawing.palette import IVORY
from servotrack.envs.drawing.viewer import Viewer
from servotrack.envs.servo import backdrop
from servotrack.envs.servo.footprint import camera_footprint, floor_lines
from servotrack.envs.servo.render import ServoScene, draw
from servotrack.estimators.camera import pack_camera, project_points

SHAPE = (416, 720, 3)
LINKS = np.array([0.5, 0.5])
CAMERA = pack_camera(160.0, 0.35, mounting=0.4, tilt=(0.1, -0.15), distortion=-0.05)
JOINTS = np.array([0.2, 1.3])


def scene(**changes):
    plain = ServoScene(
        links=LINKS,
        joint_angles=JOINTS,
        target=np.array([0.7, 0.3]),
        feature=np.array([300.0, 120.0]),
        goal=np.array([240.0, 240.0]),
        camera_size=480,
        visible=True,
        tracking_error=0.0123,
        time=3.0,
        caption="level 3 optics",
    )
    return replace(plain, **changes)


def floor_color(image, point):
    column, row = np.rint(backdrop.floor_pixels(np.asarray(point), float(LINKS.sum()))).astype(int)
    return backdrop.FLOOR_PANEL.of(image)[row, column].astype(int)


def camera_color(image, pixel):
    column, row = np.rint(np.asarray(pixel) * backdrop.CAMERA_PANEL.width / 480).astype(int)
    return backdrop.CAMERA_PANEL.of(image)[row, column].astype(int)


def near(color, other, tolerance=12):
    return np.abs(np.asarray(color) - other).max() <= tolerance


def test_frame_is_a_fresh_rgb_image_that_repeats():
    first, second = draw(scene()), draw(scene())
    assert first.shape == SHAPE
    assert first.dtype == np.uint8
    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(first, second)


def test_target_tool_and_feature_are_where_the_geometry_puts_them():
    image = draw(scene())
    phi = JOINTS.sum()
    tool = 0.5 * np.array([np.cos(JOINTS[0]) + np.cos(phi), np.sin(JOINTS[0]) + np.sin(phi)])
    assert near(floor_color(image, [0.7, 0.3]), backdrop.TARGET)
    assert near(floor_color(image, tool), IVORY)
    assert near(floor_color(image, [0.0, 0.0]), IVORY)
    assert near(camera_color(image, [300.0, 120.0]), backdrop.TARGET)


def test_feature_that_is_not_seen_is_hollow():
    assert near(camera_color(draw(scene(visible=False)), [300.0, 120.0]), backdrop.LENS)


def test_trails_are_drawn_and_fade_with_age():
    # Away from the arm: the tool stands near (0.5, 0.6), the base at the origin.
    steps = np.linspace(0.0, 1.0, 120)[:, None]
    trail = np.array([0.15, -0.3]) + steps * np.array([0.6, 0.0])
    bare = draw(scene())
    for name, color in (("target_trail", backdrop.TARGET), ("tool_trail", backdrop.TOOL)):
        image = draw(scene(**{name: trail}))
        old, new = floor_color(image, trail[5]), floor_color(image, trail[-5])
        assert near(new, color, 40)
        assert np.abs(new - color).sum() < np.abs(old - color).sum()
        assert np.abs(old - floor_color(bare, trail[5])).sum() > 5


def test_feature_trail_and_error_history_are_drawn():
    trail = np.stack([np.linspace(60, 300, 80), np.full(80, 400.0)], axis=1)
    bare = draw(scene())
    assert near(camera_color(draw(scene(feature_trail=trail)), trail[-3]), backdrop.TARGET, 40)
    curve = backdrop.ERROR_PANEL.of(draw(scene(error_history=np.geomspace(0.5, 0.001, 200))))
    assert np.abs(curve.astype(int) - backdrop.ERROR_PANEL.of(bare)).max() > 100


def test_extreme_values_do_not_break_the_picture():
    far = np.array([[1e6, -1e6], [0.3, 0.3]])
    changes = {
        "feature": np.array([1e7, -1e7]),
        "tracking_error": 0.0,
        "error_history": np.array([0.0, 1e9]),
        "target_trail": far,
        "footprint": np.concatenate([far, -far]),
        "time": -0.4,
    }
    assert draw(scene(**changes)).shape == SHAPE


def test_footprint_is_what_the_camera_sees():
    outline = camera_footprint(CAMERA, LINKS, JOINTS, 480)
    pixels, seen = project_points(CAMERA, LINKS, JOINTS, outline)
    assert seen.all()
    on_border = np.abs(np.abs(pixels - 240.0).max(axis=-1) - 240.0)
    np.testing.assert_allclose(on_border, 0.0, atol=1e-6)


def test_floor_lines_are_straight_without_distortion_and_cover_the_image():
    camera = pack_camera(160.0, 0.35, tilt=(0.1, 0.2))
    lines = floor_lines(camera, LINKS, JOINTS, 480)
    points = np.concatenate(lines)
    assert ((points > 0) & (points < 480)).all(axis=1).sum() > 20
    for line in lines:
        centered = line - line.mean(axis=0)
        assert np.linalg.svd(centered)[1][1] < 1e-6 * max(np.abs(centered).max(), 1.0) * len(line)


@pytest.mark.parametrize("env_id", ["UncalibServo-v0", "UncalibServoReach-v0", "UncalibServoPixels-v0"])
def test_rendering_changes_no_rollout(env_id):
    drawn, plain = gym.make(env_id, render_mode="rgb_array"), gym.make(env_id)
    drawn.reset(seed=3)
    plain.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-1, 1, (15, 2)).astype(np.float32)
    frames = []
    for action in actions:
        ours, theirs = drawn.step(action), plain.step(action)
        frames.append(drawn.render())
        for key in theirs[0]:
            np.testing.assert_array_equal(ours[0][key], theirs[0][key])
        assert ours[1] == theirs[1]
    assert all(frame.shape == SHAPE and frame.dtype == np.uint8 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50


def test_vector_frames_equal_single_frames():
    vector = gym.make_vec(
        "UncalibServoPixels-v0", num_envs=2, vectorization_mode="vector_entry_point", render_mode="rgb_array"
    )
    singles = [gym.make("UncalibServoPixels-v0", render_mode="rgb_array") for _ in range(2)]
    vector.reset(seed=[7, 8])
    for env, seed in zip(singles, (7, 8), strict=True):
        env.reset(seed=seed)
    action = np.array([[0.5, -0.2], [-0.3, 0.4]], dtype=np.float32)
    for _ in range(5):
        vector.step(action)
        for env, row in zip(singles, action, strict=True):
            env.step(row)
    for ours, env in zip(vector.render(), singles, strict=True):
        np.testing.assert_array_equal(ours, env.render())


def test_a_new_episode_forgets_the_old_trails():
    env = gym.make("UncalibServo-v0", level=0, render_mode="rgb_array")
    env.reset(seed=0)
    fresh = env.render()
    for _ in range(30):
        env.step(np.array([0.4, 0.3], dtype=np.float32))
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), fresh)


def test_rendering_before_reset_says_what_to_do():
    env = gym.make("UncalibServo-v0", render_mode="rgb_array").unwrapped
    with pytest.raises(ResetNeeded, match=r"reset\(\)"):
        env.render()


def test_human_mode_shows_frames(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make("UncalibServo-v0", render_mode="human", disable_env_checker=True)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(2, dtype=np.float32))
    assert env.unwrapped.render() is None
    assert env.unwrapped._viewer.held_keys() == frozenset()
    env.close()
    env.close()


def test_viewer_shows_the_frame_it_was_given(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    viewer = Viewer("test", fps=0)
    frame = draw(scene())
    viewer.show(frame)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, frame)
    viewer.close()
    assert viewer.closed


def test_missing_pygame_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(DependencyNotInstalled, match=r"servotrack\[human\]"):
        gym.make("UncalibServo-v0", render_mode="human")


def test_text_is_cut_at_the_border_and_refuses_unknown_characters():
    image = np.full((20, 60, 3), 255, dtype=np.uint8)
    put_text(image, "level 3", 50, 12, (0, 0, 0))
    assert image.min() < 100
    put_text(image, "level 3", 500, 12, (0, 0, 0))
    assert text_width("12.5 mm", 8) == pytest.approx(0.5 * text_width("12.5 mm", 16))
    with pytest.raises(ValueError, match="'Ä'"):
        put_text(image, "Ä", 0, 10, (0, 0, 0))
