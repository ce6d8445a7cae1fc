"""Success and accuracy of servos on arms that they do not know, beside a calibrated one: writes docs/arms.md.

    python scripts/arms.py [--episodes 20] [--paired 20] [--jobs 1] [--results results/arms] [--output docs/arms.md]

Seeds of the test range, the same for all agents. Finished episodes in the folder of results are kept.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.evaluation.bench import bench
from servotrack.baselines.reporting.files import atomic_path

ENV_ID = "UncalibServo3D-v0"
ARMS = ("ur5e", "panda", "so101")
CAMERAS = ("hand", "world")
_CAMERA_NAMES = {"hand": "camera in hand", "world": "camera in the world"}
AGENTS = ("any-arm", "adaptive-kf", "expert-kf", "ibvs")

_PAIRED = """Levels 1 to 3 again, {episodes} episodes per row of the two servos that have to agree.
"""
_SINGLE = """Level 1 with one difficulty more; all arms and cameras together, {episodes} episodes of each.
"""
_NOTES = """
## A goal that moves

A camera in the world sees the goal move, and its velocity is known: it is fed forward in full. A camera in the hand
sees a goal that rests while the board moves. What the arm does to the image and what the board does are separated only
by time: the board's velocity changes slowly. `any-arm` filters it as soon as a chain with a moving board explains the
past better than all chains with a board at rest. Two limits remain:

- A shift of the board and a tilt that nearly cancels it in the image differ by less than the noise of a frame.
  Averaging over time lags behind the motion, and axes that were learned while the board moved are less exact. `ibvs`
  knows the arm, the board and the goal's velocity, and has neither problem.
- Play and sag of the gears look like a slow motion of the board. The chain with a moving board assumes gears without
  play; with both, from level 3 on, a camera in the hand seldom stays within the bounds.

So if the goal moves, put the camera in the world; with a camera in the hand, calibrate if the bounds above matter.
"""


class Axis(NamedTuple):
    """A difficulty of its own on top of level 1; `by_camera` adds a row for each camera."""

    name: str
    settings: Mapping[str, Any]
    by_camera: bool = False


AXES = (
    Axis("3 of 4 points in view at the start", {"in_view": (3, 3), "shift": 0.6}),
    Axis("2 of 4 points in view at the start", {"in_view": (2, 2), "shift": 0.6}),
    Axis("2 px of noise", {"pixel_noise": 2.0}),
    Axis("turns of 2 to 3 rad", {"turn": (2.0, 3.0), "mounting_tilt": math.radians(5)}),
    Axis("encoders 0 to 2 periods old, stamped", {"encoder_age": (0, 2)}),
    Axis("a goal that moves", {"motion": 0.015}, by_camera=True),
)


def main() -> None:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20, help="episodes per cell")
    parser.add_argument(
        "--paired",
        type=int,
        default=20,
        help="episodes per cell of any-arm and ibvs in levels 1 to 3 and difficulties",
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--results", type=Path, default=Path("results/arms"), help="folder of results")
    parser.add_argument("--output", type=Path, default=Path("docs/arms.md"), help="page to write")
    arguments = parser.parse_args()

    def cells(
        agents: tuple[str, ...], level: int, name: str, settings: Mapping[str, Any], episodes: int
    ) -> list[dict[str, list]]:
        """Rows by agent, one dictionary per arm and camera."""
        found = []
        for arm in ARMS:
            for camera in CAMERAS:
                results = bench(
                    ENV_ID,
                    agents,
                    [level],
                    folder=arguments.results / f"{name}-{arm}-{camera}",
                    episodes=episodes,
                    jobs=arguments.jobs,
                    settings={"arm": arm, "camera": camera, **settings},
                )
                found.append({cell.agent: cell.rows[:episodes] for cell in results})
                print(name, arm, camera, _line(found[-1], agents), flush=True)
        return found

    text = [_head(arguments.episodes)]
    text += ["## Levels\n", _table_head(AGENTS)]
    for level in (1, 2, 3, 4, 5):
        found = cells(AGENTS, level, f"level-{level}", {}, arguments.episodes)
        text += [_row(f"level {level}, {place}", rows, AGENTS) for place, rows in zip(_places(), found, strict=True)]
    pair, paired = ("any-arm", "ibvs"), arguments.paired
    text += ["\n## Beside the calibrated servo\n", _PAIRED.format(episodes=paired), _table_head(pair)]
    for level in (1, 2, 3):
        found = cells(pair, level, f"level-{level}", {}, paired)
        text += [_row(f"level {level}, {place}", rows, pair) for place, rows in zip(_places(), found, strict=True)]
    text += ["\n## Single difficulties\n", _SINGLE.format(episodes=paired), _table_head(pair)]
    for number, axis in enumerate(AXES):
        found = cells(pair, 1, f"axis-{number}", axis.settings, paired)
        together = {agent: [row for each in found for row in each[agent]] for agent in pair}
        text.append(_row(axis.name, together, pair))
        for camera in CAMERAS if axis.by_camera else ():
            places = zip(_places(), found, strict=True)
            some = [each for place, each in places if place.endswith(_CAMERA_NAMES[camera])]
            rows = {agent: [row for each in some for row in each[agent]] for agent in pair}
            text.append(_row(f"{axis.name}, {_CAMERA_NAMES[camera]}", rows, pair))
    text.append(_NOTES)
    with atomic_path(arguments.output) as path:
        path.write_text("\n".join(text) + "\n", encoding="utf-8")
    print(f"wrote {arguments.output}")


def _places() -> list[str]:
    return [f"{arm}, {_CAMERA_NAMES[camera]}" for arm in ARMS for camera in CAMERAS]


def _head(episodes: int) -> str:
    return f"""# Arms without calibration

[`UncalibServo3D-v0`](environments/UncalibServo3D-v0.md), {episodes} episodes of 40 s per row, seeds of the test range.
`any-arm` is `ServoController()` as it is; `adaptive-kf` the same with `AdaptiveKalmanJacobian`; `expert-kf` a Kalman
filter of the Jacobian (Zhang 2011) with a prior, a gain and a number of moves chosen for six joints; `ibvs` knows
camera, mounting, board and arm. Success: mean distance of the tool below 2 mm and mean angle below 1 degree in the
last 20 s. Tip: median over the episodes of the median distance after 10 s.

Written by `python scripts/arms.py`. The calibrated servo's interaction matrix is that of ViSP 3.5.0 to a relative
difference of 3.3e-16 (`scripts/check-visp`).
"""


def _table_head(agents: tuple[str, ...]) -> str:
    titles = [f"{agent}: success | tip, mm" for agent in agents]
    return f"| | {' | '.join(titles)} |\n|---|{'---|' * 2 * len(agents)}"


def _row(name: str, rows: Mapping[str, list], agents: tuple[str, ...]) -> str:
    parts = []
    for agent in agents:
        success = np.mean([row["success"] for row in rows[agent]])
        tip = 1e3 * np.median([row["tip"] for row in rows[agent]])
        parts.append(f"{success:.2f} | {tip:.2f}")
    return f"| {name} | {' | '.join(parts)} |"


def _line(rows: Mapping[str, list], agents: tuple[str, ...]) -> str:
    return ", ".join(f"{agent} {np.mean([row['success'] for row in rows[agent]]):.2f}" for agent in agents)


if __name__ == "__main__":
    main()
