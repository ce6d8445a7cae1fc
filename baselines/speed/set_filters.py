"""Rates and errors of set filters beside Stone Soup's GM-PHD filter, on the same scans of pairwise_markov's scenario.

`subjects` returns rows for `rates.measure`. `errors` compares the OSPA of both PHD filters on those scans.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from servotrack.baselines.evaluation.seeds import TEST
from servotrack.baselines.speed.rates import Subject
from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.estimators.metrics import score_points
from servotrack.estimators.types import Array, Mask

SET_FILTER_PROCESS = Path(__file__).with_name("set_filter_process.py")
STONE_SOUP = Path(__file__).with_name("stone_soup.py")
REFERENCE = "Stone Soup, GM-PHD"
REMEDY = "give --stone-soup-python, an interpreter that has stonesoup"

ACCELERATION_NOISE, POSITION_NOISE = 5.0, 10.0
"""sigma_v and sigma_w of the scans, m/s^1.5 and m. The scans follow a hidden Markov model, as Stone Soup assumes."""

RUNS = 100
CUTOFF = 100.0


def write_scans(path: Path) -> Path:
    """Draw scans and write them to a file for the processes that filter them.

    Args:
        path: Path of the .npz file: `rows` (RUNS, 100, M, 3) with existence in column 0; `count` (100,) and `scan` (sum
            of count, 2), the measurements of the first run; clutter intensity, noise levels and birth sites.

    Returns:
        `path`.
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
    """Return the rows of the table: scans filtered per second, summed over the runs of a batch.

    Args:
        scans: File that `write_scans` wrote.
        stone_soup_python: Interpreter of a virtual environment with Stone Soup; None if it is missing.
    """
    reference = Subject(REFERENCE, (str(STONE_SOUP), "rate", str(scans)), python=stone_soup_python, remedy=REMEDY)
    return [
        _filter("GMPHD", 1, scans, ratios={REFERENCE: 100.0}),
        _filter("GMCBMeMBer", 1, scans, target=2_000.0),
        _filter("PMB", 1, scans, target=2_000.0),
        _filter("PMBM", 1, scans, target=100.0),
        _filter("GMPHD", RUNS, scans, ratios={REFERENCE: 200.0}),
        _filter("GMCBMeMBer", RUNS, scans, ratios={REFERENCE: 200.0}),
        _filter("PMB", RUNS, scans, ratios={REFERENCE: 200.0}),
        Subject("PMB, 100 targets in 200 clutter points", (str(SET_FILTER_PROCESS), "crowd", "PMB"), target=50.0),
        Subject("GMPHD, 100 targets in 200 clutter points", (str(SET_FILTER_PROCESS), "crowd", "GMPHD"), target=50.0),
        reference,
    ]


def _filter(name: str, batch: int, scans: Path, target: float = 0.0, ratios: dict[str, float] | None = None) -> Subject:
    title = name if batch == 1 else f"{name}, batch of {batch}"
    return Subject(title, (str(SET_FILTER_PROCESS), "scans", name, str(batch), str(scans)), target, ratios or {})


def errors(scans: Path, stone_soup_python: str, python: str) -> dict[str, float]:
    """Return the mean OSPA (c = 100 m, p = 1) of our and of Stone Soup's GM-PHD filter on the first run, m.

    Args:
        scans: File that `write_scans` wrote.
        stone_soup_python: Interpreter that has Stone Soup.
        python: Interpreter that has servotrack.
    """
    config = clutter_config(0, structure="HMM", acceleration_noise=ACCELERATION_NOISE, position_noise=POSITION_NOISE)
    episode = draw_episode(config, TEST[0])
    commands = {
        "GMPHD": [python, str(SET_FILTER_PROCESS), "estimates", "GMPHD", str(scans)],
        REFERENCE: [stone_soup_python, "-W", "ignore", str(STONE_SOUP), "estimates", str(scans)],
    }
    found = {}
    for name, command in commands.items():
        answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        found[name] = _mean_ospa(json.loads(answer), episode.states[..., [0, 2]], episode.exists)
    return found


def _mean_ospa(estimates: Sequence[Sequence[Sequence[float]]], truth: Array, exists: Mask) -> float:
    """Mean OSPA over scans, m."""
    scores = [
        float(score_points(truth[k][exists[k]], np.reshape(positions, (-1, 2)), CUTOFF).ospa)
        for k, positions in enumerate(estimates)
    ]
    return float(np.mean(scores))
