"""Hard records of the default tracker: a loud interferer, broad transients, fast targets, missing rows, other arrays.

`scripts/sonar-cases` runs this module. The cases are no levels of SonarTracking-v0; they draw spectra at the elements
of an array and beamform them.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.reporting.embed import show
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.running.stopping import program
from servotrack.estimators.sonar import Band, BearingTrack, ElementArray, HMMBearings, LineArray, beam_powers
from servotrack.estimators.sonar.beamforming import Beamformer
from servotrack.estimators.sonar.directions import Directions
from servotrack.estimators.sonar.elements import AnyArray, phases
from servotrack.estimators.types import Array, Mask

ROWS = 60
SNAPSHOTS = 10
NEAR = 3.0
"""Distance within which a target counts as tracked, deg."""
TRANSIENT_SHARE = 0.2
"""Share of the rows with a transient."""
FIRST = 50_000
"""Offset of the seeds in the tune range while thresholds are chosen."""
_BAND_BINS, _NOISE_BINS = 100, 600
"""Bins of a broadband target, and bins of the noise to which its signal-to-noise ratio is relative."""


class Scene(NamedTuple):
    """Targets of a record.

    Attributes:
        bearings: Bearings, NaN while a target is absent. Shape (n, ROWS), deg.
        power: Power of each target per bin and element, relative to the noise. Shape (n,).
        measured: Index of the target whose share of tracked rows is reported.
    """

    bearings: Array
    power: Array
    measured: int


class Case(NamedTuple):
    """Kind of record.

    Attributes:
        name: Name in the table.
        draw: Draws the targets.
        spoil: Changes the beam powers of a row; None: unchanged.
        array: Elements; None: the default line.
        beamformer: Beamformer of the rows.
        beams: Angles of the beams, deg; None: equally spaced ones.
        errors: Standard deviation of the phase, rad, and relative standard deviation of the gain of the elements.
        diffuse: Power of noise from all directions, relative to that of each element's own noise.
    """

    name: str
    draw: Callable[[np.random.Generator], Scene]
    spoil: Callable[[np.random.Generator, Array, Array], Array] | None = None
    array: AnyArray | None = None
    beamformer: Beamformer = "conventional"
    beams: tuple[float, ...] | None = None
    errors: float = 0.0
    diffuse: float = 0.0


class Outcome(NamedTuple):
    """Scores of one record.

    Attributes:
        tracked: Share of the measured target's rows in which a track is near.
        false_tracks: Number of tracks at no target for more than half of their rows.
        seconds: Processor time of tracking, s.
    """

    tracked: float
    false_tracks: int
    seconds: float


def broadband(snr: float) -> float:
    """Power per bin of a broadband target whose SNR over 0 to 6 kHz is given in dB, as in SonarTracking-v0."""
    return float(_NOISE_BINS * 10.0 ** (snr / 10.0) / _BAND_BINS)


def interferer(louder: float, least: float = 10.0) -> Callable[[np.random.Generator], Scene]:
    """Weak target and one that is `louder` dB louder, which start at least `least` deg apart and move at random."""

    def draw(rng: np.random.Generator) -> Scene:
        k = np.arange(ROWS, dtype=np.float64)
        while True:
            start, rate = rng.uniform(30.0, 150.0, 2), rng.uniform(-0.5, 0.5, 2)
            bearings = start[:, None] + rate[:, None] * k
            if np.abs(np.diff(bearings, axis=0)).min() >= least and bearings.min() > 10.0 and bearings.max() < 170.0:
                break
        weak = broadband(rng.uniform(-24.0, -20.0))
        return Scene(bearings, np.array([weak * 10.0 ** (louder / 10.0), weak]), 1)

    return draw


def usual(rng: np.random.Generator) -> Scene:
    """Two targets that move at random, the weaker one measured."""
    k = np.arange(ROWS)
    start, rate = np.array([rng.uniform(30.0, 80.0), rng.uniform(100.0, 150.0)]), rng.uniform(-0.4, 0.4, 2)
    return Scene(start[:, None] + rate[:, None] * k, np.array([broadband(-16.0), broadband(-20.0)]), 1)


def moving(rate: float, slow: bool = False) -> Callable[[np.random.Generator], Scene]:
    """One target at a rate of `rate` deg/s, from one end of the line to the other, and a slow one if `slow`."""

    def draw(rng: np.random.Generator) -> Scene:
        bearings = rng.uniform(10.0, 20.0) + rate * np.arange(ROWS)
        bearings = np.where(bearings < 170.0, bearings, np.nan)[None]
        bearings = 180.0 - bearings if rng.uniform() < 0.5 else bearings
        power = [broadband(rng.uniform(-18.0, -10.0))]
        if slow:
            bearings = np.vstack([bearings, rng.uniform(60.0, 120.0) + 0.3 * np.arange(ROWS)])
            power.append(broadband(-16.0))
        return Scene(np.asarray(bearings, np.float64), np.array(power), 0)

    return draw


def around(rng: np.random.Generator) -> Scene:
    """Three targets around a planar array, one through 0 deg."""
    k = np.arange(ROWS)
    start = np.array([rng.uniform(335.0, 350.0), rng.uniform(80.0, 120.0), rng.uniform(180.0, 260.0)])
    rate = np.array([rng.uniform(0.5, 1.0), *rng.uniform(-0.4, 0.4, 2)])
    return Scene(start[:, None] + rate[:, None] * k, np.full(3, broadband(-18.0)), 0)


def lifted(
    low: float, high: float, part: str, adds: bool = False
) -> Callable[[np.random.Generator, Array, Array], Array]:
    """A fifth of the rows lifted by `low` to `high` dB in all bearings, in half of them, or in a broad bump.

    The gain multiplies all that is in a row, or with `adds`, noise of that power is added.
    """

    def spoil(rng: np.random.Generator, row: Array, angles: Array) -> Array:
        chance, level, edge, side = rng.uniform(size=4)
        if chance > TRANSIENT_SHARE:
            return row
        lift = 10.0 ** ((low + (high - low) * level) / 10.0)
        if part == "bump":
            shape = np.exp(-0.5 * ((angles - 180.0 * edge) / (15.0 + 40.0 * side)) ** 2)
        elif part == "half":
            shape = np.where((angles < 40.0 + 100.0 * edge) == (side < 0.5), 1.0, 0.0)
        else:
            shape = np.ones(len(row))
        if adds:
            noise = rng.gamma(_NOISE_BINS, 1.0 / _NOISE_BINS, len(row))
            return row + (lift - 1.0) * shape * np.convolve(noise, np.full(9, 1.0 / 9.0), "same")
        return row * (1.0 + (lift - 1.0) * shape)

    return spoil


def absent(rng: np.random.Generator, row: Array, angles: Array) -> Array:
    """A tenth of the rows missing."""
    return np.full_like(row, np.nan) if rng.uniform() < 0.1 else row


def irregular_line() -> ElementArray:
    """24 elements on a line at distances from 0.2 to 0.7 m."""
    gaps = np.random.default_rng(1).uniform(0.2, 0.7, 24)
    return ElementArray(np.column_stack([np.cumsum(gaps), np.zeros(24)]))


def ring() -> ElementArray:
    """16 elements on a circle of 1.2 m radius, with one in the middle."""
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    return ElementArray(np.vstack([1.2 * np.column_stack([np.cos(angle), np.sin(angle)]), np.zeros(2)]))


def cases() -> list[Case]:
    """Return all kinds of records."""
    line, circle = irregular_line(), ring()
    cosines = tuple(np.degrees(np.arccos(np.linspace(0.98, -0.98, 97))).tolist())
    return [
        Case("interferer 25 dB louder", interferer(25.0)),
        Case("interferer 30 dB louder", interferer(30.0)),
        Case("interferer 30 dB louder, element errors", interferer(30.0), errors=0.05),
        Case("transients in 20 % of the rows, all bearings", usual, lifted(3.0, 10.0, "all")),
        Case("transients, half of the bearings", usual, lifted(3.0, 10.0, "half")),
        Case("transients, half, added noise", usual, lifted(3.0, 10.0, "half", adds=True)),
        Case("transients, half, 1 to 3 dB", usual, lifted(1.0, 3.0, "half")),
        Case("transients, half, 10 to 20 dB", usual, lifted(10.0, 20.0, "half")),
        Case("transients, a broad bump", usual, lifted(3.0, 10.0, "bump")),
        Case("target at 3 deg/s", moving(3.0)),
        Case("target at 6 deg/s", moving(6.0)),
        Case("target at 6 deg/s beside a slow one", moving(6.0, slow=True)),
        Case("target at 9 deg/s", moving(9.0)),
        Case("a tenth of the rows missing", usual, absent),
        Case("diffuse noise, element errors", usual, errors=0.2, diffuse=1.0),
        Case("beams equally spaced in cosine", usual, beams=cosines, array=line),
        Case("irregular line", usual, array=line),
        Case("irregular line, MVDR", usual, array=line, beamformer="mvdr"),
        Case("ring of 17, 0 to 360 deg", around, array=circle),
        Case("ring of 17, MVDR", around, array=circle, beamformer="mvdr"),
        Case("MVDR, interferer 30 dB louder", interferer(30.0), array=line, beamformer="mvdr"),
    ]


def tracker_of(case: Case) -> HMMBearings:
    """Return the tracker of a case with its defaults: those of the class for the default line, else fitted."""
    if case.array is None and case.beamformer == "conventional":
        return HMMBearings()
    return HMMBearings.fitted(case.array or LineArray(), Band(), case.beams, beamformer=case.beamformer)


def draw_powers(case: Case, tracker: HMMBearings, scene: Scene, rng: np.random.Generator) -> Array:
    """Draw spectra at the elements and beamform them. Shape (ROWS, beams)."""
    f, n = tracker.band.frequencies, tracker.array.elements
    inside = (f >= 500.0) & (f < 1500.0)
    gains = np.exp(1j * case.errors * rng.standard_normal(n)) * (1.0 + case.errors * rng.standard_normal(n))

    def normal(*shape: int) -> Array:
        return np.asarray(rng.standard_normal((*shape, 2)).view(np.complex128)[..., 0] / np.sqrt(2.0))

    far = np.arange(0.0, 180.0 if not tracker.directions.planar else 360.0, 5.0)
    rows = np.empty((ROWS, len(tracker.beam_bearings)))
    for k in range(ROWS):
        x = normal(SNAPSHOTS, len(f), n)
        here = np.flatnonzero(~np.isnan(scene.bearings[:, k]))
        waves = phases(tracker.array, f, scene.bearings[here, k])
        for at, target in enumerate(here):
            sound = np.sqrt(scene.power[target]) * inside * normal(SNAPSHOTS, len(f))
            x = x + sound[..., None] * waves[:, at]
        if case.diffuse:
            waves = phases(tracker.array, f, far + rng.uniform(0.0, 5.0))
            x = x + np.sqrt(case.diffuse / len(far)) * np.einsum(
                "kfs,fsn->kfn", normal(SNAPSHOTS, len(f), len(far)), waves
            )
        powers = beam_powers(tracker.array, f, x * gains, tracker.beam_bearings, tracker.beamformer)
        rows[k] = powers if case.spoil is None else case.spoil(rng, powers, tracker.beam_bearings)
    return rows


def score(tracks: Sequence[BearingTrack], scene: Scene, directions: Directions) -> tuple[float, int]:
    """Share of the measured target's rows that are tracked, and the number of false tracks."""

    def near(track: BearingTrack, target: int) -> Mask:
        truth = scene.bearings[target, track.first : track.last + 1]
        return np.asarray(np.abs(directions.difference(track.bearings, truth)) < NEAR)

    seen = np.zeros(ROWS, np.bool_)
    false = 0
    for track in tracks:
        seen[track.first : track.last + 1] |= near(track, scene.measured)
        false += int(np.any([near(track, target) for target in range(len(scene.power))], axis=0).mean() <= 0.5)
    return float(seen[~np.isnan(scene.bearings[scene.measured])].mean()), false


