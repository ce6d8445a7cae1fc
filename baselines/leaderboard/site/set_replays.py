"""Episodes of worlds with targets as the page draws them: true tracks, measurements, and the tracks of the answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from servotrack.baselines.leaderboard.site.packing import Packer
from servotrack.envs.streams import Streams
from servotrack.envs.track.clutter.episode import Stream
from servotrack.envs.track.clutter.world import ClutterWorld
from servotrack.envs.track.color.world import ColorWorld
from servotrack.envs.track.counts import poisson_quantile
from servotrack.envs.track.people.world import PeopleWorld
from servotrack.envs.track.set_world import SetWorld
from servotrack.envs.wrappers import OBSERVATION_KEY
from servotrack.estimators.metrics import Track
from servotrack.estimators.rfs.models import RangeBearingModel
from servotrack.estimators.types import Array

Form = Literal["points", "boxes", "bearings"]
"""Points on a plane, boxes (left, top, width, height) in an image, or bearings over time."""

TRACK_SHARE = 1 / 512
"""Rounding of tracks, in widths of the window: about a pixel of the page. Raising it saves bytes."""
SCAN_SHARE = 1 / 128
"""Rounding of measurements that the page cannot draw again, in widths of the window."""
ERROR_SHARE = 1 / 400
"""Rounding of errors, in cut-offs."""
_PADDING = 0.03
_LEAST_WINDOW = 4


@dataclass(frozen=True)
class Clutter:
    """False measurements, uniformly distributed, which the page draws again from the episode's random stream.

    Attributes:
        state, increment: State of the stream (PCG64) before the first draw.
        drawn: Measurements that are drawn for each scan.
        counts: Measurements of each scan, the first ones of those drawn.
        low, high: Bounds, shape (2,).
        sensor: Position of the sensor if coordinates are range and bearing, shape (2,), m.
    """

    state: int
    increment: int
    drawn: int
    counts: Sequence[int]
    low: Array
    high: Array
    sensor: Array | None

    @classmethod
    def of(cls, world: ClutterWorld, row: int, steps: int) -> Clutter | None:
        """Return the clutter of a scene; None if its scans hold other false measurements."""
        config = world.config
        stream = Streams(int(world.seeds[row]))[Stream.CLUTTER]
        start = stream.bit_generator.state["state"]
        low, high = config.seen
        drawn = poisson_quantile(config.clutter_rate)
        points = low + (high - low) * stream.random((steps, drawn, 2))
        counts = []
        for step in range(steps):
            scan, source, _, _ = world.scan(row, step)
            false = scan[source == -1, 1:]
            counts.append(len(false))
            if not np.array_equal(_ordered(false), _ordered(points[step, : len(false)])):
                return None
        sensor = np.array(config.sensor_position) if config.sensor == "range-bearing" else None
        return cls(start["state"], start["inc"], drawn, counts, low, high, sensor)

    def packed(self) -> dict[str, Any]:
        """Return the clutter for the page; numbers of 128 bits are hexadecimal texts."""
        return {
            "state": f"{self.state:x}",
            "increment": f"{self.increment:x}",
            "drawn": self.drawn,
            "counts": list(self.counts),
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "sensor": None if self.sensor is None else self.sensor.tolist(),
        }


@dataclass(frozen=True)
class SetScene:
    """Conditions of the episode of a seed, the same for all agents.

    Attributes:
        form: Kind of picture.
        window: Part of the world that is shown: low and high corner, shape (2, 2); along the first coordinate only for
            bearings.
        steps: Number of scans.
        rate: Scans in a second of a film.
        cutoff: Largest error of a scan.
        unit: Unit of errors.
        truth: True tracks.
        scans: Positions of the measurements of each scan, (m, 2) each; empty where measurements are no points.
        seen: Measurement of each state of each true track, (k, 2) each, NaN for none; None where it is unknown.
        clutter: All other measurements; None where they are unknown.
    """

    form: Form
    window: Array
    steps: int
    rate: float
    cutoff: float
    unit: str
    truth: Sequence[Track]
    scans: Sequence[Array]
    seen: Sequence[Array] | None = None
    clutter: Clutter | None = None

    @property
    def width(self) -> float:
        """Width of the window, the longer side."""
        return float((self.window[1] - self.window[0]).max())

    def packed(self, packer: Packer) -> dict[str, Any]:
        """Return the scene for the page."""
        step = self.width * TRACK_SHARE
        fields: dict[str, Any] = {
            "form": self.form,
            "window": [float(f"{value:.6g}") for value in self.window.reshape(-1)],
            "steps": self.steps,
            "rate": self.rate,
            "cutoff": self.cutoff,
            "unit": self.unit,
            "truth": _packed(packer, self.truth, step),
        }
        if self.seen is not None and self.clutter is not None and self.truth:
            offsets = np.concatenate([seen - track.states for seen, track in zip(self.seen, self.truth, strict=True)])
            missed = np.isnan(offsets[:, 0])
            curves = [packer.add(missed.astype(float), 1.0, order=0)]
            if not missed.all():
                curves += [packer.add(values, step, order=0) for values in offsets[~missed].T]
            return {**fields, "seen": curves, "clutter": self.clutter.packed()}
        if any(map(len, self.scans)):
            # The order of measurements means nothing. In order of their first coordinate they take fewer bytes.
            ordered = np.concatenate([_ordered(scan) for scan in self.scans])
            curves = [packer.add(ordered[:, axis], self.width * SCAN_SHARE, order=1 - axis) for axis in range(2)]
            fields["scans"] = [[len(scan) for scan in self.scans], curves]
        return fields


@dataclass(frozen=True)
class SetMotion:
    """One episode of an observer.

    Attributes:
        scene: Scene of its seed.
        tracks: Reported tracks, one per identity.
        errors: Error of each scan: OSPA, or 1 - IoU of a single box; NaN where it was not scored. Shape (steps,).
    """

    scene: SetScene
    tracks: Sequence[Track]
    errors: Array

    def packed(self, packer: Packer) -> dict[str, Any]:
        """Return the answers for the page; `tracks` is None if they are the measurements."""
        errors = np.where(np.isnan(self.errors), 0.0, self.errors)
        width, window = self.scene.width, self.scene.window
        # The distance of an answer far outside of the window does not show.
        low, high = window.min() - width, window.max() + width
        tracks = [Track(track.steps, np.clip(track.states, low, high)) for track in self.tracks]
        return {
            "tracks": None if self._copies else _packed(packer, tracks, width * TRACK_SHARE),
            "errors": packer.add(errors, self.scene.cutoff * ERROR_SHARE),
        }

    @property
    def _copies(self) -> bool:
        """True if every scan was answered by its measurements."""
        if not any(map(len, self.scene.scans)):
            return False
        answers: list[list[Array]] = [[] for _ in self.scene.scans]
        for track in self.tracks:
            for step, state in zip(track.steps.tolist(), track.states, strict=True):
                answers[step].append(state)
        rounding = self.scene.width * TRACK_SHARE
        return all(
            len(scan) == len(given)
            and (not given or bool((np.abs(np.sort(scan, axis=0) - np.sort(given, axis=0)) < rounding).all()))
            for scan, given in zip(self.scene.scans, answers, strict=True)
        )


def _ordered(points: Array) -> Array:
    return points[np.argsort(points[:, 0], kind="stable")]


def _packed(packer: Packer, tracks: Sequence[Track], step: float) -> list[Any]:
    """Runs of consecutive scans (number of the track, first scan, length), and one curve per coordinate of all runs."""
    runs, parts = [], []
    for number, track in enumerate(tracks):
        for part in np.split(np.arange(len(track.steps)), np.flatnonzero(np.diff(track.steps) != 1) + 1):
            if len(part):
                runs.append([number, int(track.steps[part[0]]), len(part)])
                parts.append(track.states[part])
    return [runs, [packer.add(values, step) for values in np.concatenate(parts).T] if parts else []]


class SetWatcher:
    """Records a world of targets; see `servotrack.baselines.leaderboard.site.replays.Watcher`.

    Args:
        env: The vector environment, after its reset.
        steps: Largest number of steps.
    """

    def __init__(self, env: Any, steps: int) -> None:
        self._world: SetWorld | PeopleWorld = env.unwrapped.world
        self._rate = float(env.unwrapped.metadata["render_fps"])
        model = getattr(getattr(env.unwrapped, "scene_model", None), "model", None)
        self._sensor = np.array(model.sensor) if isinstance(model, RangeBearingModel) else None
        self._lag = int(getattr(self._world, "lag", 0))
        count = len(self._world.steps)
        self._scans: list[list[Array]] = [[] for _ in range(count)]
        self._errors = np.full((count, max(steps - self._lag, 1)), np.nan)
        self._made: list[SetScene] | None = None

    def record(self, step: int, observation: Any) -> None:
        """Store a scan and the error of the answer to the one before."""
        if 0 < step - self._lag <= self._errors.shape[1]:
            self._errors[:, step - self._lag - 1] = self._world.ospa
        if isinstance(observation, dict):
            observation = observation.get(OBSERVATION_KEY)
        if isinstance(self._world, SetWorld) and isinstance(observation, np.ndarray) and observation.ndim == 3:
            for scans, rows in zip(self._scans, observation, strict=True):
                scans.append(self._placed(rows[rows[:, 0] > 0.5, 1:]))

    def _placed(self, points: Array) -> Array:
        if self._sensor is not None:
            bearing = points[:, 1]
            return self._sensor + points[:, :1] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        return points[:, :2].copy()

    def scenes(self) -> list[SetScene]:
        """Return the scene of each row. Call it when all episodes have ended."""
        if self._made is None:
            self._made = [self._scene(row) for row in range(len(self._scans))]
        return self._made

    def _scene(self, row: int) -> SetScene:
        world, steps = self._world, self._errors.shape[1]
        if isinstance(world, PeopleWorld):
            truth = world.true_tracks(row)
            form: Form = "boxes" if world.scorer.estimates.shape[-1] == 4 else "points"
            height, width = world.images[row].shape[:2]
            window = np.array([[0.0, 0.0], [width, height]])
            return SetScene(form, window, steps, self._rate, world.cutoff, "" if form == "boxes" else "px", truth, [])
        tracks = world.true_tracks(row)[..., :2]
        found = np.flatnonzero(~np.isnan(tracks[..., 0]).all(axis=1))
        truth = [
            Track(np.flatnonzero(there), track[there]) for track in tracks[found] for there in [~np.isnan(track[:, 0])]
        ]
        scans = self._scans[row][:steps] if tracks.shape[-1] == 2 else []
        places = np.concatenate([np.zeros((0, tracks.shape[-1])), *(track.states for track in truth), *scans])
        low, high = (places.min(axis=0), places.max(axis=0)) if len(places) else (np.zeros(1), np.ones(1))
        # A few cut-offs at least: nothing may move in a scene.
        reach = max(float((high - low).max()), _LEAST_WINDOW * world.cutoff) * (0.5 + _PADDING)
        middle = np.resize((low + high) / 2, 2)
        form, unit = ("points", "m") if tracks.shape[-1] == 2 else ("bearings", "deg")
        window = np.array([middle - reach, middle + reach])
        scene = SetScene(form, window, steps, self._rate, world.cutoff, unit, truth, scans)
        if isinstance(world, ClutterWorld) and (clutter := Clutter.of(world, row, steps)) is not None:
            seen = [self._seen(row, target, track) for target, track in zip(found.tolist(), truth, strict=True)]
            return replace(scene, seen=seen, clutter=clutter)
        return scene

    def _seen(self, row: int, target: int, track: Track) -> Array:
        """Return the measurement of each state of a true track, shape (k, 2); NaN for none."""
        assert isinstance(self._world, ClutterWorld)
        seen = np.full((len(track.steps), 2), np.nan)
        for k, step in enumerate(track.steps.tolist()):
            scan, source, _, _ = self._world.scan(row, step)
            if (own := np.flatnonzero(source == target)).size:
                seen[k] = self._placed(scan[own, 1:])[0]
        return seen

    def motion(self, row: int, length: int) -> SetMotion:
        """Return the answers of a row."""
        tracks = [Track(track.steps, track.states[:, :2] if track.states.shape[1] == 3 else track.states)
                  for track in self._world.scorer.tracks(row)]  # fmt: skip
        return SetMotion(self.scenes()[row], tracks, self._errors[row])


class BoxWatcher:
    """Records a world with one box; see `servotrack.baselines.leaderboard.site.replays.Watcher`.

    Args:
        env: The vector environment, after its reset.
        steps: Largest number of steps.
    """

    def __init__(self, env: Any, steps: int) -> None:
        self._world: ColorWorld = env.unwrapped.world
        self._rate = float(env.unwrapped.metadata["render_fps"])
        count = len(self._world.steps)
        self._truth, self._answers = np.zeros((2, count, steps, 4))
        self._errors = np.ones((count, steps))
        self._size = self._world.observations.shape[2:0:-1]

    def record(self, step: int, observation: Any) -> None:
        """Store the true box of a frame and the answer to the one before."""
        if step:
            self._answers[:, step - 1], self._errors[:, step - 1] = self._world.answers, 1.0 - self._world.iou
        if step < self._truth.shape[1]:
            self._truth[:, step] = self._world.boxes

    def scenes(self) -> list[SetScene]:
        """Return the scene of each row."""
        window, steps = np.array([[0.0, 0.0], self._size]), np.arange(self._truth.shape[1])
        return [
            SetScene("boxes", window, len(steps), self._rate, 1.0, "", [Track(steps, boxes)], [])
            for boxes in self._truth
        ]

    def motion(self, row: int, length: int) -> SetMotion:
        """Return the answers of a row."""
        steps, (width, height) = np.arange(length), self._size
        boxes = np.clip(self._answers[row, :length], -max(width, height), 2 * max(width, height))
        return SetMotion(self.scenes()[row], [Track(steps, boxes)], self._errors[row])
