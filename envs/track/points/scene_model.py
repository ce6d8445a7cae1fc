"""The scene model of recorded points: parameters that are measured from the points themselves."""

from __future__ import annotations

import numpy as np

from servotrack.envs.track.clutter.scene_model import SceneModel
from servotrack.envs.track.points.clutter_map import MappedClutter
from servotrack.envs.track.points.measured_model import measured_model
from servotrack.envs.track.points.point_model import LEAST_EXISTENCE, birth_place, clutter_intensity, motion_of
from servotrack.envs.track.points.recording import PointRecording


def scene_model_of(recording: PointRecording) -> SceneModel:
    """Measure the scene model of recorded points on the first 300 scans of their source; see `measured_model`."""
    model, _ = measured_model(recording.whole)
    motion, intensity = motion_of(recording.whole, model), clutter_intensity(model)
    center, covariance = birth_place(model)
    low, high = recording.region
    return SceneModel(
        model=motion,
        hidden_markov=motion,
        survival_probability=model.survival,
        detection_probability=model.detection,
        clutter_rate=model.clutter_rate,
        seen_low=low,
        seen_high=high,
        birth_means=center[None],
        birth_covariance=covariance,
        birth_weights=np.array([min(model.births, 1.0)]),
        region_low=low,
        region_high=high,
        cutoff=recording.cutoff,
        lag=recording.lag,
        least_existence=LEAST_EXISTENCE,
        clutter_map=intensity if isinstance(intensity, MappedClutter) else None,
        maneuver=model.maneuver,
        agility=model.agility,
    )
