"""Every shipped estimator follows the contract, and every check finds the faults that it is for."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from estimator_zoo import ZOO, Kind

from servotrack.estimators.jacobian import KalmanJacobian, ServoMeasurement
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.testing import (
    CHECKS,
    BoxInputs,
    EstimatorFaults,
    Inputs,
    ServoInputs,
    check_estimator,
    inputs_for,
)

FUZZED = int(os.environ.get("SERVOTRACK_FUZZED_SEQUENCES", "2000"))
"""Sequences of each estimator in the slow fuzzer; a million take some days on one core."""
FUZZED_SEED = int(os.environ.get("SERVOTRACK_FUZZED_SEED", "1"))
"""First seed of the slow fuzzer; another one goes on where an earlier run stopped."""
FUZZED_SECONDS = float(os.environ.get("SERVOTRACK_FUZZED_SECONDS", "inf"))
"""Time limit of the slow fuzzer for each estimator, s."""

FOUND = [
    ("parametric-ukf", 4, 50),
    ("controller-damped", 8, 50),
    ("parametric-ukf", 100000, 200),
    ("people-from-above", 5000012, 1),
    ("sonar-row", 5000030, 1),
]
"""Estimators, seeds and rows at which the slow fuzzer found a fault that was mended."""


def inputs_of(kind: Kind, rows: int) -> Inputs:
    return inputs_for(kind.estimator) if kind.inputs is None else kind.inputs(rows)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", ZOO)
def test_every_estimator_follows_the_contract(name: str) -> None:
    kind = ZOO[name]
    inputs = inputs_of(kind, 20)
    check_estimator(kind.estimator, inputs, sequences=kind.sequences, steps=kind.steps, skip=kind.skip)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("name", "seed", "rows"), FOUND)
def test_faults_that_were_found_stay_mended(name: str, seed: int, rows: int) -> None:
    kind = ZOO[name]
    check_estimator(kind.estimator, inputs_of(kind, rows), sequences=1, steps=kind.steps, seed=seed, skip=kind.skip)


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", ZOO)
def test_fuzzed_estimators_keep_the_contract(name: str) -> None:
    kind = ZOO[name]
    inputs = inputs_of(kind, 200)
    done, seed, end = 0, FUZZED_SEED, time.monotonic() + FUZZED_SECONDS
    while done < FUZZED and time.monotonic() < end:
        check_estimator(kind.estimator, inputs, sequences=1, steps=kind.steps, seed=seed, skip=kind.skip)
        done, seed = done + inputs.rows, seed + 1
    print(f"{name}: {done} sequences, next seed {seed}")


class MeanState(NamedTuple):
    count: Any
    mean: Any
    covariance: Any
    time: Any


@dataclass(frozen=True)
class FeatureMean:
    """Mean of the features so far, with one fault."""

    fault: str = ""

    def initial(self, measurement: ServoMeasurement) -> MeanState:
        if self.fault != "reads anything":
            measurement = checked(measurement)
        shape = np.shape(measurement.features)
        covariance = np.tile(np.eye(shape[-1]), (*shape[:-1], 1, 1))
        return MeanState(np.zeros(shape[:-1]), np.zeros(shape), covariance, np.array(measurement.time, np.float64))

    def step(self, state: MeanState, measurement: ServoMeasurement) -> tuple[MeanState, np.ndarray]:
        given = measurement
        if self.fault == "changes the state before it checks":
            state.mean[...] += 1.0
        if self.fault not in ("reads anything", "reads unseen features", "raises a KeyError"):
            measurement = checked(measurement)
        time = np.asarray(measurement.time, dtype=np.float64)
        if self.fault != "reads anything" and (time < state.time).any():
            raise ValueError("bad input" if self.fault == "names nothing" else f"time must not run back, got {time}")
        if self.fault == "raises a KeyError" and not np.isfinite(np.asarray(given.features, np.float64)).all():
            raise KeyError("features")
        if self.fault == "names nothing":
            try:
                checked(given)
            except ValueError:
                raise ValueError("bad input") from None
        if self.fault == "changes the state":
            state.mean[...] += 1.0
        features = np.asarray(measurement.features, dtype=np.float64)
        if self.fault == "computes in the given type":
            features = (np.asarray(given.features) * np.asarray(given.features)).astype(np.float64)
        if self.fault == "depends on the layout" and np.asarray(given.features).dtype.byteorder == ">":
            features = features + 1.0
        if self.fault == "random":
            features = features + np.random.default_rng().normal(size=features.shape)
        visible = np.asarray(measurement.visible, np.bool_)
        if self.fault == "reads unseen features":
            visible = np.ones_like(visible)
        used = np.where(visible[..., None], features, 0.0)
        count = state.count + visible
        mean = state.mean + (used - state.mean) * (visible / np.maximum(count, 1.0))[..., None]
        covariance = state.covariance.copy()
        if self.fault == "NaN":
            mean = mean / np.where(count > 3.0, 0.0, 1.0)[..., None]
        if self.fault == "indefinite":
            covariance[..., 0, 1] = covariance[..., 1, 0] = 1.1
        if self.fault == "asymmetric":
            covariance[..., 0, 1] = 0.1
        if self.fault == "overflows":
            mean = mean * np.where(np.abs(used).max() > 1e6, np.inf, 1.0)
        return MeanState(count, mean, covariance, time), mean.copy()


FAULTS = {
    "NaN": "finite",
    "indefinite": "finite",
    "asymmetric": "finite",
    "overflows": "extreme",
    "changes the state": "values",
    "random": "repeat",
    "computes in the given type": "arrays",
    "depends on the layout": "arrays",
    "reads unseen features": "unseen",
    "reads anything": "refusals",
    "names nothing": "refusals",
    "raises a KeyError": "refusals",
    "changes the state before it checks": "refusals",
}


def faults_of(estimator: Any, **options: Any) -> dict[str, str]:
    with pytest.raises(EstimatorFaults) as caught:
        check_estimator(estimator, **options)
    return caught.value.faults


def test_a_correct_estimator_of_a_user_passes() -> None:
    check_estimator(FeatureMean())
    check_estimator(FeatureMean(), ServoInputs(joints=3, features=4, batch=(2, 2)), sequences=3)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_found_by_its_check(fault: str) -> None:
    faults = faults_of(FeatureMean(fault), sequences=4)
    assert FAULTS[fault] in faults, faults


def test_every_check_has_a_fault_that_it_finds() -> None:
    assert set(FAULTS.values()) == set(CHECKS)


def test_a_fault_says_where_and_can_be_skipped() -> None:
    faults = faults_of(FeatureMean("indefinite"), skip=("extreme",))
    assert faults.keys() == {"finite"}
    assert faults["finite"].startswith("sequence 0 of seed 0: step 1: state.covariance is indefinite")


def test_arguments_of_the_checker_are_checked() -> None:
    with pytest.raises(ValueError, match="skip contains unknown checks"):
        check_estimator(KalmanJacobian(), skip=("nothing",))
    with pytest.raises(ValueError, match="steps must be at least 2, got 1"):
        check_estimator(KalmanJacobian(), steps=1)
    with pytest.raises(ValueError, match="inputs must be given for Odd"):
        check_estimator(Odd())


class Odd:
    def initial(self, something: Any) -> None: ...


def test_inputs_follow_the_arguments_of_initial() -> None:
    assert isinstance(inputs_for(KalmanJacobian()), ServoInputs)
    assert isinstance(inputs_for(ZOO["box-pmb"].estimator), BoxInputs)
    assert replace(inputs_for(ZOO["pmb-ekf"].estimator), batch=0).polar  # type: ignore[type-var,attr-defined]
