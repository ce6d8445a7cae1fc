"""CLEAR MOT, IDF1 and HOTA by the reference implementation, behind one function of two lists of tracks."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.metrics.distances import box_distances
from servotrack.estimators.metrics.tracks import Array, Track, stack_tracks


class MotScores(NamedTuple):
    """What tables of multi-object tracking report; ratios from 0 to 1, MOTA possibly below 0.

    Attributes:
        hota, deta, assa: Luiten et al. (2021), averaged over localization thresholds.
        idf1: Ristani et al. (2016).
        mota, motp: Bernardin and Stiefelhagen (2008).
        identity_switches, false_positives, misses: Counts under CLEAR MOT's matching.
    """

    hota: float
    deta: float
    assa: float
    idf1: float
    mota: float
    motp: float
    identity_switches: int
    false_positives: int
    misses: int


def mot_scores(
    truth: Sequence[Track],
    estimate: Sequence[Track],
    distances: Callable[[Array, Array], Array] = box_distances,
    cutoff: float = 1.0,
    threshold: float = 0.5,
) -> MotScores:
    """Score tracks against the truth with `trackeval`, installed without its own requirements.

    Args:
        truth: True tracks.
        estimate: Estimated tracks.
        distances: Base distances of two arrays of states, (n, d) and (k, d) to (n, k); boxes by default.
        cutoff: Distance at which similarity, which falls linearly from 1, is 0.
        threshold: Similarity from which CLEAR MOT and IDF1 count a match.

    Raises:
        ImportError: trackeval is missing.
        ValueError: `cutoff` is not positive, or tracks of unlike states.
    """
    if not cutoff > 0.0:
        raise ValueError(f"cutoff must be positive, got {cutoff!r}")
    data = _sequence(truth, estimate, distances, cutoff)
    clear, identity, hota = _reference_metrics(threshold)
    # Nothing below may chatter: the reference implementation prints while it works.
    with contextlib.redirect_stdout(io.StringIO()):
        c, i, h = clear.eval_sequence(data), identity.eval_sequence(data), hota.eval_sequence(data)
    return MotScores(
        hota=float(np.mean(h["HOTA"])),
        deta=float(np.mean(h["DetA"])),
        assa=float(np.mean(h["AssA"])),
        idf1=float(i["IDF1"]),
        mota=float(c["MOTA"]),
        motp=float(c["MOTP"]),
        identity_switches=int(c["IDSW"]),
        false_positives=int(c["CLR_FP"]),
        misses=int(c["CLR_FN"]),
    )


def _reference_metrics(threshold: float) -> tuple[Any, Any, Any]:
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            from trackeval.metrics import CLEAR, HOTA, Identity
        except ImportError as error:
            raise ImportError(
                "mot_scores needs trackeval, which is not installed: pip install --no-deps 'trackeval>=1.3,<2' "
                "(what it would pull in replaces opencv-python-headless, and is not needed)"
            ) from error
        config = {"THRESHOLD": threshold, "PRINT_CONFIG": False}
        return CLEAR(config), Identity(config), HOTA()


def _sequence(
    truth: Sequence[Track], estimate: Sequence[Track], distances: Callable[[Array, Array], Array], cutoff: float
) -> dict[str, Any]:
    """The reference implementation's form of a sequence: identities and similarities step by step."""
    everything = [*truth, *estimate]
    length = max((int(np.max(track.steps)) + 1 for track in everything if len(track.steps)), default=0)
    dimension = next((np.asarray(track.states).shape[1] for track in everything if len(track.steps)), 0)
    there, here = stack_tracks(truth, length, dimension), stack_tracks(estimate, length, dimension)
    exists = np.asarray(~np.isnan(there).any(axis=2))
    reported = np.asarray(~np.isnan(here).any(axis=2))
    truth_ids: list[NDArray[np.intp]] = []
    estimate_ids: list[NDArray[np.intp]] = []
    similarities: list[Array] = []
    for step in range(length):
        a, b = np.flatnonzero(exists[:, step]), np.flatnonzero(reported[:, step])
        truth_ids.append(a)
        estimate_ids.append(b)
        similarities.append(np.clip(1.0 - distances(there[a, step], here[b, step]) / cutoff, 0.0, 1.0))
    return {
        "num_timesteps": length,
        "num_gt_ids": len(truth),
        "num_tracker_ids": len(estimate),
        "num_gt_dets": int(exists.sum()),
        "num_tracker_dets": int(reported.sum()),
        "gt_ids": truth_ids,
        "tracker_ids": estimate_ids,
        "similarity_scores": similarities,
    }
