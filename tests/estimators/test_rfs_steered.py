"""A steered PHD filter: what it is told decides, run by run; one that counts finds out what it was not told."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.baselines.agents.clutter.catalog import steered_phd, track_filter
from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.clutter.scene_model import scene_model_of
from servotrack.estimators.rfs import CountingPHD, MeasurementBirth, SteadyPHD, SteeredPHD, Steering

SEED = 100_000


def scene(level=0, seed=SEED, **axes):
    config = clutter_config(level, **axes)
    return scene_model_of(config), draw_episode(config, seed).measurements


def steering(*runs):
    return Steering(*(np.array(column, float) for column in zip(*runs, strict=True)))


def test_steered_as_it_was_told_it_is_the_filter_itself():
    hint, scans = scene(5)
    plain, steered = track_filter("gm-phd", hint), steered_phd(hint)
    batch = scans[:, None]
    one, other = plain.initial(batch[0]), steered.initial(batch[0])
    for scan in batch[:40]:
        one, wanted = plain.step(one, scan)
        other, found = steered.step(other, scan, steering((hint.detection_probability, 1.0, 0.0)))
        assert np.array_equal(wanted.states, found.states) and np.array_equal(wanted.labels, found.labels)
        assert np.allclose(other.account.number, wanted.expected_number)


def test_steady_it_is_steered_by_the_same_numbers_at_every_step():
    hint, scans = scene(7)
    steady, steered = SteadyPHD(steered_phd(hint), births=0.02), steered_phd(hint)
    batch = scans[:, None]
    one, other = steady.initial(batch[0]), steered.initial(batch[0])
    for scan in batch[:40]:
        one, found = steady.step(one, scan)
        other, wanted = steered.step(other, scan, steering((hint.detection_probability, 1.0, 0.02)))
        assert np.array_equal(found.states, wanted.states) and np.array_equal(found.labels, wanted.labels)
    assert found.labels.any()


def test_every_run_has_parameters_of_its_own():
    hint, scans = scene(5)
    steered = steered_phd(hint)
    knobs = [(0.98, 1.0, 0.0), (0.6, 1.0, 0.0), (0.98, 8.0, 0.05)]
    together = steered.initial(np.repeat(scans[0][None], 3, axis=0))
    alone = [steered.initial(scans[0][None]) for _ in knobs]
    for scan in scans[:30]:
        together, estimates = steered.step(together, np.repeat(scan[None], 3, axis=0), steering(*knobs))
        for run, knob in enumerate(knobs):
            alone[run], estimate = steered.step(alone[run], scan[None], steering(knob))
            mine = estimates.labels[run] > 0
            assert np.array_equal(estimates.states[run][mine], estimate.states[0][estimate.labels[0] > 0])
    numbers = together.account.number
    assert len(set(np.round(numbers, 3))) == 3


def test_what_is_explained_and_what_is_not_are_all_measurements():
    hint, scans = scene(6)
    steered = steered_phd(hint)
    state = steered.initial(scans[0][None])
    for scan in scans[:20]:
        state, _ = steered.step(state, scan[None], steering((0.9, 2.0, 0.01)))
        account = state.account
        assert account.explained + account.unexplained == pytest.approx(scan[:, 0].sum())
        assert account.explained >= 0.0 and account.unexplained >= 0.0


@pytest.mark.parametrize(("level", "clutter", "detection"), [(5, 20.0, 0.8), (6, 40.0, 0.98)])
def test_counting_finds_what_was_told_wrong(level, clutter, detection):
    hint, _ = scene(level)
    filter = CountingPHD(steered_phd(hint), hint.clutter_rate)
    scans = np.stack([scene(level, SEED + i)[1] for i in range(8)], axis=1)
    state = filter.initial(scans[0])
    for scan in scans:
        state, _ = filter.step(state, scan)
    found = (state.unexplained / state.scans).mean(), (state.explained / state.predicted).mean()
    # Births that are expected in vain count as targets that were not seen.
    assert found[0] == pytest.approx(clutter, rel=0.15) and abs(found[1] - detection) < 0.15
    # Nearer to the truth than what was told.
    if level == 5:
        assert abs(found[1] - detection) < 0.98 - detection
    else:
        assert abs(found[0] - clutter) < 0.2 * abs(hint.clutter_rate - clutter)


def test_births_anywhere_follow_targets_that_appear_where_none_were_expected():
    hint, scans = scene(7)
    steered = steered_phd(hint)
    states = steered.initial(np.repeat(scans[0][None], 2, axis=0))
    for scan in scans[:60]:
        both = np.repeat(scan[None], 2, axis=0)
        states, estimate = steered.step(states, both, steering((0.98, 1.0, 0.0), (0.98, 1.0, 0.1)))
    counts = (estimate.labels > 0).sum(axis=1)
    assert counts[1] > counts[0] + 1


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        (Steering(np.ones(2), np.ones(1), np.ones(1)), "detection must have shape"),
        (Steering(np.array([1.5]), np.ones(1), np.ones(1)), "detection must be finite"),
        (Steering(np.ones(1), np.array([np.nan]), np.ones(1)), "clutter must be finite"),
        (Steering(np.ones(1), np.zeros(1), np.ones(1)), "clutter must be finite"),
        (Steering(np.ones(1), np.ones(1), np.array([-0.1])), "births must be finite"),
    ],
)
def test_steering_out_of_range_is_refused(knobs, message):
    hint, scans = scene()
    steered = steered_phd(hint)
    with pytest.raises(ValueError, match=message):
        steered.step(steered.initial(scans[0][None]), scans[0][None], knobs)


def test_arguments_out_of_range_are_refused():
    hint, _ = scene()
    steered = steered_phd(hint)
    with pytest.raises(ValueError, match=r"anywhere\.expected must be 1"):
        SteeredPHD(steered.filter, MeasurementBirth(expected=0.5))
    with pytest.raises(ValueError, match="births must be finite and >= 0"):
        SteadyPHD(steered, births=-1.0)
    for name in ("births", "memory", "trust"):
        with pytest.raises(ValueError, match=f"{name} must be finite and > 0"):
            CountingPHD(steered, 20.0, **{name: 0.0})
