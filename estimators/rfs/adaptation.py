"""Detection probability and clutter rate estimated beside a multi-Bernoulli filter, by Beta and Gamma densities.

Belief propagation gives for every scan the probability of each measurement to be clutter, and for every track i the
probabilities d_i of being detected and q_i of being alive and missed. With forgetting g,

    detection   Beta(s, u):   s <- g s + sum_i d_i,   u <- g u + sum_i q_i,   p_D = s / (s + u)
    clutter     Gamma(a, b):  a <- g a + sum_z pi_z,  b <- g b + 1,           rate = a / b
    births      Gamma(c, d):  c <- g c + sum_t e_t,   d <- g d + 1,           rate = c / d

A miss and a death look alike in the scan in which they happen: right after a death q_i is far too large, p_D falls, and
in turn deaths are found late. So d_i and q_i are counted `lag` scans later, given all measurements until then. Death is
final, hence what happened at scan k splits into two masses that are passed on from scan to scan: the target is still
alive, or it has died since. A prediction moves the share 1 - p_S of the first mass to the second. An update multiplies
the first by r' / r and the second by (1 - r') / (1 - r), r and r' the existence before and after the scan. Only tracks
of r above one half *before* scan k count; a choice by r' would prefer detected targets.

The births are those at measurements, away from known places. A track counts e_t when it is `lag` scans old: its
existence times the probability that its target was born there, as of its first detection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.elementary import exponential
from servotrack.estimators.rfs.pmb_kernel import Tally
from servotrack.estimators.types import Array, Labels


class SensorState(NamedTuple):
    """Densities of the detection probability and of the clutter rate.

    Attributes:
        found: s of Beta(s, u), detections. Shape (*batch,).
        missed: u of Beta(s, u), missed detections. Shape (*batch,).
        false: a of Gamma(a, b), false measurements. Shape (*batch,).
        scans: b of Gamma(a, b), scans. Shape (*batch,).
        pending: Probabilities that each track was missed (row 0) or found (row 1), and is alive now (column 0) or has
            died since (column 1), for each of the last `lag` scans, the newest first. Shape (*batch, T, lag, 2, 2).
        born: c of Gamma(c, d), targets born at measurements. Shape (*batch,).
        watched: d of Gamma(c, d), scans. Shape (*batch,).
        elsewhere: Probability of each track to have been born at a measurement; 0 once it is counted. Shape (*batch,
            T).
        age: Scans since the start of each track. Shape (*batch, T).
    """

    found: Array
    missed: Array
    false: Array
    scans: Array
    pending: Array
    born: Array
    watched: Array
    elsewhere: Array
    age: Labels

    @property
    def detection(self) -> Array:
        """Mean detection probability. Shape (*batch,)."""
        return self.found / (self.found + self.missed)

    @property
    def clutter_rate(self) -> Array:
        """Mean number of false measurements per scan. Shape (*batch,)."""
        return self.false / self.scans

    @property
    def birth_rate(self) -> Array:
        """Mean number of births at measurements per scan. Shape (*batch,)."""
        return self.born / self.watched


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
        birth_trust: Number of scans that the given rate of births at measurements counts for. Raising it keeps the
            estimate near that value for longer.
        detection_limits: Lower and upper limit of the detection probability that a filter uses. At 0.99 one miss means
            death as probably as not (for p_S = 0.99), so raising the upper limit ends tracks at chance misses.
        least_clutter: Lower limit of the clutter rate, false measurements per scan.
        birth_limits: Lower and upper limit of the rate of births at measurements, as shares of the given one. Raising
            the lower limit finds the first target away from the known places sooner. Raising the upper one finds the
            others sooner, and reports more pairs of clutter as short tracks.

    Raises:
        ValueError: An argument is out of range.
    """

    memory: float = 50.0
    lag: int = 5
    target_trust: float = 5.0
    scan_trust: float = 1.0
    birth_trust: float = 20.0
    detection_limits: tuple[float, float] = (0.05, 0.98)
    least_clutter: float = 0.01
    birth_limits: tuple[float, float] = (0.1, 1.0)

    def __post_init__(self) -> None:
        for name in ("memory", "target_trust", "scan_trust", "birth_trust", "least_clutter"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and > 0, got {value!r}")
        if self.lag < 1:
            raise ValueError(f"lag must be at least 1 scan, got {self.lag!r}")
        least, most = self.birth_limits
        if not 0.0 <= least <= most < np.inf:
            raise ValueError(f"birth_limits must be ascending and at least 0, got {self.birth_limits!r}")
        low, high = self.detection_limits
        if not 0.0 < low <= high < 1.0:
            raise ValueError(f"detection_limits must be ascending inside (0, 1), got {self.detection_limits!r}")

    def initial(
        self, batch: int, capacity: int, detection: float, clutter_rate: float, birth_rate: float = 0.0
    ) -> SensorState:
        """Densities around the given values.

        Args:
            batch: Number of runs.
            capacity: Number of tracks T that the filter's state has room for.
            detection: Given detection probability, in [0, 1].
            clutter_rate: Given mean number of false measurements per scan.
            birth_rate: Given mean number of births at measurements per scan.
        """
        one = np.ones(batch)
        found = self.target_trust * float(np.clip(detection, *self.detection_limits))
        return SensorState(
            found * one,
            (self.target_trust - found) * one,
            self.scan_trust * max(clutter_rate, self.least_clutter) * one,
            self.scan_trust * one,
            np.zeros((batch, capacity, self.lag, 2, 2)),
            self.birth_trust * birth_rate * one,
            self.birth_trust * one,
            np.zeros((batch, capacity)),
            np.zeros((batch, capacity), np.int64),
        )

    def detection(self, state: SensorState) -> Array:
        """Detection probability of the next scan, shape (B,)."""
        return np.clip(state.detection, *self.detection_limits)

    def clutter_rate(self, state: SensorState) -> Array:
        """Clutter rate of the next scan, shape (B,)."""
        return np.maximum(state.clutter_rate, self.least_clutter)

    def step(
        self, state: SensorState, before: Array, predicted: Array, after: Array, tally: Tally, own: bool = True
    ) -> SensorState:
        """Count one scan.

        Args:
            state: Densities before the scan.
            before: Existence of the tracks after the last scan. Shape (B, T).
            predicted: Existence of the same tracks predicted to this scan. Shape (B, T).
            after: Existence of the new tracks. Shape (B, T').
            tally: Association probabilities of the scan.
            own: False for a scan of another sensor, which is not counted but says who is alive.
        """
        batch, capacity = after.shape
        pending = np.zeros((batch, capacity, self.lag, 2, 2))
        found, missed, false, born = np.zeros(batch), np.zeros(batch), np.zeros(batch), np.zeros(batch)
        _count(state.pending, before, predicted, after, tally, own, pending, found, missed, false)
        elsewhere, age = np.zeros((batch, capacity)), np.zeros((batch, capacity), np.int64)
        _count_births(state, after, tally, own, self.lag, elsewhere, age, born)
        if not own:
            # Events of tracks that ended now are counted; nothing is forgotten.
            return state._replace(
                found=state.found + found,
                missed=state.missed + missed,
                born=state.born + born,
                pending=pending,
                elsewhere=elsewhere,
                age=age,
            )
        # Early scans were weighed by poor estimates, so the memory starts short and grows by a scan per scan.
        kept = exponential(-1.0 / np.minimum(self.memory, 2.0 * state.scans))
        lasting = math.exp(-1.0 / self.memory)
        # Without targets nothing is learned of p_D, so the density widens to the trust of the start and no further.
        total = state.found + state.missed
        held = np.maximum(kept, np.minimum(1.0, self.target_trust / total))
        return SensorState(
            held * state.found + found,
            held * state.missed + missed,
            kept * state.false + false,
            kept * state.scans + 1.0,
            pending,
            lasting * state.born + born,
            lasting * state.watched + 1.0,
            elsewhere,
            age,
        )


@njit(cache=True, nogil=True)
def _count(old, before, predicted, after, tally, own, new, found, missed, false):  # type: ignore[no-untyped-def]
    """Pass on the pending events, add those of this scan, and count those that leave the lag or lose their track."""
    lag = old.shape[2]
    # Events of a sensor grow older by its own scans only.
    older = 1 if own else 0
    for b in range(before.shape[0]):
        # One by one: a sum over rows of another length would be rounded in another way.
        for j in range(tally.unexplained.shape[1] if own else 0):
            false[b] += tally.unexplained[b, j]
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
                    if t >= 0 and k + older < lag:
                        new[b, t, k + older, kind, 0], new[b, t, k + older, kind, 1] = lasting, gone
                    elif kind == 0:
                        missed[b] += lasting + gone
                    else:
                        found[b] += lasting + gone
            if own and r > 0.5:
                detected = min(tally.detected[b, i], 1.0)
                if t >= 0:
                    new[b, t, 0, 0, 0], new[b, t, 0, 1, 0] = max(updated - detected, 0.0), min(detected, updated)
                else:
                    found[b] += detected


@njit(cache=True, nogil=True)
def _count_births(state, after, tally, own, lag, elsewhere, age, born):  # type: ignore[no-untyped-def]
    """Pass on where the tracks were born, and count the targets born at measurements once they are `lag` scans old."""
    for b in range(after.shape[0]):
        for t in range(after.shape[1]):
            if after[b, t] <= 0.0:
                continue
            i = tally.origin[b, t]
            if i < 0:
                elsewhere[b, t] = tally.elsewhere[b, -1 - i]
                continue
            age[b, t] = state.age[b, i] + (1 if own else 0)
            elsewhere[b, t] = state.elsewhere[b, i]
            if own and age[b, t] == lag:
                if after[b, t] > 0.5:
                    born[b] += after[b, t] * elsewhere[b, t]
                elsewhere[b, t] = 0.0
