"""Trackers of one object by its color: a box in the first frame, a box in every later one.

    tracker = MonteCarloColorPlus()
    state = tracker.initial(frames[0], box)  # left, top, width, height
    for frame in frames[1:]:
        state, estimate = tracker.step(state, frame)
        print(estimate.box, estimate.similarity)

`MonteCarloColor` is paper 001's, `MonteCarloColorPlus` the one to start with, `KernelMeanShift` the strongest of the
others where the light is steady and nothing passes before the object. All are frozen dataclasses; states are values but
for those of `OpenCVTracker`.
"""

from servotrack.estimators.color.back_projection import BackProjection
from servotrack.estimators.color.contract import BoxEstimate
from servotrack.estimators.color.mean_shift import KernelMeanShift
from servotrack.estimators.color.monte_carlo import MonteCarloColor
from servotrack.estimators.color.monte_carlo_plus import MonteCarloColorPlus
from servotrack.estimators.color.opencv_trackers import OpenCVTracker
from servotrack.estimators.color.particle_filter import ColorParticleFilter
from servotrack.estimators.color.start import Start, start_from_motion

__all__ = [
    "BackProjection",
    "BoxEstimate",
    "ColorParticleFilter",
    "KernelMeanShift",
    "MonteCarloColor",
    "MonteCarloColorPlus",
    "OpenCVTracker",
    "Start",
    "start_from_motion",
]
