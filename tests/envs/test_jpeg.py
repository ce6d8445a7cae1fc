"""JPEG artifacts agree with a file written and read by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.draw import Stage
from servotrack.envs.track.pedestrians.jpeg import JpegCoder
from servotrack.envs.track.pedestrians.people import People

NOBODY = People(np.zeros(0, np.int64), np.zeros((0, 2)), *(np.zeros(0) for _ in range(4)), np.zeros(0, np.int64))


def through_a_file(image: np.ndarray, quality: int) -> np.ndarray:
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality]
    written, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)
    assert written
    return cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)


@pytest.mark.parametrize("quality", [10, 37, 55, 91, 100])
def test_a_frame_is_left_as_a_file_leaves_it(quality):
    lobby = Stage(PedestrianConfig(sensor_noise=7.0), 3).draw(NOBODY, 0).image
    np.testing.assert_array_equal(JpegCoder(384, 288, quality).code(lobby), through_a_file(lobby, quality))


@pytest.mark.parametrize(("width", "height"), [(64, 64), (66, 65), (333, 251), (350, 242), (72, 90)])
def test_sizes_that_blocks_do_not_fill_and_the_hardest_colors(width, height):
    rng, coder = np.random.default_rng(width), JpegCoder(width, height, 60)
    for high, factor in ((256, 1), (2, 255)):
        image = (rng.integers(0, high, (height, width, 3)) * factor).astype(np.uint8)
        coded = coder.code(image)
        np.testing.assert_array_equal(coded, through_a_file(image, 60))
        assert coded.flags.c_contiguous


def test_a_coded_frame_is_not_written_to_again():
    rng, coder = np.random.default_rng(0), JpegCoder(80, 64, 50)
    first = coder.code(rng.integers(0, 256, (64, 80, 3)).astype(np.uint8))
    kept = first.copy()
    coder.code(rng.integers(0, 256, (64, 80, 3)).astype(np.uint8))
    np.testing.assert_array_equal(first, kept)
