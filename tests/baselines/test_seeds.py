"""Seeds of training, tuning and testing can never meet."""

from __future__ import annotations

import itertools

import pytest

from servotrack.baselines.evaluation import seeds


def test_splits_are_disjoint() -> None:
    for one, other in itertools.combinations(seeds.SPLITS.values(), 2):
        assert not set(one) & set(other)


def test_take_stays_inside_its_split() -> None:
    assert seeds.take("tune", 3) == [100_000, 100_001, 100_002]
    assert seeds.take("test", 1, first=799_999) == [999_999]
    assert {seeds.split_of(seed) for seed in seeds.take("train", 1000, first=99_000)} == {"train"}


@pytest.mark.parametrize(
    ("split", "count", "first"), [("exam", 1, 0), ("tune", 0, 0), ("tune", 100_001, 0), ("test", 1, -1)]
)
def test_take_refuses_what_the_split_has_not(split: str, count: int, first: int) -> None:
    with pytest.raises(ValueError, match="split"):
        seeds.take(split, count, first)


def test_split_of_refuses_strangers() -> None:
    with pytest.raises(ValueError, match="got 1000000"):
        seeds.split_of(1_000_000)
