"""Steered GM-PHD filter: a network reads the filter's statistics and sets its parameters for the next scan."""

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
from servotrack.estimators.rfs.steered import SteadyPHD, SteeredPHD, SteeredState, Steering, constant_detection
from servotrack.estimators.types import Array, FloatArray, Labels

PARAMETERS = 3
"""Length of the network's answer; its entries are in [-1, 1]."""
DETECTION_REACH, CLUTTER_REACH, BIRTHS_REACH = 4.0, 2.5, 5.0
"""Change of the log odds of p_D, the log clutter rate and the log births for an answer of 1."""
DEFAULT_BIRTHS = SteadyPHD.births
"""Expected births at unexplained measurements for an answer of 0, which makes the filter a `SteadyPHD`."""
MEMORIES = (4.0, 30.0)
"""Time constants of the fading means of the counts, scans."""
COUNTS = 4
"""Entries of an `Account`."""
SCAN_UNIT = 50.0
"""Unit of the number of scans in a row, which saturates at 2 units."""


class SteeringMemory(NamedTuple):
    """Memory of a `SteeringEncoding`.

    Attributes:
        belief: State of the filter.
        rows: Owners of the rows of the answer.
        scan: Measurements that the next `act` processes. Shape (N, M, 1 + m).
        sums: Fading sums of the counts (4) and of the number of scans (1). Shape (N, memories, 5).
        answer: Last answer of the network. Shape (N, 3).
        scans: Number of scans so far. Shape (N,).
    """

    belief: SteeredState
    rows: ReservedRows
    scan: Array
    sums: Array
    answer: Array
    scans: Labels


@dataclass(frozen=True, eq=False)
class SteeringEncoding:
    """Encodes the statistics of a steered filter as rows, and the network's answers as parameters of its next step.

    A row holds the logarithms of the number of measurements and of the last step's `Account`; then for each memory the
    means of the account's entries, as logarithms, and the share of the expected targets that was explained; the last
    answer; the logarithm of the scene model's clutter rate and the log odds of its detection probability; and the
    number of scans so far.

    Attributes:
        steered: The filter.
        answer_rows: Number of rows of the environment's action.
        clutter_rate: Clutter rate of the scene model, measurements per scan.
    """

    steered: SteeredPHD
    answer_rows: int
    clutter_rate: float

    @property
    def size(self) -> int:
        """Length of a row."""
        return 1 + COUNTS + len(MEMORIES) * (COUNTS + 1) + PARAMETERS + 3

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the space of the network's answers."""
        return spaces.Box(-1.0, 1.0, (PARAMETERS,), np.float32)

    @property
    def _allocation(self) -> RowAllocation:
        return RowAllocation(self.answer_rows, POSITION)

    def initial(self, observation: Any) -> SteeringMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        scan = _scan(observation)
        count = len(scan)
        n = self.steered.filter.model.packed.observation.shape[1]
        return SteeringMemory(
            self.steered.initial(scan),
            no_rows(self._allocation, count, n),
            scan,
            np.zeros((count, len(MEMORIES), COUNTS + 1)),
            np.zeros((count, PARAMETERS)),
            np.zeros(count, np.int64),
        )

    def step(self, memory: SteeringMemory, observation: Any, action: Any) -> tuple[SteeringMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
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
            np.full((count, 1), 0.5 * _log_odds(constant_detection(self.steered))),
            np.minimum(memory.scans / SCAN_UNIT, 2.0)[:, None],
        ]
        return memory._replace(scan=scan), np.concatenate(parts, axis=1).astype(np.float32)

    def act(self, memory: SteeringMemory, answer: FloatArray) -> tuple[SteeringMemory, Array]:
        """Process the scan with the answered parameters and report the estimate; see `Encoding.act`."""
        answers = np.clip(np.asarray(answer, np.float64), -1.0, 1.0)
        belief, estimate = self.steered.step(memory.belief, memory.scan, self.steering(answers))
        rows, reported = allocate_rows(self._allocation, memory.rows, estimate)
        account = np.stack([*belief.account, np.ones(len(answers))], axis=-1)
        kept = np.exp(-1.0 / np.array(MEMORIES))
        sums = kept[:, None] * memory.sums + account[:, None]
        return SteeringMemory(belief, rows, memory.scan, sums, answers, memory.scans + 1), reported

    def steering(self, answers: Array) -> Steering:
        """Return the parameters for answers of shape (N, 3); 0 keeps those of the scene model."""
        odds = _log_odds(constant_detection(self.steered)) + DETECTION_REACH * answers[:, 0]
        return Steering(
            np.minimum(1.0 / (1.0 + np.exp(-odds)), 0.9999),
            np.exp(CLUTTER_REACH * answers[:, 1]),
            DEFAULT_BIRTHS * np.exp(BIRTHS_REACH * answers[:, 2]),
        )


def _log_odds(probability: float) -> float:
    return float(np.log(probability / (1.0 - probability)))


def _scan(observation: Any) -> Array:
    whole = observation[OBSERVATION_KEY] if isinstance(observation, Mapping) else observation
    return np.asarray(whole, np.float64)


def create_steering(env: Any) -> SteeringEncoding:
    """Create the encoding of a steered filter for points in clutter.

    Raises:
        ValueError: An environment without a `SceneModel`.
    """
    scene = public_attribute(env, "scene_model")
    if not isinstance(scene, SceneModel):
        raise ValueError(
            f"encoding steering needs an environment whose `unwrapped.scene_model` is a SceneModel, got {env.unwrapped}"
        )
    if scene.lag:
        raise ValueError(f"encoding steering answers at once: lag must be 0, got {scene.lag}")
    rows = getattr(env, "single_action_space", env.action_space).shape[0]
    return SteeringEncoding(steered_phd(scene, observer_settings(rows)), rows, scene.clutter_rate)
