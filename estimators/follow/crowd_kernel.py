"""Compiled recursion of `CrowdFollower`: tracks of all people, and hypotheses about which of them is the person."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.follow.crowd_hypotheses import add_turns, renew_guesses, split_guesses
from servotrack.estimators.follow.crowd_people import move_people
from servotrack.estimators.follow.crowd_tracks import register_image, start_tracks, update_tracks, weigh_tracks


@njit(cache=True, nogil=True)
def follow_crowd(  # type: ignore[no-untyped-def]
    detections, fresh, elapsed, jitter, crowd, guesses, memory, rules, features, visible
):
    """Update every run with its new frame.

    Args:
        detections: Detections. Shape (B, M, 8).
        fresh: Mask of the runs with a new frame. Shape (B,).
        elapsed: Time since the last frame. Shape (B,), s.
        jitter: Variance of the camera's predicted motion along each axis. Shape (B,), px^2.
        crowd: Tracks of all people, `People`; changed.
        guesses: Hypotheses of the person, `People`; changed.
        memory: A `CrowdMemory`; changed.
        rules: A `CrowdRules`.
        features: Output: position of the person. Shape (B, 2), px.
        visible: Output: True where the most probable hypothesis has a detection of its own. Shape (B,).
    """
    for b in range(detections.shape[0]):
        features[b] = memory.place[b]
        if fresh[b]:
            _follow_run(b, detections[b], elapsed[b], jitter[b], crowd, guesses, memory, rules, features, visible)


@njit(cache=True, nogil=True)
def _follow_run(b, detections, dt, jitter, crowd, guesses, memory, rules, features, visible):  # type: ignore[no-untyped-def]
    """Update run b; arguments as above."""
    width = memory.width[b]
    move_people(crowd, b, dt, rules.crowd_acceleration, width, rules)
    move_people(guesses, b, dt, rules.acceleration, width, rules)
    if jitter > 0.0:
        shift = np.zeros(2)
        left = register_image(crowd, b, detections, jitter, rules, shift)
        for people in (crowd, guesses):
            for axis in range(2):
                people.mean[b, :, axis] += shift[axis]
            people.spread[b, :, 0] += left
    add_turns(guesses, b, dt, width, rules)
    found = weigh_tracks(b, detections, dt, crowd, memory, rules)
    parts = split_guesses(b, detections, dt, crowd, guesses, memory, rules, found)
    second = update_tracks(b, detections, crowd, guesses, rules, found, parts)
    born = start_tracks(b, detections, crowd, memory, rules, found)
    renew_guesses(b, detections, crowd, guesses, memory, rules, found.owner, second, born, parts, features, visible)
