"""Process that measures the rate of Stone Soup's GM-PHD filter on stored scans, or prints its estimates.

It runs in a virtual environment that has Stone Soup. Settings are those of our own filter: the same model, births,
probabilities, pruning, merging and largest number of components.
"""

from __future__ import annotations

import datetime
import json
import sys
import time
from typing import Any

import numpy as np
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
from stonesoup.measures import Mahalanobis
from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.state import TaggedWeightedGaussianState
from stonesoup.updater.kalman import KalmanUpdater
from stonesoup.updater.pointprocess import PHDUpdater

START = datetime.datetime(2000, 1, 1)
SURVIVAL, DETECTION, BIRTH_WEIGHT = 0.99, 0.98, 0.03
GATE = 4.13
"""Mahalanobis distance that a share of 2e-4 of two-dimensional measurements exceed: our filter's gate at p_D = 0.98."""


class StoneSoupPHD:
    """GM-PHD filter with the model of the stored scans.

    Args:
        stored: Arrays that `set_filters.write_scans` wrote.
    """

    def __init__(self, stored: Any) -> None:
        sigma_v, sigma_w = (float(value) for value in stored["noise"])
        F = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
        Q = np.kron(np.eye(2), sigma_v**2 * np.array([[1.0 / 3.0, 0.5], [0.5, 1.0]]))
        transition = LinearGaussianTimeInvariantTransitionModel(transition_matrix=F, covariance_matrix=Q)
        self.sensor = LinearGaussian(4, (0, 2), sigma_w**2 * np.eye(2))
        kalman = KalmanUpdater(self.sensor)
        self.updater = PHDUpdater(
            kalman,
            clutter_spatial_density=float(stored["clutter_intensity"]),
            prob_detection=DETECTION,
            prob_survival=SURVIVAL,
        )
        pairs = DistanceHypothesiser(KalmanPredictor(transition), kalman, Mahalanobis(), missed_distance=GATE)
        self.hypothesiser = GaussianMixtureHypothesiser(pairs, order_by_detection=True)
        self.reducer = GaussianMixtureReducer(prune_threshold=1e-5, merge_threshold=4.0, max_number_components=100)
        self.sites = stored["sites"]

    def run(self, scans: list[Any]) -> list[list[list[float]]]:
        """Filter all scans and return the positions reported after each one, m."""
        mixture: list[Any] = []
        answers = []
        for k, scan in enumerate(scans):
            now = START + datetime.timedelta(seconds=k + 1)
            detections = {Detection(z[:, None], timestamp=now, measurement_model=self.sensor) for z in scan}
            for x, y in self.sites:
                mixture.append(
                    TaggedWeightedGaussianState(
                        np.array([[x], [0.0], [y], [0.0]]),
                        100.0 * np.eye(4),
                        weight=BIRTH_WEIGHT,
                        tag=TaggedWeightedGaussianState.BIRTH,
                        timestamp=now,
                    )
                )
            updated = self.updater.update(self.hypothesiser.hypothesise(mixture, detections, now))
            mixture = list(self.reducer.reduce(list(updated.components)))
            heavy = [np.ravel(c.state_vector) for c in mixture if c.weight > 0.5]
            answers.append([[float(state[0]), float(state[2])] for state in heavy])
        return answers


def main(job: str, path: str) -> None:
    """Serve scans per second with `rate FILE`; print positions as JSON with `estimates FILE`."""
    stored = np.load(path)
    scans = np.split(stored["scan"], np.cumsum(stored["count"])[:-1])
    phd = StoneSoupPHD(stored)
    if job == "estimates":
        print(json.dumps(phd.run(scans)))
        return
    phd.run(scans[:10])
    print("ready", flush=True)
    for line in sys.stdin:
        duration, done, start = float(line), 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            phd.run(scans)
            done += len(scans)
        print(done / elapsed, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
