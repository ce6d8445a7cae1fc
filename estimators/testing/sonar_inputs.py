"""Rows of a bearing-time record, for the sonar trackers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from servotrack.estimators.testing.inputs import Arguments, Bad, Inputs, Sequence, magnitude
from servotrack.estimators.validation import LIMITS


@dataclass(frozen=True)
class RowInputs(Inputs):
    """Rows of beam powers with moving peaks over noise.

    Args:
        beams: Number of beams in a row.
        averages: Number of averages in one beam power, which sets the noise.
        targets: Number of peaks.
    """

    beams: int = 721
    averages: int = 1110
    targets: int = 2

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw rows with peaks of moving targets, or with spikes of any power within the limits."""
        grid = np.linspace(0.0, 180.0, self.beams)
        bearing = rng.uniform(20.0, 160.0, self.targets)
        rate = rng.uniform(-1.0, 1.0, self.targets)
        level = magnitude(rng, 1e-300, LIMITS.powers) if extreme else magnitude(rng, 2.0, 1000.0)
        rows = []
        for _ in range(steps):
            power = 1.0 + rng.normal(0.0, 1.0 / np.sqrt(self.averages), self.beams)
            for middle in bearing:
                power += 0.5 * np.exp(-0.5 * ((grid - middle) / 2.0) ** 2)
            if extreme:
                spikes = rng.random(self.beams) < 0.05
                power[spikes] = magnitude(rng, 1e-30, LIMITS.powers)
            rows.append(np.minimum(level * np.maximum(power, 0.0), LIMITS.powers))
            bearing = bearing + rate
        return Sequence({"row": rows[0]}, tuple({"row": each} for each in rows))

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield rows of another length, negative powers, rows of zeros and powers beyond the limits."""
        good = arguments["row"]
        negative, huge = good.copy(), good.copy()
        negative[0], huge[0] = -1.0, 1e300
        for fault, row in (
            ("of another length", good[:-1]),
            ("with a negative power", negative),
            ("of zeros", np.zeros_like(good)),
            ("with a power of 1e300", huge),
        ):
            yield Bad(f"a row {fault}", ("row",), {"row": row})
