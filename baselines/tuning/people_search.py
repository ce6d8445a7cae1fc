"""Leave-one-sequence-out search of the default tracker of people, and its comparison with other trackers.

    python -m servotrack.baselines.tuning.people_search SEQUENCE... --rendered 2
    python -m servotrack.baselines.tuning.people_search SEQUENCE... --compare --into docs/video.md

Protocol: candidates are the present values and random changes of them, each value multiplied by a factor from a
log-normal distribution. Every candidate is run on every sequence, as recorded, backwards and at half the frame rate. A
sequence's gain is the tracker's HOTA, MOTA and IDF1 minus those of the reference, the better of SORT (of the package
`trackers`, if it is there) and Kalman + Hungarian for each measure, averaged over the three variants. The objective is
the smallest gain in HOTA over the sequences, limited to 3, times a half, plus the mean gain of all measures. For each
sequence in turn, the candidate with the best objective on the others is chosen, and what it reaches on that sequence is
printed: that is what users with other recordings may expect. The candidate with the best objective on all is the new
default. `--compare` runs the default beside its peers instead.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from joblib import delayed

from servotrack.baselines.agents.hyper_parameters import value_at, with_values
from servotrack.baselines.agents.people.catalog import BoxTracker, create_tracker
from servotrack.baselines.agents.people.trackers_package import PEERS
from servotrack.baselines.agents.people.tuning_grid import SEARCHED
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.reporting.embed import embed
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.running.stopping import program
from servotrack.baselines.running.workers import in_workers
from servotrack.baselines.tuning.people_sequences import (
    PeopleSequence,
    at_half_rate,
    read_sequence,
    rendered_sequence,
    reversed_in_time,
    score,
)
from servotrack.estimators.types import Array

TRACKER = "pmb"
REFERENCES = ("sort", "kalman-hungarian")
LARGEST_WORST = 3.0
"""Limit of the smallest gain in HOTA: beyond it the mean decides."""
RENDERED_LEVELS = (0, 1, 2, 3)
MARK = "people-sequences"


class Kind(NamedTuple):
    """Sequences that are left out together.

    Attributes:
        name: Name for tables.
        variants: The sequences; the first is the one that tables show.
    """

    name: str
    variants: list[PeopleSequence]


def measures(tracker: BoxTracker, sequence: PeopleSequence) -> list[float]:
    """HOTA, MOTA and IDF1 of a tracker on a sequence, percent."""
    found = score(tracker, sequence)
    return [100.0 * found.hota, 100.0 * found.mota, 100.0 * found.idf1]


def default_values() -> dict[str, float]:
    """Return the present value of every searched parameter."""
    tracker = create_tracker(TRACKER)
    return {path: value_at(tracker, path) for path in SEARCHED}


def candidates(count: int, spread: float, seed: int) -> list[dict[str, float]]:
    """Return the present values and random changes of them.

    Args:
        count: Number of candidates.
        spread: Standard deviation of the logarithm of a factor, in units of the parameter's own.
        seed: Seed of the changes.
    """
    rng, start = np.random.default_rng(seed), default_values()
    out = [start]
    while len(out) < count:
        steps = spread * rng.normal(size=len(start)) * (rng.random(len(start)) < 0.5)
        out.append({path: _moved(path, value, step) for (path, value), step in zip(start.items(), steps, strict=True)})
    return out


def objective(gains: Array) -> Array:
    """Objective of gains over the reference, shape (..., kinds, 3): HOTA, MOTA, IDF1."""
    worst = np.minimum(gains[..., 0].min(axis=-1), LARGEST_WORST)
    return 0.5 * worst + gains.mean(axis=(-2, -1))


def gains_of(kinds: Sequence[Kind], settings: Sequence[Mapping[str, float]], jobs: int) -> Array:
    """Gains of every setting over the reference. Shape (settings, kinds, 3)."""
    found = in_workers((delayed(_gains)(kind, settings) for kind in kinds), jobs, ordered=True)
    return np.stack(list(found), axis=1)


def comparison(kinds: Sequence[Kind], trackers: Sequence[str]) -> Grid:
    """Return a table of HOTA / MOTA / IDF1 by tracker and sequence, as recorded, and the means."""
    headings = ["tracker", *(kind.name for kind in kinds), "mean"]
    rows = []
    for name in trackers:
        found = np.array([measures(_create(name, kind.variants[0]), kind.variants[0]) for kind in kinds])
        rows.append([f"`{name}`", *(_three(one) for one in found), _three(found.mean(axis=0))])
    return Grid(headings, rows, 1, markdown=(0,))


def _create(name: str, sequence: PeopleSequence, values: Mapping[str, float] | None = None) -> BoxTracker:
    return with_values(create_tracker(name, sequence.frame_size, sequence.frame_rate), values or {})


def _gains(kind: Kind, settings: Sequence[Mapping[str, float]]) -> Array:
    """Gains of every setting on one kind. Shape (settings, 3)."""
    references = np.mean(
        [np.max([measures(_create(name, one), one) for name in _available()], axis=0) for one in kind.variants], axis=0
    )
    found = [
        np.mean([measures(_create(TRACKER, one, values), one) for one in kind.variants], axis=0) for values in settings
    ]
    return np.array(found) - references


def _available() -> list[str]:
    """References that are installed."""
    try:
        create_tracker("sort")
    except ImportError:
        return [name for name in REFERENCES if name not in PEERS]
    return list(REFERENCES)


def _moved(path: str, value: float, step: float) -> float:
    """Value after a step: a factor, or a summand where a value may be negative; probabilities stay below 1."""
    moved = value + step if value <= 0.0 else value * float(np.exp(step * SEARCHED[path]))
    return float(min(moved, 0.98)) if value < 1.0 and path in _PROBABILITIES else float(moved)


_PROBABILITIES = ("detection", "birth", "revival", "report")


def _three(values: Array) -> str:
    return " / ".join(f"{value:.1f}" for value in values)


def _kinds(given: Sequence[str], rendered: int, variants: bool) -> list[Kind]:
    kinds = []
    for one in map(read_sequence, given):
        more = [reversed_in_time(one), at_half_rate(one)] if variants else []
        kinds.append(Kind(one.name, [one, *more]))
    if rendered:
        scenes = [rendered_sequence(level, seed) for level in RENDERED_LEVELS for seed in seeds.take("tune", rendered)]
        kinds.append(Kind("rendered", scenes))
    return kinds


def _search(kinds: Sequence[Kind], arguments: argparse.Namespace) -> None:
    settings = candidates(arguments.candidates, arguments.spread, arguments.seed)
    gains = gains_of(kinds, settings, arguments.jobs)
    print(f"{len(settings)} candidates; gains in HOTA / MOTA / IDF1 over {' and '.join(_available())}")
    left_out = []
    for k, kind in enumerate(kinds):
        chosen = int(np.argmax(objective(np.delete(gains, k, axis=1))))
        left_out.append(gains[chosen, k])
        print(f"{kind.name} left out: candidate {chosen}, {_three(gains[chosen, k])}; default {_three(gains[0, k])}")
    scores = objective(gains)
    best = int(np.argmax(scores))
    print(f"mean of those left out: {_three(np.mean(left_out, axis=0))}; objective {objective(np.array(left_out)):.2f}")
    print(f"default: {_three(gains[0].mean(axis=0))}; objective {scores[0]:.2f}")
    print(f"best: candidate {best}, {_three(gains[best].mean(axis=0))}; objective {scores[best]:.2f}")
    for path, value in settings[best].items():
        print(f"  {path} = {value:.4g} (default {settings[0][path]:.4g})")


def main() -> None:
    """The command line above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+", help="folders, or NAME=DETECTIONS,TRUTH,RATE")
    parser.add_argument("--rendered", type=int, default=0, help="tune seeds of each level of rendered people")
    parser.add_argument("--candidates", type=int, default=40, help="number of settings tried")
    parser.add_argument("--spread", type=float, default=1.0, help="size of the random changes")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random changes")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--compare", action="store_true", help="compare trackers instead")
    parser.add_argument("--trackers", nargs="+", default=[TRACKER, "kalman-hungarian", *PEERS], help="to compare")
    parser.add_argument("--into", type=Path, help="document that holds the table of the comparison")
    arguments = parser.parse_args()
    with program("run the same command again"):
        kinds = _kinds(arguments.sequences, arguments.rendered, variants=not arguments.compare)
        if not arguments.compare:
            _search(kinds, arguments)
            return
        table = as_markdown(comparison(kinds, arguments.trackers))
        print(table)
        if arguments.into:
            embed(table, arguments.into, MARK)


if __name__ == "__main__":
    main()
