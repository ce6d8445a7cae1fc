"""Bank of rigid chains that differ in the play of their gears: one compiled step for all of them.

It returns what an `EstimatorBank` of `ChainJacobian`s that are fitted in turn does, to the bit, in a fraction of the
time: present features and covariances are computed for the chosen chain alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from servotrack.estimators.jacobian.adaptive import AdaptiveFilter, AdaptiveKalmanJacobian, AdaptiveState
from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState, gears
from servotrack.estimators.jacobian.bank import EstimatorBankState, check_memory
from servotrack.estimators.jacobian.chain import ChainJacobian, ChainState, checked_points
from servotrack.estimators.jacobian.chain_bank_kernel import BankReadings, step_bank
from servotrack.estimators.jacobian.chain_estimate import ChainEstimate
from servotrack.estimators.jacobian.chain_records import ChainSettings
from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.types import Array, Mask


class _Prepared(NamedTuple):
    """Arguments of the kernels for n joints and m features. Half plays have shapes (K, n), and (K m, n) by feature."""

    settings: ChainSettings
    turning: Mask
    half_play: Array
    row_turning: Mask
    row_half_play: Array
    units: Any
    noise: Any


@dataclass(frozen=True)
class ChainBank:
    """Estimator that returns the estimate of the best of K rigid chains: plays of the gears, targets that move or rest.

    A chain is as good as its predictions of new frames, as in `EstimatorBank`. Whether the target moves is decided
    without the offsets of the features, which follow what a wrong chain leaves: the best chain with a moving target
    serves while it explains the past frames better than the best one with a target at rest.

    Args:
        chain: Chain of which every play has a copy. Its linear filter must be an `AdaptiveKalmanJacobian`. The plays of
            both alignments are not read.
        plays: Assumed plays of all joints, rad. Computing time grows in proportion to their number.
        moving: Assumed plays of all joints of further chains whose target moves (`ChainJacobian.moving`), rad.
        forgetting: Memory of the weights per frame, in (0, 1]. Smaller values switch sooner.
        floor: Smallest logarithm of a weight relative to the best, negative. Values nearer to 0 let a chain recover
            sooner.
    """

    chain: ChainJacobian = field(default_factory=ChainJacobian)
    plays: tuple[float, ...] = (0.0, 0.0087, 0.0175)
    moving: tuple[float, ...] = ()
    forgetting: float = 0.98
    floor: float = -30.0

    row_covariances: ClassVar[bool] = True

    _prepared: dict[tuple[int, int], _Prepared] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("plays", "moving"):
            object.__setattr__(self, name, tuple(float(play) for play in getattr(self, name)))
        if not self.plays:
            raise ValueError("plays must have at least one value, got ()")
        for play in self.plays + self.moving:
            Alignment(play=play)
        if not isinstance(self.chain.linear, AdaptiveKalmanJacobian):
            kind = type(self.chain.linear).__name__
            raise ValueError(
                f"chain must have an AdaptiveKalmanJacobian as its linear filter, got {kind}; use EstimatorBank instead"
            )
        check_memory(self.forgetting, self.floor)

    @property
    def count(self) -> int:
        """Number K of chains."""
        return len(self.plays) + len(self.moving)

    def initial(self, measurement: ServoMeasurement) -> EstimatorBankState:
        """Return the state with equally likely chains. Raises ValueError as `ChainJacobian` does."""
        alone = self.chain.initial(measurement)
        axis, count = np.ndim(measurement.time), self.count
        members = _mapped(alone, lambda each: np.repeat(np.expand_dims(each, axis), count, axis))
        moves, clock = members.chain.moves.copy(), members.chain.clock.copy()
        moves[..., len(self.plays) :] = True
        # One fit at a time: chains take turns, by the clock of the first.
        clock[..., 0] = np.arange(count) * self.chain.refit / count
        members = members._replace(chain=members.chain._replace(moves=moves, clock=clock))
        return EstimatorBankState(members, np.zeros((*np.shape(measurement.time), count)))

    def step(
        self, state: EstimatorBankState, measurement: ServoMeasurement
    ) -> tuple[EstimatorBankState, ChainEstimate]:
        """Update every chain with one measurement. Raises ValueError as `ChainJacobian` does."""
        whole = checked_points(measurement)
        batch, n, m = whole.time.shape, whole.joint_angles.shape[-1], whole.features.shape[-1]
        before: ChainState = state.members
        self._check(before, whole)
        count, axes = self.count, len(batch)
        rows = math.prod(batch)
        prepared = self._prepared.get((n, m)) or self._prepare(n, m)

        def flat(values: Any) -> Any:
            """Merge the axes of the batch and of the chains."""
            return np.ascontiguousarray(values.reshape(rows * count, *values.shape[axes + 1 :]))

        def shaped(values: Any) -> Any:
            return values.reshape(*batch, count, *values.shape[1:])

        # Without a batch, arrays have the kernel's shapes already; a hundred views would take a tenth of a step.
        merged: ChainState = _mapped(before, flat) if axes else before
        read_at = whole.time if whole.joint_time is None else whole.joint_time
        readings = BankReadings(
            whole.joint_angles.reshape(rows, n),
            whole.features.reshape(rows, m),
            whole.goal.reshape(rows, m),
            whole.visible.reshape(rows, m),
            whole.frame_time.reshape(rows),
            read_at.reshape(rows),
            whole.time.reshape(rows),
        )
        linear: Any = self.chain.linear
        aligned, row_aligned, filtered, seen, memory, log_weight, found = step_bank(
            merged.alignment,
            merged.linear.alignment,
            merged.linear.filter,
            (
                merged.seen_joints,
                merged.seen_features,
                merged.seen_time,
                merged.seen,
                merged.jacobian,
                merged.center,
                merged.scale,
            ),
            merged.chain,
            readings,
            np.ascontiguousarray(state.log_weight).reshape(rows, count),
            (prepared.turning, prepared.half_play, self.chain.alignment.latency),
            (prepared.row_turning, prepared.row_half_play, linear.alignment.latency),
            (prepared.units, prepared.noise),
            prepared.settings,
            (self.forgetting, self.floor),
        )
        members = ChainState(
            linear=AdaptiveState(AlignmentState(*row_aligned), AdaptiveFilter(*filtered)),
            alignment=AlignmentState(*aligned),
            center=merged.center,
            scale=merged.scale,
            seen_joints=seen[0],
            seen_features=seen[1],
            seen_time=seen[2],
            seen=seen[3],
            jacobian=filtered[0].copy(),
            chain=memory,
        )
        if axes:
            members = _mapped(members, shaped)
        estimate = [values.reshape((*batch, *values.shape[1:])) for values in found] if axes else _first(found)
        return (
            EstimatorBankState(members, log_weight.reshape(*batch, count)),
            ChainEstimate(
                *estimate[:6],
                chained=estimate[6],
                parameters=estimate[7],
                reverse=estimate[8],
                focal=estimate[9],
                angles=estimate[10],
            ),
        )

    def forget(self, state: EstimatorBankState) -> EstimatorBankState:
        """Let every chain forget, see `ChainJacobian.forget`; the weights stay."""
        return state._replace(members=self.chain.forget(state.members))

    def _check(self, before: ChainState, whole: ServoMeasurement) -> None:
        """Raise ValueError if a measurement does not continue a state, as `Alignment.step` does."""
        axis, m, n = whole.time.ndim, before.seen_features.shape[-1], whole.joint_angles.shape[-1]
        first: Any = before.alignment
        clock = whole.time if whole.joint_time is None else whole.joint_time
        fits = (
            before.seen_joints.shape == (*whole.time.shape, self.count, whole.features.shape[-1], n)
            and first.history_time.shape[-1] == self.chain.alignment.history
            and (whole.joint_time is None) == (first.waiting_time.shape[-1] == 0)
        )
        if fits and bool((clock[..., None] >= first.history_time[..., -1]).all()):
            return
        if first.seen.ndim != axis + 1 or first.seen.shape[-1] != self.count:
            first = _mapped(first, lambda each: each[..., None])
        else:
            first = AlignmentState(*(each[(slice(None),) * axis + (0,)] for each in first))
        self.chain.alignment.check_against(first._replace(frame_features=first.frame_features[..., :m]), whole)

    def _prepare(self, joints: int, features: int) -> _Prepared:
        linear: Any = self.chain.linear
        frames, rows = self.chain.alignment, linear.alignment
        halves = np.array([gears(frames.revolute, play, joints)[1] for play in self.plays + self.moving])
        prepared = _Prepared(
            settings=self.chain.settings(joints)._replace(forgetting=self.forgetting),
            turning=gears(frames.revolute, 0.0, joints)[0],
            half_play=halves,
            row_turning=gears(rows.revolute, 0.0, joints)[0],
            row_half_play=np.repeat(halves, features, axis=0),
            units=linear.units(features, joints),
            noise=linear.noise(),
        )
        self._prepared[joints, features] = prepared
        return prepared


def _first(found: Any) -> list[Any]:
    """First rows of arrays, as views."""
    return [values[0, ...] for values in found]


def _mapped(tree: Any, function: Any) -> Any:
    """Apply a function to every array of nested NamedTuples."""
    return type(tree)(*(_mapped(leaf, function) for leaf in tree)) if isinstance(tree, tuple) else function(tree)
