"""Set filters beside Stone Soup's GM-PHD on the same scans of paper 004's scenario: rates, errors and scaling.

`subjects` gives rows for `speed.measure`; `errors` says how well both PHD filters locate the targets of those scans.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from servotrack.baselines.evaluation.seeds import TEST
from servotrack.baselines.speed.speed import Subject
from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.estimators.metrics import score_points
from servotrack.estimators.types import Array, Mask

SET_FILTERING = Path(__file__).with_name("set_filtering.py")
STONE_SOUP = Path(__file__).with_name("stone_soup.py")
PEER = "Stone Soup, GM-PHD"
REMEDY = "give --stone-soup-python, an interpreter that has stonesoup"

ACCELERATION_NOISE, POSITION_NOISE = 5.0, 10.0
"""sigma_v and sigma_w of the scans, m/s^1.5 and m: a hidden Markov model, which is what Stone Soup assumes."""

RUNS = 100
CUTOFF = 100.0


def write_scans(path: Path) -> Path:
    """Draw the scans of the benchmark and write them where the subjects' processes read them.

    Args:
        path: An .npz file to write: `rows` (RUNS, 100, M, 3) with existence in column 0; `count` (100,) and `scan` (sum
            of count, 2), the measurements of the first run; and what a filter has to know.
    """
    config = clutter_config(0, structure="HMM", acceleration_noise=ACCELERATION_NOISE, position_noise=POSITION_NOISE)
    episodes = [draw_episode(config, seed) for seed in TEST[:RUNS]]
    rows = np.stack([episode.measurements[: config.horizon] for episode in episodes])
    used = rows[0, :, :, 0] == 1.0
    np.savez(
        path,
        rows=rows,
        count=used.sum(axis=1),
        scan=rows[0][used][:, 1:],
        clutter_intensity=config.clutter_rate / (2.0 * config.half_width) ** 2,
        noise=[config.acceleration_noise, config.position_noise],
        sites=config.sites,
    )
    return path


def subjects(scans: Path, stone_soup_python: str | None) -> list[Subject]:
    """Rows of the table of rates: scans filtered per second, over all runs of a batch.

    Args:
        scans: What `write_scans` wrote.
        stone_soup_python: Interpreter of a virtual environment with Stone Soup; None where there is none.
    """
    peer = Subject(PEER, (str(STONE_SOUP), "rate", str(scans)), python=stone_soup_python, remedy=REMEDY)
    return [
        _filter("GMPHD", 1, scans, peers={PEER: 100.0}),
        _filter("GMCBMeMBer", 1, scans, wanted=2_000.0),
        _filter("PMB", 1, scans, wanted=2_000.0),
        _filter("GMPHD", RUNS, scans, peers={PEER: 200.0}),
        _filter("GMCBMeMBer", RUNS, scans, peers={PEER: 200.0}),
        _filter("PMB", RUNS, scans, peers={PEER: 200.0}),
        Subject("PMB, 100 targets in 200 clutter points", (str(SET_FILTERING), "crowd", "PMB"), wanted=50.0),
        Subject("GMPHD, 100 targets in 200 clutter points", (str(SET_FILTERING), "crowd", "GMPHD"), wanted=50.0),
        peer,
    ]


def _filter(name: str, batch: int, scans: Path, wanted: float = 0.0, peers: dict[str, float] | None = None) -> Subject:
    title = f"{name}, paper 004" if batch == 1 else f"{name}, paper 004, batch of {batch}"
    return Subject(title, (str(SET_FILTERING), "scans", name, str(batch), str(scans)), wanted, peers or {})


def errors(scans: Path, stone_soup_python: str, python: str) -> dict[str, float]:
    """Mean OSPA (c = 100 m, p = 1) of ours and of Stone Soup's GM-PHD on the first run of the scans.

    Args:
        scans: What `write_scans` wrote.
        stone_soup_python: Interpreter with Stone Soup.
        python: Our own interpreter.
    """
    config = clutter_config(0, structure="HMM", acceleration_noise=ACCELERATION_NOISE, position_noise=POSITION_NOISE)
    episode = draw_episode(config, TEST[0])
    commands = {
        "GMPHD": [python, str(SET_FILTERING), "estimates", "GMPHD", str(scans)],
        PEER: [stone_soup_python, "-W", "ignore", str(STONE_SOUP), "estimates", str(scans)],
    }
    found = {}
    for name, command in commands.items():
        answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        found[name] = _mean_ospa(json.loads(answer), episode.states[..., [0, 2]], episode.exists)
    return found


def _mean_ospa(estimates: Sequence[Sequence[Sequence[float]]], truth: Array, exists: Mask) -> float:
    """Mean over the scans of the OSPA of lists of positions."""
    scores = [
        float(score_points(truth[k][exists[k]], np.reshape(positions, (-1, 2)), CUTOFF).ospa)
        for k, positions in enumerate(estimates)
    ]
    return float(np.mean(scores))
