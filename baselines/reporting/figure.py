"""Style of all figures, and how they are written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from servotrack.baselines.reporting.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": "#444444",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "savefig.dpi": 220,
    "svg.hashsalt": "servotrack",
}


def save_figure(figure: Figure, path: Path, results_stamp: str = "") -> None:
    """Write a figure in the format of the path's suffix, whole or not at all.

    Args:
        figure: The figure.
        path: File ending in .png, .svg or .pdf.
        results_stamp: Digest of the results that the figure shows, kept in the file's metadata.
    """
    import matplotlib as mpl

    date = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix, {})
    subject = {".svg": "Description", ".pdf": "Subject"}.get(path.suffix, "Description")
    metadata: dict[str, Any] = {**date, **({subject: f"results {results_stamp}"} if results_stamp else {})}
    with mpl.rc_context(STYLE), atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:], metadata=metadata)
