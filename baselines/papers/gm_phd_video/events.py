"""Events of a sequence: people appear, merge, split and disappear, and what a tracker makes of each.

The paper claims that people are tracked "when they appear, merge, split and disappear". Events follow from the truth. A
tracker handles one if the number that it reports is right in most frames of the window after it and, where people go
on, if their identities are the ones that they had before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from servotrack.estimators.metrics import Track, centroid_distances
from servotrack.estimators.types import Array, Labels

WINDOW = 25
"""Length of the window after an event, and of the one before it, frames."""
COVERED = 0.5
"""Share of the smaller of two boxes within the other one from which two people have merged."""
SHORTEST = 3
"""Smallest number of frames of a merge. Between two merges of the same people lie at least `WINDOW` frames."""
FARTHEST = 1.2
"""Largest distance of a reported person from a true one, half heights, as in the scores of the paper's table."""
KINDS = ("appear", "merge", "split", "disappear")


class Event(NamedTuple):
    """Something that happens to people.

    Attributes:
        kind: One of `KINDS`.
        frame: First frame after it.
        people: Indices of the true tracks.
        since: First frame of the merge before a split; for other kinds `frame`.
    """

    kind: str
    frame: int
    people: tuple[int, ...]
    since: int


def find_events(truth: Sequence[Track], length: int) -> list[Event]:
    """Events of a sequence in the order of their frames.

    Args:
        truth: Tracks of the people; states are left, top, width, height, px.
        length: Number of frames.
    """
    events = []
    for i, track in enumerate(truth):
        first, last = int(track.steps[0]), int(track.steps[-1]) + 1
        if first > 0:
            events.append(Event("appear", first, (i,), first))
        if last < length:
            events.append(Event("disappear", last, (i,), last))
    for i, one in enumerate(truth):
        for j in range(i + 1, len(truth)):
            for begin, end in _merges(one, truth[j]):
                events.append(Event("merge", begin, (i, j), begin))
                if end < min(int(one.steps[-1]), int(truth[j].steps[-1])):
                    events.append(Event("split", end, (i, j), begin))
    return sorted(events, key=lambda event: (event.frame, event.kind))


def regions_of_people(truth: Sequence[Track], numbers: Labels) -> Labels:
    """Number of people in each frame if those who have merged are one.

    Args:
        truth: True tracks.
        numbers: Number of people in each frame. Shape (T,).

    Returns:
        Shape (T,).
    """
    links: list[list[tuple[int, int]]] = [[] for _ in numbers]
    for i, one in enumerate(truth):
        for j in range(i + 1, len(truth)):
            for begin, end in _merges(one, truth[j]):
                for frame in range(begin, min(end, len(numbers))):
                    links[frame].append((i, j))
    regions = np.array(numbers, np.int64)
    for frame, pairs in enumerate(links):
        if pairs:
            graph = coo_array((np.ones(len(pairs)), tuple(zip(*pairs, strict=True))), shape=(len(truth),) * 2)
            groups, _ = connected_components(graph, directed=False)
            regions[frame] -= len(truth) - groups
    return regions


def handled(
    events: Sequence[Event],
    truth: Sequence[Track],
    numbers: Labels,
    tracks: Sequence[Track],
    counts: Labels,
    identities_kept: bool = True,
) -> list[bool]:
    """Return whether a tracker handled each event.

    Args:
        events: Events of the sequence.
        truth: True tracks.
        numbers: True number of people in each frame. Shape (T,).
        tracks: Reported tracks.
        counts: Reported number of people in each frame. Shape (T,).
        identities_kept: If true, people who part must carry the identities that they had before they merged; if false,
            it is enough that their number is right.
    """
    names = identities(truth, tracks, len(numbers))
    right = np.asarray(counts)[: len(numbers)] == np.asarray(numbers)
    results = []
    for event in events:
        window = slice(event.frame, event.frame + WINDOW)
        good = bool(right[window].mean() >= 0.5)
        if event.kind == "appear":
            good &= _usual(names[event.people[0], window]) >= 0
        elif event.kind == "split" and identities_kept:
            before = [_usual(names[i, max(event.since - WINDOW, 0) : event.since]) for i in event.people]
            after = [_usual(names[i, window]) for i in event.people]
            good &= before == after and min(before) >= 0
        results.append(good)
    return results


def identities(truth: Sequence[Track], tracks: Sequence[Track], length: int) -> Labels:
    """Index of the reported track of each person in each frame, by the best assignment of the frame; -1 for none.

    Args:
        truth: True tracks.
        tracks: Reported tracks.
        length: Number of frames.

    Returns:
        Shape (number of people, length).
    """
    names = np.full((len(truth), length), -1, np.int64)
    true, found = _by_frame(truth, length), _by_frame(tracks, length)
    for frame, (people, reported) in enumerate(zip(true, found, strict=True)):
        if not people or not reported:
            continue
        distance = centroid_distances(np.array([box for _, box in people]), np.array([box for _, box in reported]))
        rows, columns = linear_sum_assignment(np.where(distance <= FARTHEST, distance, 10.0 * FARTHEST))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            if distance[row, column] <= FARTHEST:
                names[people[row][0], frame] = reported[column][0]
    return names


def _by_frame(tracks: Sequence[Track], length: int) -> list[list[tuple[int, Array]]]:
    frames: list[list[tuple[int, Array]]] = [[] for _ in range(length)]
    for i, track in enumerate(tracks):
        for step, box in zip(np.asarray(track.steps).tolist(), np.asarray(track.states), strict=True):
            if step < length:
                frames[step].append((i, box))
    return frames


def _usual(names: Labels) -> int:
    """The most frequent identity; -1 where there is none."""
    known = names[names >= 0]
    return int(np.bincount(known).argmax()) if len(known) else -1


def _merges(one: Track, other: Track) -> list[tuple[int, int]]:
    """First frames of the merges of two people, and first frames after them."""
    frames, a, b = np.intersect1d(np.asarray(one.steps), np.asarray(other.steps), return_indices=True)
    if not len(frames):
        return []
    first, second = np.asarray(one.states, np.float64)[a], np.asarray(other.states, np.float64)[b]
    low = np.maximum(first[:, :2], second[:, :2])
    high = np.minimum(first[:, :2] + first[:, 2:], second[:, :2] + second[:, 2:])
    common = np.clip(high - low, 0.0, None).prod(axis=1)
    merged = frames[common >= COVERED * np.minimum(first[:, 2:].prod(axis=1), second[:, 2:].prod(axis=1))]
    if not len(merged):
        return []
    groups = np.split(merged, np.flatnonzero(np.diff(merged) > WINDOW) + 1)
    return [(int(group[0]), int(group[-1]) + 1) for group in groups if len(group) >= SHORTEST]
