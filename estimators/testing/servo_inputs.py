"""Measurements of a servo loop, for the estimators of the image Jacobian and their controllers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from servotrack.estimators.camera import pack_camera
from servotrack.estimators.jacobian import Geometry, InformedMeasurement, ServoEstimate, ServoMeasurement
from servotrack.estimators.testing.inputs import Arguments, Bad, Inputs, Sequence, magnitude
from servotrack.estimators.testing.values import Path
from servotrack.estimators.types import Array, Mask
from servotrack.estimators.validation import LIMITS


@dataclass(frozen=True)
class ServoInputs(Inputs):
    """`ServoMeasurement`s of a random arm, camera and target.

    Args:
        joints: Number n of joints.
        features: Number m of image features.
        batch: Leading axes of every field; each row is a sequence of its own.
        period: Control period, s.
    """

    joints: int = 2
    features: int = 2
    batch: tuple[int, ...] = ()
    period: float = 0.05

    may_be_infinite: ClassVar[frozenset[str]] = frozenset({"history_time", "waiting_time", "error_variance", "best"})

    @property
    def rows(self) -> int:
        """Number of rows of the batch."""
        return int(np.prod(self.batch, dtype=np.int64))

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw the measurements of a moving arm that sees a moving target, or of random jumps up to the limits."""
        measurements = self._extreme(rng, steps) if extreme else self._ordinary(rng, steps)
        return Sequence({"measurement": measurements[0]}, tuple({"measurement": each} for each in measurements))

    def _ordinary(self, rng: np.random.Generator, steps: int) -> list[ServoMeasurement]:
        jacobian = rng.normal(0.0, 200.0, (*self.batch, self.features, self.joints))
        drift = rng.normal(0.0, 20.0, (*self.batch, self.features))
        angles = rng.uniform(-2.0, 2.0, (*self.batch, self.joints))
        offset = rng.uniform(-80.0, 80.0, (*self.batch, self.features))
        time = np.full(self.batch, rng.choice([0.0, 1.7e9]))
        goal = np.full((*self.batch, self.features), 240.0)
        measurements = []
        for _ in range(steps):
            seen = offset + np.einsum("...ij,...j->...i", jacobian, angles)
            measurements.append(
                ServoMeasurement(
                    angles.copy(),
                    goal + seen + rng.normal(0.0, 1.0, seen.shape),
                    goal.copy(),
                    rng.random(self.batch) < 0.9,
                    time - rng.choice([0.0, 0.01, 0.03]),
                    time.copy(),
                )
            )
            angles = angles + rng.normal(0.0, 0.02, angles.shape)
            offset = offset + self.period * drift
            time = time + self.period
        return measurements

    def _extreme(self, rng: np.random.Generator, steps: int) -> list[ServoMeasurement]:
        angle, pixel = magnitude(rng, 1e-6, LIMITS.angles), magnitude(rng, 1e-3, LIMITS.pixels)
        pause = magnitude(rng, 1e-6, LIMITS.times / (steps + 1))
        delay = rng.choice([0.0, magnitude(rng, 1e-6, 1.0)])
        time = np.full(self.batch, rng.choice([0.0, -LIMITS.times / 2.0, 1.7e9]))
        angles = rng.uniform(-angle, angle, (*self.batch, self.joints))
        measurements = []
        for _ in range(steps):
            if rng.random() < 0.7:
                angles = rng.uniform(-angle, angle, angles.shape)
            measurements.append(
                ServoMeasurement(
                    angles,
                    rng.uniform(-pixel, pixel, (*self.batch, self.features)),
                    rng.uniform(-pixel, pixel, (*self.batch, self.features)),
                    rng.random(self.batch) < 0.8,
                    np.maximum(time - delay, -LIMITS.times),
                    time,
                )
            )
            if rng.random() < 0.8:
                time = np.minimum(time + rng.uniform(0.0, pause, self.batch), LIMITS.times)
        return measurements

    def results(self, estimate: Any) -> Any:
        """Joint rates of a controller; or an estimate, its error, Jacobian and a prediction."""
        if not isinstance(estimate, ServoEstimate):
            return estimate
        motion = np.full((*self.batch, self.joints), 0.1)
        return estimate, estimate.error, estimate.jacobian, estimate.predict_error(motion, self.period)

    def unread(self, arguments: Arguments) -> Mapping[Path, Mask]:
        """Features and time stamps of frames that do not show the target."""
        unseen = ~np.asarray(arguments["measurement"].visible, dtype=np.bool_)
        return {("measurement", "features"): unseen[..., None], ("measurement", "frame_time"): unseen}

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield a clock that runs back, a frame of the future and values beyond the limits."""
        good = arguments["measurement"]
        every = np.ones_like(good.visible)
        # Before any earlier reading: the clock of all sequences starts after this.
        back = good._replace(time=good.time - 2.0 * LIMITS.times / 3.0, visible=~every)
        for fault, name, measurement in (
            *(() if first else (("whose clock runs back", "time", back),)),
            ("of a future frame", "frame_time", good._replace(frame_time=good.time + 1.0, visible=every)),
            ("with a joint angle of 1e300", "joint_angles", good._replace(joint_angles=_one(rng, good.joint_angles))),
            ("with a feature of 1e300", "features", good._replace(features=_one(rng, good.features), visible=every)),
            ("with a goal of 1e300", "goal", good._replace(goal=_one(rng, good.goal))),
            ("with a truth value of 2", "visible", good._replace(visible=np.full(every.shape, 2))),
        ):
            yield Bad(f"measurement {fault}", (name,), {"measurement": measurement})


@dataclass(frozen=True)
class InformedInputs(ServoInputs):
    """`InformedMeasurement`s: servo measurements with the true geometry of camera and arm."""

    not_rounded: ClassVar[frozenset[str]] = frozenset({"geometry"})

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw servo measurements and one geometry for all of them."""
        plain = super().draw(rng, steps, extreme=extreme)
        camera = pack_camera(
            focal=rng.uniform(120.0, 240.0, self.batch),
            depth=rng.uniform(0.25, 0.6, self.batch),
            mounting=rng.uniform(-np.pi, np.pi, self.batch),
            tilt=rng.uniform(-0.2, 0.2, (*self.batch, 2)),
        )
        links = rng.uniform(0.4, 0.6, (*self.batch, 2))
        geometry = Geometry(camera, links, np.full(self.batch, 0.01), np.full(self.batch, 0.02))

        def informed(arguments: Arguments) -> Arguments:
            seen = arguments["measurement"]
            shared = {name: getattr(seen, name) for name in InformedMeasurement._fields if name != "geometry"}
            return {"measurement": InformedMeasurement(**shared, geometry=geometry)}

        return Sequence(informed(plain.start), tuple(informed(each) for each in plain.steps))


def _one(rng: np.random.Generator, array: Array) -> Array:
    """Copy of an array with one entry of 1e300."""
    out = array.copy()
    out[tuple(rng.integers(size) for size in out.shape)] = 1e300
    return out
