"""Disjoint ranges of environment seeds: what an agent is trained or tuned on is never what it is reported on."""

from __future__ import annotations

TRAIN = range(0, 100_000)
TUNE = range(100_000, 200_000)
TEST = range(200_000, 1_000_000)

SPLITS: dict[str, range] = {"train": TRAIN, "tune": TUNE, "test": TEST}


def take(split: str, count: int, first: int = 0) -> list[int]:
    """Consecutive seeds from one split.

    Args:
        split: "train", "tune" or "test".
        count: Number of seeds, at least 1.
        first: Offset inside the split, at least 0.

    Raises:
        ValueError: Unknown split, or more seeds than the split has.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
    seeds = SPLITS[split]
    if count < 1 or first < 0 or first + count > len(seeds):
        raise ValueError(
            f"count must be at least 1, first at least 0, and first + count at most {len(seeds)} for split {split!r}, "
            f"got count={count}, first={first}"
        )
    return list(seeds[first : first + count])


def split_of(seed: int) -> str:
    """Name of the split a seed belongs to.

    Raises:
        ValueError: The seed is in no split.
    """
    for name, seeds in SPLITS.items():
        if seed in seeds:
            return name
    raise ValueError(f"seed must lie in 0..{TEST.stop - 1}, got {seed}")
