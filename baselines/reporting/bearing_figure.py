"""Figure of a bearing-time record: waterfall with tracks, and the truth where it is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from servotrack.baselines.reporting.figure import STYLE
from servotrack.estimators.sonar import BearingRecord, BearingTrack
from servotrack.estimators.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PALE, _DARK = 0.2, 99.5
"""Percentiles of the power that are drawn white and black."""


def draw_bearings(record: BearingRecord, tracks: Sequence[BearingTrack], truth: Array | None = None) -> Figure:
    """Draw bearing from left to right and time downwards: power in gray, tracks in colors, the truth dotted.

    Args:
        record: The record; missing rows are blank.
        tracks: Tracks of its rows.
        truth: True bearings, NaN while absent. Shape (n, T), deg; None: unknown.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    angles, times = record.tracker.beam_bearings, record.times
    with np.errstate(divide="ignore"):
        level = np.nanmedian(record.powers, axis=1, keepdims=True)
        decibels = 10.0 * np.log10(np.maximum(record.powers / level, 1e-6))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.0, 6.0), layout="constrained")
        axes = figure.add_subplot()
        low, high = np.nanpercentile(decibels, [_PALE, _DARK])
        mesh = axes.pcolormesh(
            angles, times, np.ma.masked_invalid(decibels), cmap="gray_r", vmin=low, vmax=max(high, low + 1.0),
            shading="nearest", rasterized=True,
        )  # fmt: skip
        figure.colorbar(mesh, ax=axes, label="power over the median of the row, dB")
        for k, track in enumerate(tracks):
            rows = slice(track.first, track.last + 1)
            axes.plot(*_broken(track.bearings, times[rows]), "-", color=f"C{k % 10}", linewidth=1.2)
            start = track.bearings[0], times[track.first]
            axes.annotate(str(track.label), start, color=f"C{k % 10}", fontsize=8)
        if truth is not None:
            turn = record.tracker.directions.wrapped
            for bearings in map(turn, truth):
                axes.plot(*_broken(bearings, times), ":", color="black", linewidth=0.8)
        axes.set_xlim(angles[0], angles[-1])
        axes.set_ylim(times[-1], times[0])
        axes.set_xlabel("bearing, deg")
        axes.set_ylabel("time, s")
        axes.set_title(f"{len(tracks)} tracks" + ("" if truth is None else ", truth dotted"))
    return figure


def _broken(bearings: Array, times: Array) -> tuple[Array, Array]:
    """Path with a gap where it passes from 360 to 0 deg."""
    with np.errstate(invalid="ignore"):
        jumps = np.flatnonzero(np.abs(np.diff(bearings)) > 180.0) + 1
    return np.insert(bearings, jumps, np.nan), np.insert(times, jumps, np.nan)
