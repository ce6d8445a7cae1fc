"""Readings of Jiang and Zhou (2016) where its text leaves the method open: emission, exclusion, number of chains.

The displayed equations are lost in the text at hand, so that several methods fit its words. Each of them runs on the
same records: the emission is a likelihood ratio of the beam's power, or the power itself; cells of other targets are
uninformative, or weighted, or not excluded at all; the number of chains is known, or found by the sequential test.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from rich.progress import Progress

from servotrack.baselines.agents.sonar.catalog import sonar_tracker
from servotrack.baselines.evaluation.statistics import wilson_interval
from servotrack.baselines.papers.boxes import Effect, Point, Value, box_points
from servotrack.baselines.papers.claims import effect_of, mean_effect, paired_effect
from servotrack.baselines.papers.hmm_sonar.experiment import draw_rows
from servotrack.baselines.papers.hmm_sonar.scores import RecordScores, score_tracks
from servotrack.baselines.papers.parts import parts_of_seeds
from servotrack.envs.track.sonar.array_model import scene_model_of
from servotrack.envs.track.sonar.config import SonarConfig, sonar_config
from servotrack.envs.track.sonar.scene import draw_scene
from servotrack.estimators.hmm.exclusion import exclude, occupancy
from servotrack.estimators.metrics import Track
from servotrack.estimators.sonar import HMMBearings
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.joint_smoothing import JointSmoother
from servotrack.estimators.sonar.likelihood import cell_likelihood
from servotrack.estimators.sonar.record import BearingTrack, checked_record, joined
from servotrack.estimators.types import Array

Emission = Literal["ratio", "power"]
Exclusion = Literal["uninformative", "weighted", "none"]

PAPER_NAME = "hmm_sonar"
AXES = ("emission", "exclusion", "number")
TURN_AXES = ("emission", "turn")
RECORDS = 18
"""Records of each of the two variants with the power itself and L known, which suffice for 100 % to be above 90 %."""
FEW_RECORDS = 5
"""Records of each variant at all other points: enough where a reading fails."""
TURN_RECORDS = 10
"""Records of one turning target."""
LEAST_LIKELIHOOD = 1e-12
"""Smallest likelihood of a cell that is weighted by 0."""


class Reading(NamedTuple):
    """One reading of the paper.

    Attributes:
        emission: "ratio": likelihood ratio of the power of a beam to noise; "power": the normalized power, b = z.
        exclusion: "uninformative": 1 + (b - 1) w in cells that other targets occupy with probability 1 - w;
            "weighted": b w; "none": b.
        number: Number of chains; None: chains are started until new ones fail the test of existence twice.
    """

    emission: Emission
    exclusion: Exclusion
    number: int | None


class ReadingSmoother(JointSmoother):
    """Joint smoother of single cells under one reading.

    Args:
        model: Tracker with the likelihood "cell".
        rows: Normalized beam powers. Shape (T, beams).
        reading: Reading of the paper.
    """

    def __init__(self, model: HMMBearings, rows: Array, reading: Reading) -> None:
        super().__init__(model, rows)
        self.reading = reading

    def _cells(self, chain: TrackHypothesis) -> Array:
        rows = self.rows / self.background
        b = cell_likelihood(rows, self.model.likelihood_rules) if self.reading.emission == "ratio" else rows
        b = np.maximum(self.model.on_grid(b), LEAST_LIKELIHOOD)
        others = [c for c in self.chains if c is not chain and len(c.marginal)]
        if not others or self.reading.exclusion == "none":
            return b
        positions = len(self.model.grid_bearings)
        held = [occupancy(c.marginal, c.presence, positions, self.model.spread_beams) for c in others]
        if self.reading.exclusion == "uninformative":
            return exclude(b, held)
        free = np.prod([1.0 - psi for psi in held], axis=0)
        return np.maximum((free.reshape(len(b), -1, positions) * b[:, None]).reshape(len(b), -1), LEAST_LIKELIHOOD)

    def _followed_already(self, new: TrackHypothesis) -> bool:
        # Without exclusion nothing keeps two chains from following one target: that is what this reading shows.
        return self.reading.exclusion != "none" and super()._followed_already(new)


def track(model: HMMBearings, record: Array, reading: Reading) -> list[Track]:
    """Return the tracks of a record under a reading.

    Args:
        model: Tracker with the likelihood "cell".
        record: Beam powers. Shape (T, beams).
        reading: Reading of the paper.
    """
    if reading.number is not None:
        model = model.changed(max_targets=max(reading.number, 1))
    checked = checked_record(record, len(model.beam_bearings), model.averages, None, model.period)
    smoother = ReadingSmoother(model, checked.rows, reading)
    smoother.search(attempts=2)
    parts = [
        BearingTrack.cut(0, chain, span, value)
        for chain in smoother.chains
        for span, value in zip(chain.spans, chain.evidence, strict=True)
    ]
    found = checked.restored(joined(parts, model.bridge_rows, model.period, model.joining, model.directions))
    return [Track(np.arange(one.first, one.last + 1), np.asarray(one.bearings)[:, None]) for one in found]


class ReadingsBox:
    """Scores of all readings, computed or read.

    Args:
        folder: Folder of the finished parts.
        progress: Progress display that gets a bar.
    """

    def __init__(self, folder: Path, progress: Progress) -> None:
        self._folder = folder
        points, turning = box_points(PAPER_NAME, AXES), box_points(PAPER_NAME, TURN_AXES)
        unexcluded = [{"emission": p["emission"], "exclusion": "none", "number": "known"} for p in points[::4]]
        steps = 2 * len(points) + len(turning) + len(unexcluded)
        self._bar = progress.add_task("readings", total=steps)
        self._progress = progress
        clear, faint = ([("rates", offset), ("cross30", offset)] for offset in (0.0, -20.0))
        self.clear = {self._key(at): self._simulated(at, clear) for at in (*points, *unexcluded)}
        self.turns = {
            self._key(at): self._scores(
                {**at, "exclusion": "uninformative", "number": "known"}, _turning(float(at["turn"])), TURN_RECORDS,
                f"turn-{at['turn']:g}",
            )
            for at in turning
        }  # fmt: skip
        self.faint = {self._key(at): self._simulated(at, faint) for at in points}

    @staticmethod
    def _key(at: Mapping[str, Value]) -> tuple[Value, ...]:
        return tuple(at.values())

    def _simulated(self, at: Mapping[str, Value], variants: Sequence[tuple[str, float]]) -> list[RecordScores]:
        many = (at["emission"], at["number"]) == ("power", "known") and at["exclusion"] != "none" and not variants[0][1]
        runs = RECORDS if many else FEW_RECORDS
        found = []
        for variant, offset in variants:
            config = sonar_config(variant=variant, snr_offset=offset, fidelity="snapshots")
            found += self._scores(at, config, runs, f"{variant}{offset:+g}", advance=variant == variants[-1][0])
        return found

    def _scores(
        self, at: Mapping[str, Value], config: SonarConfig, runs: int, world: str, advance: bool = True
    ) -> list[RecordScores]:
        name = "-".join(str(at[axis]) for axis in AXES)
        rows = parts_of_seeds(
            self._folder / world / name,
            runs,
            lambda seed: _scored(config, at, seed)._asdict(),
            world=world,
            reading=name,
        )
        if advance:
            self._progress.advance(self._bar)
        return [RecordScores(**row) for row in rows]

    def points(self, found: Mapping[tuple[Value, ...], Sequence[RecordScores]], effect: Any) -> tuple[Point, ...]:
        """Points of the readings with an effect computed from the scores of each."""
        return tuple(Point(at, (effect(found[self._key(at)]),)) for at in box_points(PAPER_NAME, AXES))

    def turning_points(self, effect: Any) -> tuple[Point, ...]:
        """Points of the records with a turning target."""
        return tuple(Point(at, (effect(self.turns[self._key(at)]),)) for at in box_points(PAPER_NAME, TURN_AXES))

    def exclusion_points(self) -> tuple[Point, ...]:
        """Points of "with exclusion more targets are tracked than without", number of chains known."""
        points = []
        for at in box_points(PAPER_NAME, ("emission", "exclusion")):
            both = [self.clear[str(at["emission"]), exclusion, "known"] for exclusion in (str(at["exclusion"]), "none")]
            # Records of both variants, of which the excluded ones are more.
            half, few = len(both[0]) // 2, len(both[1]) // 2
            with_it = [covered(one) for one in (*both[0][:few], *both[0][half : half + few])]
            without = [covered(one) for one in both[1]]
            effect = paired_effect(with_it, without, "of rows", "targets tracked, exclusion - none")
            points.append(Point(at, (effect,)))
        return tuple(points)


def _turning(turn: float) -> SonarConfig:
    return sonar_config(
        variant="random", targets=1, horizon=60, shortest_life=50, rate_noise=turn, fidelity="snapshots"
    )


def _scored(config: SonarConfig, at: Mapping[str, Value], seed: int) -> RecordScores:
    scene = draw_scene(config, seed)
    rows = draw_rows(config, scene, seed)[: config.horizon]
    exists = scene.exists[: config.horizon]
    model: Any = sonar_tracker("hmm-cell", scene_model_of(config))
    number = int(exists.any(axis=0).sum()) if at["number"] == "known" else None
    reading = Reading(at["emission"], at["exclusion"], number)  # type: ignore[arg-type]
    return score_tracks(scene.bearings[: config.horizon], exists, track(model, rows, reading))


def covered(scores: RecordScores) -> float:
    """Share of the rows of all targets that are tracked."""
    return float(scores.tracked.sum() / max(scores.present.sum(), 1))


def kept(scores: Sequence[RecordScores]) -> Effect:
    """Share of crossings in which both targets kept their track."""
    counts = [int(sum(getattr(one, name) for one in scores)) for name in ("kept", "crossings")]
    return effect_of(wilson_interval(counts[0], max(counts[1], 1)), "of crossings", "both tracks kept", len(scores))


def clean(scores: Sequence[RecordScores]) -> Effect:
    """Share of records without a false track."""
    good = sum(int(one.false_tracks == 0) for one in scores)
    return effect_of(wilson_interval(good, len(scores)), "of records", "without a false track", len(scores))


def timely(tolerance: float) -> Callable[[Sequence[RecordScores]], Effect]:
    """Share of starts and ends found within a tolerance, rows."""

    def effect(scores: Sequence[RecordScores]) -> Effect:
        found = [
            np.abs(ends[one.present > 0]) <= tolerance for one in scores for ends in (one.start, one.end)
        ]  # fmt: skip
        within = np.concatenate(found)
        interval = wilson_interval(int(within.sum()), len(within))
        return effect_of(interval, "of starts and ends", f"within {tolerance:g} s", len(scores))

    return effect


def tracked(target: int | None, measured: str) -> Callable[[Sequence[RecordScores]], Effect]:
    """Share of rows in which a target (None: any) is tracked."""

    def effect(scores: Sequence[RecordScores]) -> Effect:
        shares = [
            covered(one) if target is None else float(one.tracked[target] / max(one.present[target], 1))
            for one in scores
        ]
        return mean_effect(shares, "of rows", measured)

    return effect
