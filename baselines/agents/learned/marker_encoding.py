"""Encoding of images: a marker detector's features, encoded like those of the world without images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.contract import Encoding
from servotrack.baselines.agents.servo.pixel_servo import MarkerFeatures, MarkerMemory
from servotrack.estimators.types import FloatArray


class MarkerEncodingMemory(NamedTuple):
    """Memory of `MarkerEncoding`.

    Attributes:
        seen: Newest detection of the marker.
        own: Memory of the encoding of features.
    """

    seen: MarkerMemory
    own: Any


@dataclass(frozen=True)
class MarkerEncoding:
    """Encoding of image observations: a marker detector, then an encoding of features.

    Attributes:
        features: Converts images to features.
        encoding: Encoding of the features.
    """

    features: MarkerFeatures
    encoding: Encoding

    @property
    def size(self) -> int:
        """Length of a row."""
        return self.encoding.size

    def initial(self, observation: Any) -> MarkerEncodingMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        seen = self.features.initial(observation)
        # `step` processes the first image; before it the marker counts as not visible.
        blind = {**observation, "features": seen.features, "visible": np.zeros_like(seen.frame_time)}
        return MarkerEncodingMemory(seen, self.encoding.initial(blind))

    def step(
        self, memory: MarkerEncodingMemory, observation: Any, action: FloatArray
    ) -> tuple[MarkerEncodingMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        seen, features = self.features.step(memory.seen, observation)
        own, rows = self.encoding.step(memory.own, features, action)
        return MarkerEncodingMemory(seen, own), rows

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the space of the network's answers; see `Encoding.answer_space`."""
        return self.encoding.answer_space(action_space)

    def act(self, memory: MarkerEncodingMemory, answer: FloatArray) -> tuple[MarkerEncodingMemory, NDArray[Any]]:
        """Convert the network's answer to actions; see `Encoding.act`."""
        own, action = self.encoding.act(memory.own, answer)
        return memory._replace(own=own), action
