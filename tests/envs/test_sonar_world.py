"""The sonar environment: statistics follow its arguments, and scores agree with values computed by hand."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.envs.streams import Streams
from servotrack.envs.track.sonar.array_model import scene_model_of
from servotrack.envs.track.sonar.config import LEVEL_NAMES, sonar_config
from servotrack.envs.track.sonar.records import draw_powers, draw_record, draw_snapshots, power_moments
from servotrack.envs.track.sonar.scene import LONGEST_MEETING, MEETING_DISTANCE, crossings, draw_scene
from servotrack.estimators.sonar.array import beam_pattern, beamform

ENV_ID = "SonarTracking-v0"
SMALL = {"beams": 91, "elements": 16, "bin_width": 50.0, "snapshots": 50}
EXACT = {"bearing_jitter": 0.0, "rate_jitter": 0.0}
LEVELS = range(len(LEVEL_NAMES))


def drawn(seed=0, **keywords):
    config = sonar_config(**keywords)
    return config, draw_scene(config, seed)


@pytest.mark.parametrize(("variant", "meeting", "end"), [("rates", 40, (83.0, 70.0)), ("cross30", 30, (102.0, 52.5))])
def test_papers_targets_are_where_the_paper_says(variant, meeting, end):
    _, scene = drawn(variant=variant, **EXACT)
    assert np.flatnonzero(scene.exists[:, 0]).tolist() == list(range(10, 49))
    assert np.flatnonzero(scene.exists[:, 1]).tolist() == list(range(10, 46))
    assert not scene.exists[:, 2:].any()
    assert scene.bearings[10, :2] == pytest.approx([45.0, 105.0])
    assert (scene.bearings[48, 0], scene.bearings[45, 1]) == pytest.approx(end)
    assert scene.bearings[meeting, 0] == pytest.approx(scene.bearings[meeting, 1])
    assert scene.tonal[:2].tolist() == [True, False]


def test_papers_targets_stand_out_as_much_as_its_ratios_say():
    config, scene = drawn(**EXACT)
    # Per element over 0 to 6 kHz: 600 bins of noise.
    assert scene.power.sum(axis=1)[:2] == pytest.approx([600 * 10**-1.5, 600 * 10**-1.0])
    mean = power_moments(config, scene, 20).mean
    tone, band = mean[config.beam_bearings == 55.0][0], mean[config.beam_bearings == 95.0][0]
    assert tone - 1.0 == pytest.approx(48 * 600 * 10**-1.5 / 111, rel=0.06)
    assert band - 1.0 == pytest.approx(48 * 600 * 10**-1.0 / 111, rel=0.06)
    faint = power_moments(*drawn(snr_offset=-20.0, **EXACT), 20).mean
    assert faint - 1.0 == pytest.approx((mean - 1.0) / 100.0)


def test_mean_power_is_the_beam_pattern():
    config, scene = drawn(variant="trial", seed=3)
    at = 90
    here = np.flatnonzero(scene.exists[at])
    expected = config.ambient.mean() + sum(
        beam_pattern(config.array, config.band.frequencies, scene.power[i], config.beam_bearings, scene.bearings[at, i])
        for i in here
    )
    assert power_moments(config, scene, at).mean == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("at", [5, 27])
def test_both_fidelities_have_the_same_moments(at):
    """Mean, variance and correlation of beam powers agree, for noise alone and for two approaching targets."""
    runs = 400
    config, scene = drawn(variant="cross30", **SMALL, **EXACT)
    whole = replace(config, fidelity="snapshots")
    moments = power_moments(config, scene, at)
    samples = {c.fidelity: np.array([draw_powers(c, scene, seed, at) for seed in range(runs)]) for c in (config, whole)}
    for powers in samples.values():
        assert np.abs(powers.mean(axis=0) - moments.mean).max() < 5 * np.sqrt(moments.variance.max() / runs)
        standardized = (powers.mean(axis=0) - moments.mean) / np.sqrt(moments.variance / runs)
        assert np.abs(standardized).max() < 5.0
        ratio = powers.var(axis=0) / moments.variance
        assert np.abs(ratio - 1.0).max() < 5 * np.sqrt(2.0 / runs)
    cheap, exact = (np.corrcoef(samples[name].T) for name in ("gamma", "snapshots"))
    for apart in (1, 2, 4):
        assert np.diag(cheap, apart).mean() == pytest.approx(np.diag(exact, apart).mean(), abs=0.05)


def test_colored_noise_falls_with_frequency_and_keeps_its_level():
    config, scene = drawn(variant="random", targets=0, ambient_slope=6.0, fidelity="snapshots", **SMALL)
    assert config.ambient.mean() == pytest.approx(1.0)
    frequencies = config.band.frequencies
    octave = config.ambient[frequencies == 1000.0] / config.ambient[frequencies == 500.0]
    assert 10 * np.log10(octave) == pytest.approx(-6.0)
    snapshots = np.array([draw_snapshots(config, scene, Streams(seed)[0], 0) for seed in range(20)])
    power = (np.abs(snapshots) ** 2).mean(axis=(0, 1, 3))
    assert power == pytest.approx(config.ambient, rel=5 / np.sqrt(20 * 50 * 16))


def test_noise_of_a_record_has_mean_one_and_the_variance_of_its_averages():
    config, scene = drawn(level=5)
    record = np.array([draw_record(config, scene, 0, k) for k in range(40)])
    assert config.averages == 1110
    assert record.mean() == pytest.approx(1.0, abs=0.005)
    assert record.std() * np.sqrt(1110) == pytest.approx(1.0, abs=0.08)


def test_a_wave_comes_from_where_it_is():
    config, scene = drawn(variant="rates", fidelity="snapshots", snr_offset=20.0, **EXACT)
    snapshots = draw_snapshots(config, scene, Streams(0)[0], 12)
    powers = beamform(config.array, config.band.frequencies, snapshots, config.beam_bearings)
    loudest = config.beam_bearings[powers.argmax()]
    assert loudest == pytest.approx(103.0, abs=0.5)


def test_records_are_a_function_of_seed_and_number():
    config, scene = drawn(variant="random", seed=4)
    longer = draw_scene(replace(config, lag=20), 4)
    k = config.horizon
    assert np.array_equal(scene.bearings[:k], longer.bearings[:k])
    assert np.array_equal(draw_record(config, scene, 4, 50), draw_record(config, longer, 4, 50))
    assert not np.array_equal(draw_record(config, scene, 4, 50), draw_record(config, scene, 4, 51))
    quieter = draw_scene(replace(config, snr_offset=-10.0), 4)
    assert np.array_equal(scene.bearings, quieter.bearings)
    assert np.array_equal(scene.power, 10.0 * quieter.power) or np.allclose(scene.power, 10.0 * quieter.power)


@pytest.mark.parametrize("seed", range(8))
def test_drawn_targets_can_be_separated(seed):
    for variant in ("random", "trial"):
        config, scene = drawn(variant=variant, seed=seed)
        k = config.horizon
        bearings, exists = scene.bearings[:k], scene.exists[:k]
        count = int(exists.any(axis=0).sum())
        assert (4 if variant == "trial" else 1) <= count <= 6
        assert np.all((bearings[exists] >= 0.0) & (bearings[exists] <= 180.0))
        assert all(exists[:, i].sum() >= 30 for i in range(count))
        for i in range(count):
            for j in range(i):
                close = (np.abs(bearings[:, i] - bearings[:, j]) < MEETING_DISTANCE) & exists[:, i] & exists[:, j]
                edges = np.flatnonzero(np.diff(np.concatenate([[0], close, [0]]).astype(int)))
                assert (edges[1::2] - edges[::2]).max(initial=0) <= LONGEST_MEETING
        if variant == "trial":
            assert len(crossings(bearings, exists)) >= 3
            assert scene.power[0].sum() == pytest.approx(600.0 * 10**-0.5)


def test_targets_that_cross_the_array_axis_are_reflected():
    for seed in range(40):
        _, scene = drawn(variant="random", seed=seed, rate_noise=0.3)
        step = np.abs(np.diff(scene.bearings, axis=0))[scene.exists[1:] & scene.exists[:-1]]
        assert scene.bearings.min() >= 0.0
        assert scene.bearings.max() <= 180.0
        assert step.max() < 10.0


def test_answers_are_late_by_the_lag():
    env = gym.make(ENV_ID, level=1, lag=3, **SMALL).unwrapped
    _, info = env.reset(seed=1)
    past, rewards, scored = [], [], []
    truncated = False
    while not truncated:
        past.append(info["truth"])
        answer = np.zeros(env.action_space.shape)
        if len(past) > 3:
            answer[:6, 0], answer[:6, 1] = past[-4]["exists"], past[-4]["bearings"]
        else:
            answer[7] = [1.0, 10.0]
        _, reward, terminated, truncated, info = env.step(answer)
        assert not terminated
        rewards.append(reward)
        scored.append(info["scored"])
    assert len(rewards) == env.config.horizon + 3
    assert scored == [False] * 3 + [True] * env.config.horizon
    assert not any(rewards)
    assert info["ospa2"] == 0.0


def test_silence_misses_and_a_false_target_costs_a_half():
    env = gym.make(ENV_ID, level=0, lag=0, **SMALL).unwrapped
    env.reset(seed=1)
    answer = np.zeros(env.action_space.shape)
    rewards = [env.step(answer)[1] for _ in range(30)]
    assert rewards == [0.0] * 10 + [-1.0] * 20
    answer[0] = [0.5, 170.0]
    _, reward, *_, info = env.step(answer)
    assert reward == pytest.approx(-1.5)
    assert info["cardinality_error"] == -1
    answer[0] = [1.0, info["truth"]["bearings"][0] + 2.0]
    _, reward, *_, info = env.step(answer)
    assert (info["location_error"], info["missed_error"], info["false_error"]) == pytest.approx((2.0, 2.5, 0.0))
    assert reward == pytest.approx(-0.9)


def test_swapped_identities_cost_ospa2_and_nothing_else():
    env = gym.make(ENV_ID, level=1, lag=0, **SMALL).unwrapped
    _, info = env.reset(seed=1)
    total, truncated = 0.0, False
    while not truncated:
        answer = np.zeros(env.action_space.shape)
        answer[:6, 0], answer[:6, 1] = info["truth"]["exists"], info["truth"]["bearings"]
        if env.world.steps[0] >= 31:
            answer[[0, 1]] = answer[[1, 0]]
        _, reward, _, truncated, info = env.step(answer)
        total += reward
    assert total == 0.0
    assert info["ospa2"] > 1.0


def test_scene_model_describes_only_the_receiver():
    for level in LEVELS:
        model = scene_model_of(sonar_config(level))
        assert model.averages == 1110
        assert model._replace(beam_bearings=None) == scene_model_of(sonar_config(0))._replace(beam_bearings=None)
        assert not any("target" in name or "snr" in name for name in model._fields)


@pytest.mark.parametrize(
    ("keywords", "match"),
    [
        ({"level": 6}, "level must be a whole number from 0 to 5"),
        ({"variant": "sea"}, "variant must be one of rates, cross30, random, trial"),
        ({"fidelity": "exact"}, "fidelity must be one of"),
        ({"shading": "hann"}, "shading must be one of"),
        ({"lag": -1}, r"lag must lie in \[0, 1000\], got -1"),
        ({"snr_offset": float("nan")}, "snr_offset must lie in"),
        ({"max_targets": 1}, "max_targets must be at least 2 in variant 'rates'"),
        ({"variant": "trial", "max_targets": 4}, "max_targets must be at least 6 in variant 'trial'"),
        ({"targets": 7}, "targets must not exceed max_targets = 6"),
        ({"band_low": 1700.0}, "band_low must not exceed band_high"),
        ({"fidelity": "snapshots", "beams": 3601, "elements": 256, "bin_width": 5.0}, "GiB.*choose fidelity='gamma'"),
        ({"horizon": 2.5}, "horizon must be a whole number"),
        ({"render_mode": "text"}, "render_mode must be None or one of"),
    ],
)
def test_bad_arguments_are_named(keywords, match):
    with pytest.raises(ValueError, match=match):
        gym.make(ENV_ID, **keywords)


def test_unknown_keyword_suggests_the_nearest():
    with pytest.raises(TypeError, match="did you mean 'snr_offset'"):
        sonar_config(0, snr_ofset=3.0)


def test_a_variant_by_name_brings_its_own_values():
    assert sonar_config(variant="trial") == sonar_config(3)
    assert sonar_config(level=4, variant="random").snr_offset == 0.0
    assert sonar_config(variant="trial", horizon=50).horizon == 50


def test_an_impossible_scene_says_what_to_do():
    env = gym.make(ENV_ID, variant="random", targets=20, max_targets=20, max_rate=0.0, shortest_life=120)
    with pytest.raises(ValueError, match=r"no place was found for 20 targets.*lower targets"):
        for seed in range(10):
            env.reset(seed=seed)


def test_bad_answers_are_named():
    env = gym.make(ENV_ID, **SMALL).unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(env.action_space.shape))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must have shape"):
        env.step(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="action must be finite"):
        env.step(np.full(env.action_space.shape, np.nan))
    with pytest.raises(ValueError, match="reset options"):
        env.reset(options={"x": 1})
    assert "record 0/65" in env.world.debug_view()


@pytest.mark.parametrize("level", LEVELS)
def test_observations_lie_in_their_space(level):
    env = gym.make(ENV_ID, level=level, horizon=30)
    observation, _ = env.reset(seed=level)
    truncated, loudest = False, 0.0
    while not truncated:
        assert observation in env.observation_space
        loudest = max(loudest, float(observation.max()))
        observation, _, _, truncated, _ = env.step(env.action_space.sample())
    assert loudest < env.observation_space.high[0]
