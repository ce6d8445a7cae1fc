"""N color tracking scenes stepped together, for the single and the vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.state import State
from servotrack.envs.track.color.config import ColorConfig
from servotrack.envs.track.color.scene import Painter, draw_scene
from servotrack.envs.track.color.scoring import center_errors, failures, overlaps, precision, success_curve
from servotrack.envs.track.resumed import draw_again, scored_state
from servotrack.estimators.types import Array, Mask

_MAX_COORDINATE = 1e12
"""Coordinates and sizes of answers are clipped to this magnitude, px."""


_SCORES = (
    "truncated", "reward", "iou", "center_error", "auc", "precision", "failures", "answers", "_overlaps", "_errors",
)  # fmt: skip


class ColorWorld:
    """N scenes with one observer each, stepped together. Arrays have a leading axis of N.

    The observer gets frame k and answers with the box of the target in it. `step` scores the answer and advances to
    frame k + 1. Frames are rendered one by one, when they are needed.

    Args:
        config: Parameters of the environment.
        count: Number of scenes N.

    Attributes:
        observations: Newest frames, shape (N, height, width, 3), uint8.
        first_boxes: True box in the first frame of each episode, shape (N, 4), px.
        boxes: True box in the newest frame, shape (N, 4), px.
        answers: Last answer, shape (N, 4), px; the first box before any answer.
        steps: Number of answered frames, shape (N,).
        reward: IoU of the last answer, shape (N,).
        terminated: Always False, shape (N,).
        truncated: True if all frames are answered, shape (N,), bool.
        iou: Same as `reward`.
        center_error: Center error of the last answer, shape (N,), px.
        auc, precision, failures: Scores of the episode, shape (N,); 0 until `truncated`.
    """

    def __init__(self, config: ColorConfig, count: int) -> None:
        self.config = config
        self.count = count
        self._painters: list[Painter | None] = [None] * count
        self._overlaps, self._errors = np.zeros((count, config.horizon)), np.zeros((count, config.horizon))
        self.observations = np.zeros((count, config.height, config.width, 3), np.uint8)
        self.first_boxes, self.boxes = np.zeros((count, 4)), np.zeros((count, 4))
        self.answers = np.zeros((count, 4))
        self.steps, self.seeds = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.reward, self.iou, self.center_error = np.zeros(count), np.zeros(count), np.zeros(count)
        self.auc, self.precision, self.failures = np.zeros(count), np.zeros(count), np.zeros(count, np.int64)

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows do not change.

        Args:
            rows: Indices of the scenes.
            seeds: Episode seed of each, non-negative integers.
        """
        for row, seed in zip(rows, seeds, strict=True):
            painter = Painter(self.config, draw_scene(self.config, seed))
            self._painters[row] = painter
            self.first_boxes[row] = self.answers[row] = painter.scene.boxes[0]
            self.seeds[row], self.steps[row], self.truncated[row] = seed, 0, False
            self.auc[row], self.precision[row], self.failures[row] = 0.0, 0.0, 0
            self._show(row)

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score the answers to the newest frames, and advance to the next frames.

        Args:
            answers: Left, top, width and height, shape (N, 4), px.
            running: True for scenes whose episode is running, shape (N,), bool; None: all. The other scenes stay at
                their frame until they are reset.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        # Products of larger numbers would overflow to infinity.
        answers = np.minimum(np.maximum(answers, -_MAX_COORDINATE), _MAX_COORDINATE)
        self.iou, self.center_error = overlaps(answers, self.boxes), center_errors(answers, self.boxes)
        self.reward = self.iou
        self.answers = np.where(running[:, None], answers, self.answers)
        for row in np.flatnonzero(running).tolist():
            step = int(self.steps[row])
            self._overlaps[row, step], self._errors[row, step] = self.iou[row], self.center_error[row]
            self.steps[row] = step + 1
            if step + 1 >= self.config.horizon:
                self.truncated[row] = True
                self.auc[row] = success_curve(self._overlaps[row]).mean()
                self.precision[row] = precision(self._errors[row])
                self.failures[row] = failures(self._overlaps[row])
            self._show(row)

    def get_state(self) -> State:
        """Return the exact state: the episodes' seeds, the steps, and the scores so far."""
        return scored_state(self, _SCORES)

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned. Scenes are drawn again from their seeds.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        draw_again(self, _SCORES, state, self.config.horizon)
        for row in range(self.count):
            self._show(row)

    def _show(self, row: int) -> None:
        painter = self._painters[row]
        assert painter is not None
        step = int(self.steps[row])
        self.observations[row], self.boxes[row] = painter.frame(step), painter.scene.boxes[step]

    def truth(self) -> dict[str, NDArray]:
        """Return the entries of `info["truth"]` for the newest frame: the box of the target, occluded or not."""
        return {"box": self.boxes}

    def scores(self) -> dict[str, NDArray]:
        """Return the entries of `info` for the last answer."""
        return {"iou": self.iou, "center_error": self.center_error}

    def episode_scores(self) -> dict[str, NDArray]:
        """Return the entries of `info` at the end of an episode."""
        return {"auc": self.auc, "precision": self.precision, "failures": self.failures}

    def answered_overlaps(self, row: int) -> Array:
        """Return a view of the IoU of all answers of a row's episode so far, shape (steps,)."""
        return self._overlaps[row, : self.steps[row]]

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.config.horizon

    def privileged(self) -> dict[str, Array]:
        """Return the privileged information of oracle agents: `true_box`, shape (N, 4), px."""
        return {"true_box": self.boxes.copy()}

    def debug_view(self, row: int = 0) -> str:
        """Return the state of a scene as text, for debugging."""
        box, answer = (np.round(b[row], 1).tolist() for b in (self.boxes, self.answers))
        return f"frame {self.steps[row]}/{self.config.horizon}  box={box}  answer={answer}  iou={self.iou[row]:.3f}"
