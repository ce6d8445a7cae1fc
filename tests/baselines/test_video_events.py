"""Events of a sequence follow from the truth, and a tracker handles one if number and identities are right after it."""

from __future__ import annotations

import numpy as np

from servotrack.baselines.papers.gm_phd_video.events import find_events, handled, identities
from servotrack.estimators.metrics import Track
from servotrack.estimators.types import Array

LENGTH = 200


def walk(first: int, last: int, x: Array | float) -> Track:
    steps = np.arange(first, last)
    left = np.broadcast_to(x, steps.shape)
    return Track(steps, np.column_stack([left, np.full(len(steps), 50.0), np.full((len(steps), 2), [20.0, 60.0])]))


def meeting() -> tuple[list[Track], Array]:
    """Two people who merge from frame 80 to 99, and a third from frame 120 to 159; numbers of people."""
    apart = np.interp(np.arange(LENGTH), [0, 80, 100, 200], [80.0, 4.0, 4.0, 80.0])
    apart[:80] = np.maximum(apart[:80], 30.0)
    apart[100:] = np.maximum(apart[100:], 30.0)
    truth = [walk(0, LENGTH, 100.0), walk(0, LENGTH, 100.0 + apart), walk(120, 160, 300.0)]
    numbers = np.full(LENGTH, 2)
    numbers[120:160] = 3
    return truth, numbers


def test_events_follow_from_the_truth() -> None:
    truth, _ = meeting()
    found = [(event.kind, event.frame, event.people) for event in find_events(truth, LENGTH)]
    assert found == [("merge", 80, (0, 1)), ("split", 100, (0, 1)), ("appear", 120, (2,)), ("disappear", 160, (2,))]


def test_perfect_tracks_handle_all_and_others_fail_where_they_err() -> None:
    truth, numbers = meeting()
    events = find_events(truth, LENGTH)
    assert handled(events, truth, numbers, truth, numbers) == [True] * 4
    # The two change places after they met.
    a, b = truth[0], truth[1]
    swapped = [
        Track(a.steps, np.concatenate([a.states[:90], b.states[90:]])),
        Track(b.steps, np.concatenate([b.states[:90], a.states[90:]])),
        truth[2],
    ]
    assert handled(events, truth, numbers, swapped, numbers) == [True, False, True, True]
    # One person is counted while they are together, and the third one is never found.
    counts = numbers.copy()
    counts[80:100] = 1
    counts[120:160] = 2
    assert handled(events, truth, numbers, truth[:2], counts) == [False, True, False, True]


def test_identities_are_those_of_the_nearest_report() -> None:
    truth, _ = meeting()
    far = Track(truth[2].steps, np.add(truth[2].states, [100.0, 0.0, 0.0, 0.0]))
    names = identities(truth, [truth[1], far], LENGTH)
    assert (names[1, :80] == 0).all() and (names[0, :70] == -1).all() and (names[2] == -1).all()
