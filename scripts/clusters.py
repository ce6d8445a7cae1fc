"""Two workers of a cluster against one, and their rows against those of one process; called by scripts/clusters."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from servotrack.baselines.evaluation.bench import TASK_EPISODES, bench
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.running.clusters import computing_on

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "baselines"))

from clusters import dask_cluster, ray_cluster

AGENTS, LEVELS = ("kf", "random"), (0, 3)
CLUSTERS: dict[str, Callable[[Path, int], AbstractContextManager[str]]] = {"dask": dask_cluster, "ray": ray_cluster}


def rows(folder: Path) -> dict[str, str]:
    """Return the rows of all cells, as their files write them."""
    cells = {str(path.relative_to(folder)): json.loads(path.read_text()) for path in folder.glob("*/*.json")}
    return {name: json.dumps(cell["rows"]) for name, cell in cells.items()}


def run(folder: Path, agents: Sequence[str], episodes: int) -> tuple[float, float]:
    """Evaluate, and return the duration without what is done once, and the processor time of this process, s."""
    # Kernels are loaded, and times of steps are measured, before the clock starts.
    bench(agents=agents, levels=LEVELS, folder=folder, episodes=2 * TASK_EPISODES, jobs=1)
    begin, used = time.perf_counter(), time.process_time()
    bench(agents=agents, levels=LEVELS, folder=folder, episodes=episodes, jobs=1)
    return time.perf_counter() - begin, time.process_time() - used


def main() -> None:
    """Print durations and ratios; fail if rows differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=2000, help="episodes per cell (default 2000)")
    parser.add_argument("--rounds", type=int, default=3, help="rounds; the shortest duration counts (default 3)")
    parser.add_argument("--agents", nargs="+", default=AGENTS, help=f"agents (default {' '.join(AGENTS)})")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        here, _ = run(place / "here", arguments.agents, arguments.episodes)
        expected = rows(place / "here")
        print(f"one process: {here:.2f} s for {len(expected)} cells of {arguments.episodes} episodes", flush=True)
        for backend, cluster in CLUSTERS.items():
            seconds: dict[int, tuple[float, float]] = {}
            for workers in (1, 2):
                folder = place / f"{backend}{workers}"
                folder.mkdir()
                with cluster(folder, workers) as address, computing_on(backend, address, code_version):
                    seconds[workers] = min(
                        run(folder / f"{k}", arguments.agents, arguments.episodes) for k in range(arguments.rounds)
                    )
                for k in range(arguments.rounds):
                    if rows(folder / f"{k}") != expected:
                        raise SystemExit(f"{backend}, {workers} workers: rows differ from those of one process")
            (one, _), (two, used) = seconds[1], seconds[2]
            print(
                f"{backend}: {one:.2f} s with one worker, {two:.2f} s with two, ratio {one / two:.2f}; "
                f"the command took {used / two:.1%} of a core; rows equal",
                flush=True,
            )


if __name__ == "__main__":
    main()
