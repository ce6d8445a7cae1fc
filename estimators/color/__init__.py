"""Trackers of one object by its color: given a box in the first frame, they report a box in every later frame.

    tracker = MonteCarloColorPlus()
    state = tracker.initial(frames[0], box)  # left, top, width, height
    for frame in frames[1:]:
        state, estimate = tracker.step(state, frame)
        print(estimate.box, estimate.similarity)

Start with `MonteCarloColorPlus`. `MonteCarloColor` is the tracker of Zhang and Li 2008; `KernelMeanShift` is the most
accurate of the others under steady light and without occlusion. All are frozen dataclasses; all states except those of
`OpenCVTracker` are immutable values.
"""

from servotrack.estimators.color.back_projection import BackProjection
from servotrack.estimators.color.contract import BoxEstimate
from servotrack.estimators.color.light import Light, LightMeter
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
    "Light",
    "LightMeter",
    "MonteCarloColor",
    "MonteCarloColorPlus",
    "OpenCVTracker",
    "Start",
    "start_from_motion",
]
