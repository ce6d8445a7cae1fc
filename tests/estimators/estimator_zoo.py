"""All estimators of the package by name, with the inputs that `check_estimator` gives them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.servo.anchors import FixedJacobian
from servotrack.estimators import boxes, color, detect, follow, jacobian, rfs, sonar
from servotrack.estimators.jacobian.lifted import SWINGING_MODELS
from servotrack.estimators.testing import BoxInputs, FollowerInputs, InformedInputs, Inputs, ScanInputs, ServoInputs

HMM = rfs.constant_velocity(5.0, 1.5)
PMM = rfs.pairwise_structure(HMM, "S1")
NOISE = np.diag([4.0, 1e-4])
EKF = rfs.RangeBearingModel(HMM.transition, HMM.process_noise, HMM.observation, NOISE, transform="ekf")
UKF = rfs.RangeBearingModel(HMM.transition, HMM.process_noise, HMM.observation, NOISE, transform="ukf")
PLACES = rfs.Birth([0.1, 0.1], np.array([[0.0, 0.0, 0.0, 0.0], [50.0, 0.0, 0.0, 0.0]]), 100.0 * np.eye(4))
ANYWHERE = rfs.MeasurementBirth()
CAPS: dict[str, Any] = {
    "hypotheses": 50,
    "assignments": 50,
    "targets": 20,
    "reduction": rfs.Reduction(components=5, tracks=100),
}
COARSE: dict[str, Any] = {"beams": 91, "rates": (-8.0, -4.0, 0.0, 4.0, 8.0), "window": 6, "lag": 2}


class Kind(NamedTuple):
    """An estimator for the checks.

    Attributes:
        estimator: The estimator.
        inputs: Its inputs for a given number of rows of a batch, where the family has batches; None: the default.
        sequences: Number of drawn sequences or batches in the default run.
        steps: Number of steps of each.
        skip: Checks that cannot hold.
    """

    estimator: Any
    inputs: Callable[[int], Inputs] | None = None
    sequences: int = 1
    steps: int = 5
    skip: tuple[str, ...] = ()


class UnseenInputs(ServoInputs):
    """Measurements of estimators whose `error_variance` is infinite for features that were never seen."""

    may_be_infinite = ServoInputs.may_be_infinite | {"error_variance"}


def _servo(estimator: Any) -> Kind:
    return Kind(estimator, lambda rows: ServoInputs(batch=(rows,)))


def _scans(estimator: Any, *, polar: bool = False, steered: bool = False) -> Kind:
    return Kind(estimator, lambda rows: ScanInputs(batch=rows, polar=polar, steered=steered), steps=4)


def _filters() -> dict[str, Kind]:
    found = {}
    kinds = {"phd": rfs.GMPHD, "cbmember": rfs.GMCBMeMBer, "lmb": rfs.LMB, "pmb": rfs.PMB}
    for name, model in {"hmm": HMM, "pmm": PMM, "ekf": EKF, "ukf": UKF}.items():
        polar = name in ("ekf", "ukf")
        for label, kind in kinds.items():
            found[f"{label}-{name}"] = _scans(kind(model, ANYWHERE, clutter_intensity=1e-4), polar=polar)
        found[f"cphd-{name}"] = _scans(rfs.GMCPHD(model, ANYWHERE, clutter_intensity=1e-4), polar=polar)
        found[f"pmbm-{name}"] = _scans(rfs.PMBM(model, ANYWHERE, clutter_intensity=1e-4, **CAPS), polar=polar)
        # One of each has tables that grow, the others small ones with fewer rows than some scenes have tracks.
        tables = {} if name == "hmm" else {"reduction": rfs.Reduction(tracks=24)}
        smoother = rfs.TrajectoryPMB(model, ANYWHERE, clutter_intensity=1e-4, lag=2, **tables)
        found[f"trajectory-pmb-{name}"] = _scans(smoother, polar=polar)
        robust = rfs.RobustPMB(
            model,
            rfs.Births(PLACES, ANYWHERE),
            clutter_intensity=1e-4,
            volume=4e4,
            modes=rfs.maneuvers(model),
            **tables,
        )
        found[f"robust-pmb-{name}"] = _scans(robust, polar=polar)
        found[f"gnn-{name}"] = _scans(rfs.GlobalNearestNeighbor(model), polar=polar)
        found[f"raw-{name}"] = _scans(rfs.RawMeasurements(model), polar=polar)
    few = {"particles": 50, "birth_particles": 50, "capacity": 500}
    steered = rfs.SteeredPHD(rfs.GMPHD(HMM, PLACES, clutter_intensity=1e-4))
    return found | {
        "phd-spawn": _scans(rfs.GMPHD(HMM, PLACES, spawn=(rfs.Spawn(0.05, np.eye(4)),), clutter_intensity=1e-4)),
        "robust-trajectory-pmb": _scans(
            rfs.RobustTrajectoryPMB(
                rfs.RobustPMB(
                    PMM, rfs.Births(PLACES, ANYWHERE), clutter_intensity=1e-4, volume=4e4, modes=rfs.maneuvers(PMM)
                ),
                lag=2,
            )
        ),
        "pmbm-large": _scans(rfs.PMBM(HMM, ANYWHERE, clutter_intensity=1e-4)),
        "smc-phd": _scans(rfs.ParticlePHD(HMM, PLACES, clutter_intensity=1e-4, **few)),
        "smc-phd-range": _scans(rfs.ParticlePHD(EKF, PLACES, clutter_intensity=1e-4, **few), polar=True),
        "steered": _scans(steered, steered=True),
        "steady": _scans(rfs.SteadyPHD(steered)),
        "counting": _scans(rfs.CountingPHD(steered, clutter_rate=3.0)),
    }


def _box_filter(kind: Any, sizes: bool) -> boxes.BoxSetFilter:
    if sizes:
        return boxes.BoxSetFilter(kind(boxes.box_model(1.0, 3.0, 0.5, 4.0), ANYWHERE, clutter_intensity=1e-9), "box")
    return boxes.BoxSetFilter(kind(boxes.centroid_model(1.0, 3.0), ANYWHERE, clutter_intensity=1e-5))


def _boxes(estimator: Any) -> Kind:
    return Kind(estimator, lambda _: BoxInputs(), sequences=2)


ZOO: dict[str, Kind] = {
    "fixed": _servo(FixedJacobian()),
    "broyden": _servo(jacobian.BroydenJacobian()),
    "rls": _servo(jacobian.RecursiveLeastSquares()),
    "kf": _servo(jacobian.KalmanJacobian()),
    "full-kf": _servo(jacobian.FullKalmanJacobian()),
    "level-kf": _servo(jacobian.LevelKalmanJacobian()),
    "student-t-kf": _servo(jacobian.KalmanJacobian(outliers=jacobian.StudentTNoise())),
    "correntropy-kf": _servo(jacobian.KalmanJacobian(outliers=jacobian.CorrentropyNoise())),
    "ukf": _servo(jacobian.UnscentedJacobian()),
    "ukf-as-printed": _servo(jacobian.UnscentedJacobian(walk=jacobian.RandomWalk(5.0, 5.0), as_printed=True)),
    "pf": _servo(jacobian.ParticleJacobian(particles=60)),
    "parametric-ekf": _servo(jacobian.HypothesisBank(jacobian.ParametricKalman(), jacobian.Mountings(3))),
    "parametric-ukf": _servo(jacobian.ParametricKalman(unscented=True)),
    "lifted": _servo(jacobian.LiftedKalman()),
    "lifted-swinging": _servo(jacobian.LiftedKalman(models=SWINGING_MODELS)),
    "latency-bank": _servo(jacobian.HypothesisBank(jacobian.KalmanJacobian(), jacobian.Latencies())),
    "chain": Kind(jacobian.ChainJacobian(keyframes=8), lambda rows: UnseenInputs(joints=3, features=4, batch=(rows,))),
    "chain-bank": Kind(
        jacobian.ChainBank(jacobian.ChainJacobian(keyframes=8), plays=(0.0, 0.02)),
        lambda rows: UnseenInputs(joints=3, features=4, batch=(rows,)),
    ),
    "informed": Kind(jacobian.InformedKalman(), lambda rows: InformedInputs(batch=(rows,))),
    "adaptive": Kind(jacobian.AdaptiveKalmanJacobian(), lambda rows: ServoInputs(joints=3, features=4, batch=(rows,))),
    "feature-wise": _servo(jacobian.FeatureWise(jacobian.KalmanJacobian())),
    "play-bank": Kind(
        jacobian.EstimatorBank(
            tuple(jacobian.AdaptiveKalmanJacobian(alignment=jacobian.Alignment(play=play)) for play in (0.0, 0.02))
        ),
        lambda rows: ServoInputs(joints=3, features=4, batch=(rows,)),
    ),
    "controller-any": Kind(jacobian.ServoController(), lambda rows: ServoInputs(joints=5, features=8, batch=(rows,))),
    "controller-pi": _servo(jacobian.ServoController(jacobian.KalmanJacobian())),
    "controller-exact": _servo(jacobian.ServoController(jacobian.LiftedKalman(), jacobian.OneStepExact())),
    "controller-damped": _servo(
        jacobian.ServoController(jacobian.RecursiveLeastSquares(), jacobian.DampedLeastSquares())
    ),
    "controller-3-joints": Kind(
        jacobian.ServoController(jacobian.LevelKalmanJacobian(), jacobian.Proportional()),
        lambda rows: ServoInputs(joints=3, features=4, batch=(rows,)),
    ),
    **_filters(),
    "box-pmb": _boxes(boxes.BoxPMB(frame_size=(384, 288))),
    "box-hungarian": _boxes(boxes.KalmanHungarian()),
    "box-raw": _boxes(boxes.RawDetections()),
    "box-phd": _boxes(_box_filter(rfs.GMPHD, sizes=False)),
    "box-sizes-pmb": _boxes(_box_filter(rfs.PMB, sizes=True)),
    "box-gnn": _boxes(boxes.BoxSetFilter(rfs.GlobalNearestNeighbor(boxes.centroid_model(1.0, 3.0)))),
    "kept-pmb": _boxes(boxes.KeptIdentities(boxes.BoxPMB())),
    "kept-phd": _boxes(boxes.KeptIdentities(_box_filter(rfs.GMPHD, sizes=False))),
    "masked": Kind(detect.MaskedBackground()),
    "masked-otsu": Kind(detect.MaskedBackground(threshold="otsu", shadows=True)),
    "masked-paper": Kind(detect.MaskedBackground.paper()),
    "mog2": Kind(detect.MOG2Background()),
    "knn": Kind(detect.KNNBackground()),
    "detect-then-track": Kind(boxes.DetectThenTrack(detect.MaskedBackground(), boxes.BoxPMB())),
    "marker": Kind(detect.MarkerDetector()),
    "people-from-above": Kind(follow.PeopleFromAbove(), steps=3),
    "monte-carlo": Kind(color.MonteCarloColor(samples=40)),
    "monte-carlo-plus": Kind(color.MonteCarloColorPlus(samples=40)),
    "particle-filter": Kind(color.ColorParticleFilter(samples=40)),
    "mean-shift": Kind(color.KernelMeanShift()),
    "cv-mean-shift": Kind(color.BackProjection()),
    "cam-shift": Kind(color.BackProjection(method="camshift")),
    # OpenCV seeds it by the clock, so no two runs can be compared.
    "mil": Kind(color.OpenCVTracker(), steps=3, sequences=1, skip=("repeat", "arrays", "unseen", "refusals")),
    "follower": Kind(follow.PersonFollower(), lambda rows: FollowerInputs(batch=min(rows, 3)), steps=4),
    "peak-nearest": Kind(sonar.PeakNearestNeighbor(beams=91)),
    "peak-kalman": Kind(sonar.PeakKalmanHungarian(beams=91)),
    "sonar-row": Kind(sonar.HMMBearings(**COARSE), sequences=1, steps=3),
    "sonar-cell": Kind(sonar.HMMBearings(**COARSE, likelihood="cell"), sequences=1, steps=3),
    "sonar-nulling": Kind(sonar.ViterbiNulling(**COARSE), sequences=1, steps=3),
}
"""Shipped estimators, some with fewer particles, beams or rates than by default so that the checks are fast."""