def run(case: Case, seed: int) -> Outcome:
    """Draw one record of a case, track it with default arguments, and score it."""
    rng = np.random.default_rng([seed, sum(case.name.encode())])
    tracker, scene = tracker_of(case), case.draw(rng)
    rows = draw_powers(case, tracker, scene, rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        # Tables of the array are not part of the time.
        tracker.track(rows[:3])
        start = time.process_time()
        tracks = tracker.track(rows)
        seconds = time.process_time() - start
    return Outcome(*score(tracks, scene, tracker.directions), seconds)


def table(seeds: Sequence[int], chosen: str = "") -> Grid:
    """Run all cases whose names hold a text, and return their means."""
    lines = []
    for case in cases():
        if chosen in case.name:
            outcomes = [run(case, seed) for seed in seeds]
            tracked, false, seconds = np.array(outcomes).T
            lines.append(
                [case.name, f"{100.0 * tracked.mean():.0f}", f"{false.mean():.2f}", f"{1e3 * np.median(seconds):.0f}"]
            )
            print(*lines[-1], sep="  ", flush=True)
    return Grid(["record of 60 rows", "tracked %", "false tracks", "ms"], lines, words=1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and put it into the page `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/sonar-cases", description=__doc__)
    parser.add_argument("--runs", type=int, default=30, help="records of each case (default 30)")
    parser.add_argument("--tune", action="store_true", help="tune seeds, on which thresholds may be chosen")
    parser.add_argument("--case", default="", help="only the cases whose name holds this text")
    parser.add_argument("--write", type=Path, help="page with the marks sonar-cases:begin and :end")
    given = parser.parse_args(arguments)
    if given.runs < 1:
        parser.error(f"--runs must be at least 1, got {given.runs}")
    with program("nothing is written; run the same command again"):
        seeds = take("tune", given.runs, FIRST) if given.tune else take("test", given.runs)
        grid = table(seeds, given.case)
        source = f"`scripts/sonar-cases --runs {given.runs}`, servotrack {code_version()}"
        note = (
            f"{given.runs} records each. Tracked: rows of the weaker or the fast target with a track within {NEAR:g} "
            f"deg. False tracks: at no target for more than half of their rows, mean per record. Written by {source}."
        )
        text = f"{as_markdown(grid)}\n\n{note}"
        show(text, given.write, "sonar-cases")


if __name__ == "__main__":
    main()
