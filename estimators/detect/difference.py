"""Frames against a background: what differs, what is above a threshold, what is learned."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.camera_motion import small_copy
from servotrack.estimators.detect.soft_light import is_shadow
from servotrack.estimators.types import FloatArray, Image


def difference_of(image: Image, background: Image, color: str) -> Image:
    """Return the difference of each pixel to the background, gray levels. Shape (H, W), uint8.

    Args:
        image: The frame. Shape (H, W, 3) or (H, W), uint8.
        background: The background. The same shape, uint8.
        color: "gray" to compare gray levels, "max" for the channel that differs most.
    """
    if color == "gray" and image.ndim == 3:
        gray, gray_background = (cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in (image, background))
        return np.asarray(cv2.absdiff(gray, gray_background), dtype=np.uint8)
    if image.ndim == 2:
        return np.asarray(cv2.absdiff(image, background), dtype=np.uint8)
    difference = np.empty(image.shape[:2], np.uint8)
    _largest_difference(image.reshape(-1), background.reshape(-1), difference.reshape(-1))
    return difference


def frames_of_same_light(frames: list[Image], change: float, share: float, width: int = 64) -> int:
    """Return the number of first frames without a change of light, at least 1.

    People change less of the picture than a change of light does.

    Args:
        frames: Frames of one shape, in the order of time.
        change: Difference of brightness from which a place has changed, gray levels, on small copies without noise.
        width: Largest width of the small copies, px.
        share: Share of the places from which the light has changed, not the people.
    """
    first = small_copy(frames[0], width)
    for count, frame in enumerate(frames[1:], 1):
        difference = np.asarray(cv2.absdiff(small_copy(frame, width), first), dtype=np.uint8)
        if cv2.countNonZero(above(difference, change)) > share * difference.size:
            return count
    return len(frames)


def start_of_light(frames: list[Image], change: float, share: float, lasting: int = 3) -> int:
    """Return the number of first frames that are black or belong to a light that does not last, as in a fade-in.

    Args:
        frames: Frames of one shape, in the order of time.
        change: See `frames_of_same_light`.
        share: See `frames_of_same_light`.
        lasting: Number of frames of one light from which it lasts.
    """
    black = 0
    while black < len(frames) - 1 and np.percentile(small_copy(frames[black], 64), 95) < 16.0:
        black += 1
    black = 0 if black == len(frames) - 1 else black
    for begin in range(black, len(frames) - lasting + 1):
        if frames_of_same_light(frames[begin : begin + lasting], change, share) == lasting:
            return begin
    return black


@njit(cache=True, nogil=True)
def _largest_difference(image, background, difference):  # type: ignore[no-untyped-def]
    for n in range(difference.size):
        red, other_red = image[3 * n], background[3 * n]
        green, other_green = image[3 * n + 1], background[3 * n + 1]
        blue, other_blue = image[3 * n + 2], background[3 * n + 2]
        # In uint8 all along, so that the compiler vectorizes this loop.
        red = np.uint8(max(red, other_red) - min(red, other_red))
        green = np.uint8(max(green, other_green) - min(green, other_green))
        blue = np.uint8(max(blue, other_blue) - min(blue, other_blue))
        difference[n] = max(red, max(green, blue))


def rounded(background: FloatArray) -> Image:
    """Return a background in whole gray levels. Shape as given, uint8."""
    return np.asarray(cv2.convertScaleAbs(background), dtype=np.uint8)


def above(difference: Image, threshold: float) -> Image:
    """Mask of 255 where the difference is at least the threshold; OpenCV tests "greater than" on whole numbers."""
    return np.asarray(cv2.threshold(difference, math.ceil(threshold) - 1, 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)


@njit(cache=True, nogil=True)
def share_above(difference, level, stride):  # type: ignore[no-untyped-def]
    """Share of a sample of the pixels whose difference is above a level, 0 to 1.

    Args:
        difference: Gray levels. Shape (H, W), uint8.
        level: Gray levels.
        stride: Distance of the sampled pixels, px.
    """
    count, total = 0, 0
    for row in range(0, difference.shape[0], stride):
        for column in range(0, difference.shape[1], stride):
            count += difference[row, column] > level
            total += 1
    return count / total


@njit(cache=True, nogil=True)
def levels_of_sample(background, difference, mask, stride, quiet):  # type: ignore[no-untyped-def]
    """Brightness of the background and level of its noise in a sample of the pixels.

    Args:
        background: The background. Shape (H, W, C), uint8.
        difference: Difference of the frame to it, gray levels. Shape (H, W), uint8.
        mask: Foreground, left out of the noise. Shape (H, W), uint8.
        stride: Distance of the sampled pixels, px.
        quiet: Share of the sampled background that the noise level is not below.

    Returns:
        Median of the brightest channel, gray levels; quantile of the difference outside of the mask, gray levels; and
        number of sampled pixels outside of the mask.
    """
    brightest, noise = np.zeros(256, np.int64), np.zeros(256, np.int64)
    total, count = 0, 0
    for row in range(0, mask.shape[0], stride):
        for column in range(0, mask.shape[1], stride):
            largest = 0
            for channel in range(background.shape[2]):
                largest = max(largest, background[row, column, channel])
            brightest[largest] += 1
            total += 1
            if mask[row, column] == 0:
                noise[difference[row, column]] += 1
                count += 1
    lower, upper = _ranked(brightest, (total - 1) // 2), _ranked(brightest, total // 2)
    return 0.5 * (lower + upper), float(_ranked(noise, int(quiet * (count - 1)))), count


@njit(cache=True, nogil=True)
def _ranked(histogram, rank):  # type: ignore[no-untyped-def]
    """Value of a rank, counted from 0, in a histogram of whole numbers."""
    below = 0
    for value in range(len(histogram)):
        below += histogram[value]
        if below > rank:
            return value
    return 0


def learned(image: Image, background: FloatArray, held: NDArray[np.int32], rate: np.float32) -> FloatArray:
    """Return the background after a frame (Wu and Hu 2010, equation 6); it stays as it was under some runs.

    Args:
        image: The frame. Shape (H, W, 3) or (H, W), uint8.
        background: The background. The same shape, float32.
        held: Runs of pixels that are not learned, see `label_runs`. Shape (n, 4), int32.
        rate: Weight of the frame, in [0, 1].
    """
    after, channels = np.empty_like(background), image.shape[2] if image.ndim == 3 else 1
    _learn(image.reshape(-1), background.reshape(-1), held, image.shape[1], channels, rate, after.reshape(-1))
    return after


@njit(cache=True, nogil=True)
def _learn(image, background, held, width, channels, rate, learned):  # type: ignore[no-untyped-def]
    # One pass over memory instead of a copy and a masked update. Products of two float32 numbers are exact in double
    # precision, so that the sum is rounded once, as by a fused multiplication and addition.
    kept = np.float64(np.float32(1.0) - rate)
    for n in range(image.size):
        learned[n] = kept * np.float64(background[n]) + np.float64(rate * np.float32(image[n]))
    for run in range(len(held)):
        start = held[run, 0] * width
        for n in range((start + held[run, 1]) * channels, (start + held[run, 2]) * channels):
            learned[n] = background[n]


@njit(cache=True, nogil=True)
def drop_shadows(mask, image, background, rules):  # type: ignore[no-untyped-def]
    """Remove pixels whose channels are all darker by about the same factor, in place."""
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            if mask[row, column] and is_shadow(image, background, row, column, column + 1, rules):
                mask[row, column] = 0
