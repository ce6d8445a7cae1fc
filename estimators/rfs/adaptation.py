"""Detection probability and clutter rate estimated beside a multi-Bernoulli filter, by Beta and Gamma densities.

Belief propagation gives for every scan the probability of each measurement to be clutter, and for every track i the
probabilities d_i of being detected and q_i of being alive and missed. With forgetting g,

    detection   Beta(s, u):   s <- g s + sum_i d_i,   u <- g u + sum_i q_i,   p_D = s / (s + u)
    clutter     Gamma(a, b):  a <- g a + sum_z pi_z,  b <- g b + 1,           rate = a / b

A miss and a death look alike in the scan in which they happen: right after a death q_i is far too large, p_D falls, and
in turn deaths are found late. So d_i and q_i are counted `lag` scans later, given all measurements until then. Death is
final, hence what happened at scan k splits into two masses that are passed on from scan to scan: the target is still
alive, or it has died since. A prediction moves the share 1 - p_S of the first mass to the second. An update multiplies
the first by r' / r and the second by (1 - r') / (1 - r), r and r' the existence before and after the scan. Only tracks
of r above one half *before* scan k count; a choice by r' would prefer detected targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.pmb_kernel import Tally
from servotrack.estimators.types import Array


class SensorState(NamedTuple):
    """Densities of the detection probability and of the clutter rate.

    Attributes:
        found: s of Beta(s, u), detections. Shape (*batch,).
        missed: u of Beta(s, u), missed detections. Shape (*batch,).
        false: a of Gamma(a, b), false measurements. Shape (*batch,).
        scans: b of Gamma(a, b), scans. Shape (*batch,).
        pending: Probabilities that each track was missed (row 0) or found (row 1), and is alive now (column 0) or has
            died since (column 1), for each of the last `lag` scans, the newest first. Shape (*batch, T, lag, 2, 2).
    """

    found: Array
    missed: Array
    false: Array
    scans: Array
    pending: Array

    @property
    def detection(self) -> Array:
        """Mean detection probability. Shape (*batch,)."""
        return self.found / (self.found + self.missed)

    @property
    def clutter_rate(self) -> Array:
        """Mean number of false measurements per scan. Shape (*batch,)."""
        return self.false / self.scans


@dataclass(frozen=True)
class SensorAdaptation:
    """Parameters of the online estimate of detection probability and clutter rate.

    Args:
        memory: Time constant of forgetting, scans: g = exp(-1 / memory); typically 30 to 100. Raising it makes the
            estimates steadier and slower. At the start of a run the time constant is 2 b, and grows to this value.
        lag: Scans until a miss is counted, at least 1. Raising it tells misses from deaths more surely.
        target_trust: Number of targets' scans that the given detection probability counts for. Raising it keeps the
            estimate near that value for longer.
        scan_trust: Number of scans that the given clutter rate counts for. Raising it keeps the estimate near that
            value for longer.
        detection_limits: Lower and upper limit of the detection probability that a filter uses. At 0.99 one miss means
            death as probably as not (for p_S = 0.99), so raising the upper limit ends tracks at chance misses.
        least_clutter: Lower limit of the clutter rate, false measurements per scan.

    Raises:
        ValueError: An argument is out of range.
    """

    memory: float = 50.0
    lag: int = 5
    target_trust: float = 5.0
    scan_trust: float = 1.0
    detection_limits: tuple[float, float] = (0.05, 0.98)
    least_clutter: float = 0.01

    def __post_init__(self) -> None:
        for name in ("memory", "target_trust", "scan_trust", "least_clutter"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and > 0, got {value!r}")
        if self.lag < 1:
            raise ValueError(f"lag must be at least 1 scan, got {self.lag!r}")
        low, high = self.detection_limits
        if not 0.0 < low <= high < 1.0:
            raise ValueError(f"detection_limits must be ascending inside (0, 1), got {self.detection_limits!r}")

    def initial(self, batch: int, capacity: int, detection: float, clutter_rate: float) -> SensorState:
        """Densities around the given values.

        Args:
            batch: Number of runs.
            capacity: Number of tracks T that the filter's state has room for.
            detection: Given detection probability, in [0, 1].
            clutter_rate: Given mean number of false measurements per scan.
        """
        one = np.ones(batch)
        found = self.target_trust * float(np.clip(detection, *self.detection_limits))
        return SensorState(
            found * one,
            (self.target_trust - found) * one,
            self.scan_trust * max(clutter_rate, self.least_clutter) * one,
            self.scan_trust * one,
            np.zeros((batch, capacity, self.lag, 2, 2)),
        )

    def detection(self, state: SensorState) -> Array:
        """Detection probability of the next scan, shape (B,)."""
        return np.clip(state.detection, *self.detection_limits)

    def clutter_rate(self, state: SensorState) -> Array:
        """Clutter rate of the next scan, shape (B,)."""
        return np.maximum(state.clutter_rate, self.least_clutter)

    def step(self, state: SensorState, before: Array, predicted: Array, after: Array, tally: Tally) -> SensorState:
        """Count one scan.

        Args:
            state: Densities before the scan.
            before: Existence of the tracks after the last scan. Shape (B, T).
            predicted: Existence of the same tracks predicted to this scan. Shape (B, T).
            after: Existence of the new tracks. Shape (B, T').
            tally: Association probabilities of the scan.
        """
        batch, capacity = after.shape
        pending = np.zeros((batch, capacity, self.lag, 2, 2))
        found, missed = np.zeros(batch), np.zeros(batch)
        _count(state.pending, before, predicted, after, tally, pending, found, missed)
        # Early scans were weighed by poor estimates, so the memory starts short and grows by a scan per scan.
        kept = np.exp(-1.0 / np.minimum(self.memory, 2.0 * state.scans))
        # Without targets nothing is learned of p_D, so the density widens to the trust of the start and no further.
        total = state.found + state.missed
        held = np.maximum(kept, np.minimum(1.0, self.target_trust / total))
        return SensorState(
            held * state.found + found,
            held * state.missed + missed,
            kept * state.false + tally.unexplained.sum(axis=1),
            kept * state.scans + 1.0,
            pending,
        )


@njit(cache=True, nogil=True)
def _count(old, before, predicted, after, tally, new, found, missed):  # type: ignore[no-untyped-def]
    """Pass on the pending events, add those of this scan, and count those that leave the lag or lose their track."""
    lag = old.shape[2]
    for b in range(before.shape[0]):
        heir = np.full(before.shape[1], -1, np.int64)
        for t in range(after.shape[1]):
            if tally.origin[b, t] >= 0:
                heir[tally.origin[b, t]] = t
        for i in range(before.shape[1]):
            r = predicted[b, i]
            if before[b, i] <= 0.0:
                continue
            t = heir[i]
            updated = after[b, t] if t >= 0 else 0.0
            survived = min(r / before[b, i], 1.0)
            alive = updated / r if r > 0.0 else 0.0
            ended = (1.0 - updated) / (1.0 - r) if r < 1.0 else 0.0
            for k in range(lag):
                for kind in range(2):
                    lasting = survived * old[b, i, k, kind, 0]
                    gone = (old[b, i, k, kind, 0] - lasting + old[b, i, k, kind, 1]) * ended
                    lasting *= alive
                    if t >= 0 and k + 1 < lag:
                        new[b, t, k + 1, kind, 0], new[b, t, k + 1, kind, 1] = lasting, gone
                    elif kind == 0:
                        missed[b] += lasting + gone
                    else:
                        found[b] += lasting + gone
            if r > 0.5:
                detected = min(tally.detected[b, i], 1.0)
                if t >= 0:
                    new[b, t, 0, 0, 0], new[b, t, 0, 1, 0] = max(updated - detected, 0.0), min(detected, updated)
                else:
                    found[b] += detected
