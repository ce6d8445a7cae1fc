"""Identities of people who met, by their appearance before."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.boxes.meetings import MeetingRules, meet

APART = np.array([[0.0, 0.0, 20.0, 60.0], [40.0, 0.0, 20.0, 60.0]])
TOGETHER = np.array([[0.0, 0.0, 20.0, 60.0], [8.0, 0.0, 20.0, 60.0]])
LOOKS = np.array([[1.0, 0.0], [0.6, 0.8]])
DT = 0.1


class Pair:
    """Two people with the identities 1 and 2."""

    def __init__(self) -> None:
        self.label, self.rival = np.array([1, 2]), np.array([0, 0])
        self.parted, self.appearance, self.before = np.zeros(2), LOOKS.copy(), LOOKS.copy()

    def seen(self, boxes: np.ndarray, looks: np.ndarray, partner: tuple[int, int] = (0, 1)) -> list[int]:
        """Identities after a frame."""
        tracks = self.label, self.rival, self.parted, self.appearance, self.before
        meet(tracks, np.ones(2, np.bool_), boxes, np.array(partner), boxes, looks, DT, MeetingRules())
        return self.label.tolist()


def test_people_who_part_get_the_identities_that_they_looked_like_before_they_met() -> None:
    for exchanged in (False, True):
        pair = Pair()
        pair.seen(TOGETHER, LOOKS)
        # Both have taken on something of the other one meanwhile.
        pair.appearance[:] = np.array([0.8, 0.6])
        assert pair.seen(TOGETHER, LOOKS[::-1].copy()) == [1, 2]
        assert pair.seen(APART, LOOKS[::-1].copy() if exchanged else LOOKS) == ([2, 1] if exchanged else [1, 2])
        assert pair.rival.tolist() == [0, 0]
        if exchanged:
            np.testing.assert_array_equal(pair.appearance, LOOKS[::-1])


def test_people_who_never_met_keep_their_identities_whatever_they_look_like() -> None:
    assert Pair().seen(APART, LOOKS[::-1].copy()) == [1, 2]


def test_a_hidden_person_is_not_judged_before_both_are_seen() -> None:
    pair = Pair()
    pair.seen(TOGETHER, LOOKS)
    assert pair.seen(APART, LOOKS[::-1].copy(), (0, -1)) == [1, 2]
    assert pair.seen(APART, LOOKS[::-1].copy()) == [2, 1]


@pytest.mark.parametrize("later", [False, True])
def test_people_who_look_alike_are_judged_later_and_not_for_ever(later: bool) -> None:
    pair = Pair()
    pair.seen(TOGETHER, LOOKS)
    unclear = np.array([[0.8, 0.6], [0.8, 0.6]])
    for _ in range(12 if later else 5):
        assert pair.seen(APART, unclear) == [1, 2]
    assert pair.seen(APART, LOOKS[::-1].copy()) == ([1, 2] if later else [2, 1])
