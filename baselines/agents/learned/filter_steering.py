"""A GM-PHD filter that a network steers: it sees what the filter counts, and sets the parameters of the next scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from servotrack.baselines.agents.clutter.catalog import observer_settings, steered_phd
from servotrack.baselines.agents.row_reservation import ReservedRows, allocate_rows, no_rows
from servotrack.baselines.agents.set_observer import POSITION
from servotrack.baselines.worlds import public_attribute
from servotrack.envs.track.clutter.scene_model import SceneModel
from servotrack.envs.wrappers import OBSERVATION_KEY
from servotrack.estimators.rfs import RowAllocation
from servotrack.estimators.rfs.steered import SteadyPHD, SteeredPHD, SteeredState, Steering, told_detection
from servotrack.estimators.types import Array, FloatArray, Labels

KNOBS = 3
"""Numbers of the network's answer, each in [-1, 1]."""
DETECTION_REACH, CLUTTER_REACH, BIRTHS_REACH = 4.0, 2.5, 5.0
"""What an answer of 1 adds to the log odds of p_D, to the logarithm of the clutter and to that of the births."""
USUAL_BIRTHS = SteadyPHD.births
"""Expected births where measurements are unexplained, for an answer of 0: who answers 0 is `SteadyPHD`."""
MEMORIES = (4.0, 30.0)
"""Scans after which counts weigh 1/e."""
COUNTS = 4
"""Entries of an `Account`."""
PERIODS = 50.0
"""Scans are counted in units of so many, to 2."""


class SteeringMemory(NamedTuple):
    """Memory of a `SteeringEncoding`.

    Attributes:
        belief: Of the filter.
        rows: Which identity owns which row of the answer.
        scan: The measurements that the next `act` folds in. Shape (N, M, 1 + m).
        sums: What was counted, as it fades, and how many scans that are. Shape (N, memories, 5).
        answer: Of the network, the last one. Shape (N, 3).
        scans: So far. Shape (N,).
    """

    belief: SteeredState
    rows: ReservedRows
    scan: Array
    sums: Array
    answer: Array
    scans: Labels


@dataclass(frozen=True, eq=False)
class SteeringEncoding:
    """What a steered filter counts, as rows; what a network answers, as parameters of the filter's next step.

    A row holds the logarithms of the number of measurements and of the last step's `Account`; then for each memory the
    means of the account's entries, as logarithms, and the share of the expected targets that was explained; the last
    answer; the logarithm of the clutter rate and the log odds of the detection probability that were told; and how
    many scans there have been.

    Attributes:
        steered: The filter.
        answer_rows: FloatArray of the environment's action.
        clutter_rate: That was told.
    """

    steered: SteeredPHD
    answer_rows: int
    clutter_rate: float

    @property
    def size(self) -> int:
        """Numbers in a row."""
        return 1 + COUNTS + len(MEMORIES) * (COUNTS + 1) + KNOBS + 3

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """What the network answers."""
        return spaces.Box(-1.0, 1.0, (KNOBS,), np.float32)

    @property
    def _allocation(self) -> RowAllocation:
        return RowAllocation(self.answer_rows, POSITION)

    def initial(self, observation: Any) -> SteeringMemory:
        """As `Encoding.initial`."""
        scan = _scan(observation)
        count = len(scan)
        n = self.steered.filter.model.packed.observation.shape[1]
        return SteeringMemory(
            self.steered.initial(scan),
            no_rows(self._allocation, count, n),
            scan,
            np.zeros((count, len(MEMORIES), COUNTS + 1)),
            np.zeros((count, KNOBS)),
            np.zeros(count, np.int64),
        )

    def step(self, memory: SteeringMemory, observation: Any, action: Any) -> tuple[SteeringMemory, FloatArray]:
        """As `Encoding.step`."""
        scan = _scan(observation)
        counts = np.stack(memory.belief.account, axis=-1)
        seen = memory.sums[..., COUNTS:]
        means = memory.sums[..., :COUNTS] / np.maximum(seen, 1e-9)
        shares = (memory.sums[..., 1:2] + 1e-3) / (memory.sums[..., 0:1] + 1e-3)
        faded = np.concatenate([np.log1p(means), np.minimum(shares, 2.0)], axis=-1)
        count = len(scan)
        parts = [
            np.log1p(scan[..., 0].sum(axis=-1))[:, None],
            np.log1p(counts),
            faded.reshape(count, -1),
            memory.answer,
            np.full((count, 1), np.log(self.clutter_rate)),
            np.full((count, 1), 0.5 * _log_odds(told_detection(self.steered))),
            np.minimum(memory.scans / PERIODS, 2.0)[:, None],
        ]
        return memory._replace(scan=scan), np.concatenate(parts, axis=1).astype(np.float32)

    def act(self, memory: SteeringMemory, answer: FloatArray) -> tuple[SteeringMemory, Array]:
        """As `Encoding.act`: fold the scan in with the parameters that were answered, and report what is believed."""
        knobs = np.clip(np.asarray(answer, np.float64), -1.0, 1.0)
        belief, estimate = self.steered.step(memory.belief, memory.scan, self.steering(knobs))
        rows, reported = allocate_rows(self._allocation, memory.rows, estimate)
        account = np.stack([*belief.account, np.ones(len(knobs))], axis=-1)
        kept = np.exp(-1.0 / np.array(MEMORIES))
        sums = kept[:, None] * memory.sums + account[:, None]
        return SteeringMemory(belief, rows, memory.scan, sums, knobs, memory.scans + 1), reported

    def steering(self, knobs: Array) -> Steering:
        """Parameters that an answer means, shape (N, 3); 0 is what was told."""
        odds = _log_odds(told_detection(self.steered)) + DETECTION_REACH * knobs[:, 0]
        return Steering(
            np.minimum(1.0 / (1.0 + np.exp(-odds)), 0.9999),
            np.exp(CLUTTER_REACH * knobs[:, 1]),
            USUAL_BIRTHS * np.exp(BIRTHS_REACH * knobs[:, 2]),
        )


def _log_odds(probability: float) -> float:
    return float(np.log(probability / (1.0 - probability)))


def _scan(observation: Any) -> Array:
    whole = observation[OBSERVATION_KEY] if isinstance(observation, Mapping) else observation
    return np.asarray(whole, np.float64)


def create_steering(env: Any) -> SteeringEncoding:
    """A steered filter for a world of points in clutter.

    Raises:
        ValueError: The environment is none.
    """
    scene = public_attribute(env, "scene_model")
    if not isinstance(scene, SceneModel):
        raise ValueError(f"encoding steering reads scans of points in clutter, which {env.unwrapped} does not give")
    rows = getattr(env, "single_action_space", env.action_space).shape[0]
    return SteeringEncoding(steered_phd(scene, observer_settings(rows)), rows, scene.clutter_rate)
