"""Mark of a folder whose files `servotrack track` may replace. Tracks and videos do not say who wrote them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from servotrack.baselines.reporting.files import ResultsError, atomic_path, read_document

MARK = "track.json"
_FORMAT, _FORMAT_VERSION = "servotrack-track", 1


def claim_folder(folder: Path, names: Sequence[str], request: Mapping[str, str]) -> None:
    """Write `track.json`, which lets this run and later ones replace the named files.

    Args:
        folder: Existing folder.
        names: Names of the files that a run may replace or remove.
        request: Arguments of the run, for the reader.

    Raises:
        ResultsError: The folder has no such mark and holds one of the files.
    """
    path = folder / MARK
    remedy = "choose another --out"
    if path.exists():
        read_document(path, _FORMAT, _FORMAT_VERSION, "not of `servotrack track`", remedy)
    elif strange := [name for name in names if (folder / name).exists()]:
        raise ResultsError(f"{folder} holds {' and '.join(strange)}, which no `servotrack track` wrote; {remedy}")
    document = {"format": _FORMAT, "format_version": _FORMAT_VERSION, **request}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
