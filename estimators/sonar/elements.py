"""Arrays of elements at any places: directions that they tell apart, aliasing, and phases of plane waves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.sonar.array import Band, LineArray, cosines, unit_phasors
from servotrack.estimators.types import Array, ComplexArray
from servotrack.estimators.validation import as_numbers


@dataclass(frozen=True, init=False)
class ElementArray:
    """Omnidirectional elements at given places in the horizontal plane.

    A horizontal plane wave from bearing theta reaches the element at p earlier by p e(theta) / c than the origin, with
    e(theta) = (cos theta, sin theta). The array sees only these delays, up to a constant. If all p lie on a line with
    direction t, the delays depend on t e(theta), the cosine of the angle to the line: sources at the two mirrored
    bearings, and with a depth all on a cone about the line, look the same to it, whatever the distances of the
    elements are. If the elements span a plane, equal delays for all pairs mean equal e, so that bearings over 360 deg
    are distinct. Elements closer than half a wavelength keep a beam free of grating lobes.

    Bearings of a line are measured from the direction that points from its last to its first element, 0 to 180 deg, as
    those of a `LineArray`. Bearings of a planar array are measured from the x axis towards the y axis, 0 to 360 deg.

    Attributes:
        positions: Places of the elements, m; of three coordinates the last one, the depth, does not matter to
            horizontal waves. Shape (N, 2) or (N, 3).
        sound_speed: Speed of sound in the medium, m/s.
    """

    positions: tuple[tuple[float, float], ...]
    sound_speed: float = 1500.0

    def __init__(self, positions: ArrayLike, sound_speed: float = 1500.0) -> None:
        """Check the positions; raises ValueError that names what does not fit."""
        places = as_numbers("positions", positions)
        if places.ndim != 2 or places.shape[1] not in (2, 3) or len(places) < 2:
            raise ValueError(f"positions must have shape (elements, 2) or (elements, 3), got {places.shape}")
        if not np.isfinite(places).all():
            raise ValueError(f"positions must be finite, got {places[~np.isfinite(places).all(axis=1)][0].tolist()}")
        places = places[:, :2]
        if not np.ptp(places, axis=0).max() > 0.0:
            raise ValueError(
                "positions must differ in x or y, got one place for all elements; a vertical line has no bearings"
            )
        if not 0.0 < sound_speed < np.inf:
            raise ValueError(f"sound_speed must be positive, got {sound_speed!r}")
        object.__setattr__(self, "positions", tuple((float(x), float(y)) for x, y in places))
        object.__setattr__(self, "sound_speed", float(sound_speed))

    @property
    def elements(self) -> int:
        """Number N of elements."""
        return len(self.positions)

    @cached_property
    def _axes(self) -> tuple[Array, Array]:
        """Unit vector along the main axis, from the last element to the first, and centered places. (2,), (N, 2)."""
        places = np.array(self.positions)
        centered = places - places.mean(axis=0)
        axis = np.linalg.svd(centered, full_matrices=False)[2][0]
        if (places[0] - places[-1]) @ axis < 0.0:
            axis = -axis
        return axis, centered

    @cached_property
    def is_line(self) -> bool:
        """True if all elements lie within a thousandth of their length on a line, so that bearings are ambiguous."""
        axis, centered = self._axes
        along = centered @ axis
        across = centered @ np.array([-axis[1], axis[0]])
        return bool(np.abs(across).max() <= 1e-3 * np.ptp(along))

    @property
    def heading(self) -> float:
        """Direction of bearing 0, deg from the x axis towards the y axis; 0 for a planar array."""
        axis, _ = self._axes
        return math.degrees(math.atan2(axis[1], axis[0])) if self.is_line else 0.0

    def delays(self, bearings_deg: ArrayLike) -> Array:
        """Delays of plane waves at the elements relative to the array's center, s. Shape (S, N)."""
        axis, centered = self._axes
        if self.is_line:
            return -cosines(bearings_deg)[:, None] * (centered @ axis) / self.sound_speed
        angle = np.radians(np.asarray(bearings_deg, np.float64))
        return -(np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ centered.T) / self.sound_speed

    @cached_property
    def nearest(self) -> float:
        """Largest distance of an element from its nearest neighbor, m."""
        places = np.array(self.positions)
        distance = np.linalg.norm(places[:, None] - places, axis=-1)
        distance[np.diag_indices_from(distance)] = np.inf
        return float(distance.min(axis=1).max())


AnyArray = LineArray | ElementArray


def is_line(array: AnyArray) -> bool:
    """True if bearings are ambiguous between the two sides of the array."""
    return array.is_line if isinstance(array, ElementArray) else True


def phases(array: AnyArray, frequencies: ArrayLike, bearings_deg: ArrayLike) -> ComplexArray:
    """Phases of plane waves at the elements of any array, exp(-2 pi j f delay). Shape (F, S, N)."""
    if isinstance(array, ElementArray):
        delay = array.delays(np.atleast_1d(np.asarray(bearings_deg, np.float64)))
    else:
        delay = cosines(np.atleast_1d(bearings_deg))[:, None] * (
            np.arange(array.elements) * (array.spacing / array.sound_speed)
        )
    f = np.atleast_1d(np.asarray(frequencies, np.float64))
    return unit_phasors(-2.0 * np.pi * f[:, None, None] * delay)


def aliasing_frequency(array: AnyArray) -> float:
    """Frequency from which neighboring elements lie more than half a wavelength apart, Hz.

    Above it, a uniform line has grating lobes: a source shows at a second bearing as strongly as at its own. Elements
    at irregular distances have sidelobes there instead.
    """
    spacing = array.nearest if isinstance(array, ElementArray) else array.spacing
    return array.sound_speed / (2.0 * spacing)


def aliasing_note(array: AnyArray, band: Band) -> str | None:
    """Return a sentence about aliasing in a band, or None below the aliasing frequency."""
    limit = aliasing_frequency(array)
    if band.high <= limit * (1.0 + 1e-9):
        return None
    return (
        f"the band up to {band.high:g} Hz exceeds {limit:.4g} Hz, at which neighboring elements lie half a wavelength "
        "apart: a source may also show at false bearings; end the band there"
    )


def check_angles(array: AnyArray, angles: Sequence[float]) -> None:
    """Check the angles of beams.

    Raises:
        ValueError: Fewer than two angles, angles that do not rise, or that lie outside what the array sees.
    """
    given = as_numbers("beams", angles)
    if given.ndim != 1 or len(given) < 2 or not np.isfinite(given).all():
        raise ValueError(f"beams must be a number or at least two finite angles in deg, got shape {given.shape}")
    limit = 180.0 if is_line(array) else 360.0
    outside = (given < 0.0) | (given > limit)
    if outside.any():
        more = "; a line array cannot tell its two sides apart" if limit == 180.0 else ""
        raise ValueError(f"beams must lie in 0 to {limit:g} deg, got {given[outside][0]:g}{more}")
    falling = np.flatnonzero(np.diff(given) <= 0.0)
    if len(falling):
        at = int(falling[0])
        raise ValueError(f"beams must rise, got {given[at]:g} before {given[at + 1]:g} deg; sort them and their powers")
