"""Set filters under bad input, extreme parameters and long runs: an error that says what is wrong, or a sane answer."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.estimators.rfs import (
    GMPHD,
    PMB,
    PMBM,
    Birth,
    GlobalNearestNeighbor,
    GMCBMeMBer,
    HiddenMarkovModel,
    MeasurementBirth,
    ParticlePHD,
    RangeBearingModel,
    RawMeasurements,
    Reduction,
    RowAllocation,
    Spawn,
    constant_velocity,
    pairwise_structure,
)
from servotrack.estimators.stateful import Stateful

HMM = constant_velocity(5.0, 1.5)
S1 = pairwise_structure(HMM, "S1")
BEARING = RangeBearingModel(HMM.transition, HMM.process_noise, HMM.observation, np.diag([4.0, 1e-4]))
GAUSSIAN = [GMPHD, GMCBMeMBer, PMB, PMBM]
PLACE = Birth([0.1, 0.1], np.array([[0.0, 0.0, 0.0, 0.0], [50.0, 0.0, 0.0, 0.0]]), 100.0 * np.eye(4))


def make(kind, model=HMM, birth=PLACE, **options):
    if kind in (GlobalNearestNeighbor, RawMeasurements):
        return kind(model, **{name: options[name] for name in options if name == "capacity"})
    options = {"clutter_intensity": 1e-6, **options}
    if kind is ParticlePHD:
        return kind(model, birth, particles=50, birth_particles=50, capacity=2000, **options)
    return kind(model, birth, **options)


def check_sane(state, estimate):
    """Nothing is NaN, existence is a probability, covariances in use are symmetric and definite."""
    for leaf in leaves(state):
        assert np.all(np.isfinite(leaf))
    assert np.all((estimate.existence >= 0.0) & (estimate.existence <= 1.0))
    assert estimate.expected_number >= 0.0
    assert len(set(estimate.labels.tolist()) | set(estimate.held_labels.tolist())) == len(estimate.labels) + len(
        estimate.held_labels
    )
    for name in ("intensity", "pool", "undetected"):
        mixture = getattr(state, name, None)
        if mixture is not None:
            count, n = int(mixture.number), 4
            assert np.all(mixture.weight[:count] > 0.0) and np.all(mixture.weight[count:] == 0.0)
            for i in range(count):
                size = n if mixture.detected[i] else n + 2
                cov = mixture.covariance[i, :size, :size]
                assert np.array_equal(cov, cov.T)
                assert np.linalg.eigvalsh(cov).min() > 0.0


def leaves(tree):
    if isinstance(tree, tuple):
        for part in tree:
            yield from leaves(part)
    else:
        yield tree


scan_sets = st.lists(
    st.one_of(
        st.just([]),
        st.lists(st.tuples(st.floats(-60, 60), st.floats(-60, 60)), min_size=1, max_size=12),
        # Duplicates, and places far outside everything.
        st.lists(st.sampled_from([(0.0, 0.0), (1.0, 1.0), (1e9, -1e9)]), min_size=1, max_size=20),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=60, deadline=None)
@given(
    scans=scan_sets,
    kind=st.sampled_from(GAUSSIAN),
    model=st.sampled_from([HMM, S1]),
    detection=st.sampled_from([0.0, 0.3, 0.98, 1.0]),
    survival=st.sampled_from([0.0, 0.9, 1.0]),
    clutter=st.sampled_from([0.0, 1e-6, 10.0]),
    rule=st.sampled_from(["threshold", "sum", "map"]),
    driven=st.booleans(),
    spawning=st.booleans(),
)
def test_any_sets_and_extreme_parameters_give_sane_answers(
    scans, kind, model, detection, survival, clutter, rule, driven, spawning
):
    filter_ = make(
        kind,
        model,
        MeasurementBirth() if driven else PLACE,
        detection=detection,
        survival=survival,
        clutter_intensity=clutter,
        extraction=rule,
        spawn=(Spawn(0.05, 4.0 * np.eye(4)),) if spawning else (),
    )
    state = None
    for scan in scans:
        z = np.array(scan, dtype=np.float64).reshape(-1, 2)
        state, estimate = filter_.step(filter_.initial(z) if state is None else state, z)
        check_sane(state, estimate)


@settings(max_examples=30, deadline=None)
@given(
    scans=st.lists(
        st.lists(st.tuples(st.floats(0.0, 300.0), st.floats(-np.pi, np.pi)), max_size=8), min_size=1, max_size=6
    ),
    kind=st.sampled_from([*GAUSSIAN, GlobalNearestNeighbor]),
    transform=st.sampled_from(["ekf", "ukf"]),
)
def test_range_and_bearing_next_to_the_sensor_stay_finite(scans, kind, transform):
    model = RangeBearingModel(
        HMM.transition, HMM.process_noise, HMM.observation, np.diag([4.0, 1e-4]), transform=transform
    )
    filter_ = make(kind, model)
    state = None
    for scan in scans:
        z = np.array(scan, dtype=np.float64).reshape(-1, 2)
        state, _ = filter_.step(filter_.initial(z) if state is None else state, z)
        assert all(np.all(np.isfinite(leaf)) for leaf in leaves(state))


@pytest.mark.filterwarnings("ignore:.*cap")
@pytest.mark.parametrize("kind", [*GAUSSIAN, GlobalNearestNeighbor, RawMeasurements, ParticlePHD])
def test_thousands_of_measurements_stay_within_the_caps(kind):
    caps = {GlobalNearestNeighbor: {"capacity": 200}}
    for each in GAUSSIAN:
        caps[each] = {"reduction": Reduction(components=20, tracks=100)}
    filter_ = make(kind, **caps.get(kind, {}))
    rng = np.random.default_rng(0)
    state = filter_.initial(np.zeros((0, 2)))
    sizes = [leaf.shape for leaf in leaves(state)]
    for _ in range(2):
        # All of them where targets are born: the worst that can come.
        state, estimate = filter_.step(state, rng.normal(0.0, 20.0, (3000, 2)))
    assert [leaf.shape for leaf in leaves(state)] == sizes
    assert np.all(np.isfinite(estimate.states))


@pytest.mark.parametrize("kind", [*GAUSSIAN, GlobalNearestNeighbor, RawMeasurements, ParticlePHD])
def test_nothing_measured_for_long_ends_every_target(kind):
    tracker = Stateful(make(kind))
    for _ in range(5):
        tracker.step(np.zeros((1, 2)))
    for _ in range(60):
        estimate = tracker.step([])
    assert len(estimate.states) == 0
    assert estimate.states.shape == (0, 4)


@pytest.mark.parametrize("kind", GAUSSIAN)
def test_perfect_detection_without_clutter_finds_all_and_only_the_targets(kind):
    tracker = Stateful(make(kind, detection=1.0, clutter_intensity=0.0, survival=1.0))
    for step in range(10):
        estimate = tracker.step(np.array([[0.0, 1.0 * step], [50.0, -1.0 * step]]))
    assert len(estimate.states) == 2
    assert estimate.expected_number == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize("kind", [*GAUSSIAN, GlobalNearestNeighbor, RawMeasurements, ParticlePHD])
def test_bad_measurements_are_refused_by_name(kind):
    filter_ = make(kind)
    state = filter_.initial(np.zeros((0, 2)))
    with pytest.raises(ValueError, match=r"measurements must be finite, got nan at index \[1, 0\]"):
        filter_.step(state, np.array([[0.0, 0.0], [np.nan, 0.0]]))
    with pytest.raises(ValueError, match=r"measurements must have shape \(number, 2\)"):
        filter_.step(state, np.zeros((3, 4)))
    with pytest.raises(ValueError, match="measurements must have shape"):
        filter_.step(state, np.zeros(3))
    with pytest.raises(ValueError, match="existence 0 or 1"):
        filter_.step(filter_.initial(np.zeros((1, 2, 3))), np.full((1, 2, 3), 0.5))
    with pytest.raises(ValueError, match=r"measurements must be of the state's 1 runs, got 2"):
        filter_.step(filter_.initial(np.zeros((1, 2, 3))), np.zeros((2, 2, 3)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"detection": 1.5}, r"detection must be in \[0, 1\], got 1.5"),
        ({"survival": -0.1}, r"survival must be in \[0, 1\], got -0.1"),
        ({"clutter_intensity": -3.0}, "clutter_intensity must be finite and >= 0, got -3.0"),
        ({"clutter_intensity": np.nan}, "clutter_intensity must be finite"),
        ({"extraction": "best"}, "extraction must be one of threshold, sum, map"),
        ({"gate_probability": 0.0}, "gate_probability must be in"),
        ({"gate_probability": 0.999, "detection": 0.9999}, "loses targets permanently"),
        ({"gate_loss": 0.5}, r"gate_loss must be in \[0, 0.1\], got 0.5"),
        ({"spawn": (Spawn(0.1, np.eye(2)),)}, "spawn noise must have shape"),
        ({"birth": Birth([0.1], np.zeros((1, 2)), np.eye(2))}, "birth means must have 4 entries"),
    ],
)
@pytest.mark.parametrize("kind", GAUSSIAN)
def test_bad_parameters_are_refused_by_name(kind, options, message):
    with pytest.raises(ValueError, match=message):
        make(kind, **options)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Birth([0.0], np.zeros((1, 4)), np.eye(4)), r"weights must be in \(0, 1\]"),
        (lambda: Birth([0.1], np.zeros((1, 4)), np.zeros((4, 4))), "covariances must be positive definite"),
        (lambda: Birth([0.1], np.zeros((1, 4)), np.eye(3)), "covariances must have shape"),
        (lambda: Birth([0.1], np.full((1, 4), np.inf), np.eye(4)), "means must be finite"),
        (lambda: MeasurementBirth(expected=0.0), "expected must be finite and > 0"),
        (lambda: MeasurementBirth(largest=2.0), "largest must be in"),
        (lambda: MeasurementBirth(places=0), "places must be at least 1"),
        (lambda: MeasurementBirth(hidden_deviation=-1.0), "hidden_deviation must be finite and > 0"),
        (lambda: Spawn(0.0, np.eye(4)), r"weight must be in \(0, 1\]"),
        (lambda: Spawn(0.1, np.eye(4), offset=np.zeros(3)), "must match noise of shape"),
        (lambda: Reduction(prune=1.0), "prune must be at least 0 and below 1.0, got 1.0"),
        (lambda: Reduction(components=0), "components must be at least 1"),
        (lambda: Reduction(candidates=0), "candidates must be at least 1"),
        (lambda: GMCBMeMBer(HMM, PLACE, clutter_intensity=0.0, largest_existence=1.0), "largest_existence must be in"),
        (lambda: ParticlePHD(HMM, PLACE, 0.0, cluster_iterations=0), "cluster_iterations must be at least 1"),
        (lambda: PMB(HMM, PLACE, clutter_intensity=0.0, undetected=0), "undetected must be at least 1"),
        (lambda: RowAllocation(0, (0,)), "rows and columns must not be empty"),
        (lambda: GlobalNearestNeighbor(HMM, confirm=(4, 3)), r"confirm must be \(M, N\)"),
        (lambda: GlobalNearestNeighbor(HMM, gate_probability=1.0), "gate_probability must be in"),
        (lambda: GlobalNearestNeighbor(HMM, misses=0), "misses must be from 1 to 60"),
        (lambda: GlobalNearestNeighbor(HMM, capacity=0), "capacity must be at least 1"),
        (lambda: GlobalNearestNeighbor(HMM, hidden_deviation=0.0), "hidden_deviation must be finite and > 0"),
        (lambda: ParticlePHD(S1, PLACE, 0.0), "model must be a hidden Markov model"),
        (lambda: ParticlePHD(HMM, PLACE, 0.0, capacity=10), "capacity must be above birth_particles"),
        (lambda: ParticlePHD(HMM, PLACE, 0.0, particles=0), "particles must be at least 1"),
        (lambda: ParticlePHD(HMM, PLACE, 0.0, detection=2.0), r"detection must be in \[0, 1\], got 2.0"),
        (lambda: RangeBearingModel(np.eye(4), np.eye(4), np.eye(3, 4), np.eye(3)), "position must select 2"),
        (lambda: RangeBearingModel(np.eye(4), np.eye(4), np.eye(2, 4), np.eye(2), (np.nan, 0.0)), "sensor must be two"),
    ],
)
def test_bad_parts_are_refused_by_name(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_covariance_that_breaks_is_an_error_that_says_what_to_check():
    # So little noise beside so wide a birth that rounding leaves nothing of it.
    model = HiddenMarkovModel(np.eye(2), 1e-30 * np.eye(2), np.array([[1.0, 1.0], [1.0, -1.0]]), 1e-30 * np.eye(2))
    birth = Birth([0.1], np.zeros((1, 2)), 1e12 * np.array([[1.0, 1.0 - 1e-12], [1.0 - 1e-12, 1.0]]))
    tracker = Stateful(GMPHD(model, birth, clutter_intensity=0.0))
    try:
        for _ in range(20):
            estimate = tracker.step(np.array([[1.0, 1e-9]]))
            assert np.all(np.isfinite(estimate.states))
    except ValueError as error:
        assert "not positive definite" in str(error) and "process_noise" in str(error)


MEMORY_SLACK = 150_000
"""Bytes that the interpreter's and the compiler's own caches may still take after a tenth of a run."""


def memory_growth(kind, steps):
    """Bytes by which the memory in use grows from the first tenth of a run to its end."""
    tracker = Stateful(make(kind, S1, clutter_intensity=1e-3))
    # Compiling what only a rare scan calls for takes memory, too: the first run is not measured.
    in_use_at(tracker, 1000)
    tracker.reset()
    tracemalloc.start()
    try:
        first, last = in_use_at(tracker, steps)
    finally:
        tracemalloc.stop()
    return last - first


def in_use_at(tracker, steps):
    """Traced bytes in use after a tenth of the steps and after all."""
    rng = np.random.default_rng(0)
    in_use = []
    for step in range(steps):
        estimate = tracker.step(rng.uniform(-50.0, 100.0, (rng.poisson(3), 2)))
        if step in (steps // 10, steps - 1):
            assert np.all(np.isfinite(estimate.states))
            del estimate
            gc.collect()
            in_use.append(tracemalloc.get_traced_memory()[0])
    return in_use


@pytest.mark.parametrize("kind", [*GAUSSIAN, GlobalNearestNeighbor])
def test_memory_does_not_grow(kind):
    assert memory_growth(kind, 1000) < MEMORY_SLACK


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*GAUSSIAN, GlobalNearestNeighbor])
def test_memory_does_not_grow_in_a_hundred_thousand_steps(kind):
    assert memory_growth(kind, 100_000) < MEMORY_SLACK
