"""Frame numbers of the images of a folder, from their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servotrack.envs.track.files.recorded import MAX_FRAME
from servotrack.estimators.types import Labels

_DIGITS = re.compile(r"([0-9]+)")


class Numbering(NamedTuple):
    """Numbers of the images of a folder.

    Attributes:
        numbers: Frame of each image, from 0, increasing, shape (n,), int.
        note: Gaps and steps in the numbers, for the user; empty for consecutive numbers.
    """

    numbers: Labels
    note: str


def number_images(names: Sequence[str], counted: bool) -> Numbering:
    """Return the frame of each image. An image that is missing leaves a gap in the numbers.

    The names must hold one number that differs between them. Numbers of which the smallest step is the unit of all
    steps, such as 0, 10, 20, 40, count in that unit. Other names, such as time stamps, give consecutive frames.

    Args:
        names: Names of the images without folder, in the order of `natural_key`.
        counted: True for a MOTChallenge sequence, whose image n is frame n of det.txt and gt.txt (from 1), however many
            are missing before it; False to count from the first image.
    """
    plain = np.arange(len(names), dtype=np.int64)
    found = _varying(names)
    if found is None:
        return Numbering(plain, "the names of the images hold no single number: they are taken as consecutive frames")
    if counted:
        base, unit = (1 if found[0] > 0 else 0), 1
    else:
        base, unit = int(found[0]), int(np.gcd.reduce(np.diff(found))) or 1
    numbers = (found - base) // unit
    irregular = len(found) > 1 and np.diff(numbers).min() > 1 and not counted
    if irregular or numbers[-1] >= MAX_FRAME:
        return Numbering(plain, "the numbers in the names of the images are no frame numbers: taken as consecutive")
    parts = [f"the images are numbered in steps of {unit}"] if unit > 1 else []
    missing = int(numbers[-1] - numbers[0]) + 1 - len(numbers)
    if counted and numbers[0] > 0:
        parts.append(f"the first image is frame {int(numbers[0])} (counted from 0)")
    if missing:
        gaps = numbers[:-1][np.diff(numbers) > 1] + 1
        parts.append(f"{missing} image(s) are missing, the first at frame {int(gaps[0])}: frames keep their numbers")
    return Numbering(numbers, "; ".join(parts))


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Key that puts frame 9 before frame 10, with or without leading zeros."""
    parts = [part for part in _DIGITS.split(name) if part]
    return [(0, int(part), "") if part[:1].isdecimal() and part.isascii() else (1, 0, part) for part in parts]


def _varying(names: Sequence[str]) -> Labels | None:
    """Return the one number that differs between the names, increasing; None if there is not exactly one."""
    split = [_DIGITS.split(name.rpartition(".")[0]) for name in names]
    if len({tuple(parts[::2]) for parts in split}) != 1:
        return None
    columns = [[int(parts[k]) for parts in split] for k in range(1, len(split[0]), 2)]
    varying = [column for column in columns if len(set(column)) > 1]
    if len(names) == 1 and columns:
        varying = columns[-1:]
    if len(varying) != 1 or max(varying[0]) >= 2**62:
        return None
    found = np.array(varying[0], dtype=np.int64)
    return found if (np.diff(found) > 0).all() else None
