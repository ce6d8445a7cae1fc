"""N color worlds at once: the one piece of bookkeeping behind the single and the vector environment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.color.config import ColorConfig
from servotrack.envs.track.color.scene import Painter, draw_scene
from servotrack.envs.track.color.scoring import center_errors, failures, overlaps, precision, success_curve
from servotrack.estimators.types import Array, Mask

_FARTHEST = 1e12
"""Answers count as no farther out than this, px."""


class ColorWorld:
    """N scenes with N observers, stepped together; arrays carry a leading axis of N.

    An observer sees frame k and answers with the target's box in it; `step` scores that answer and moves on to frame
    k + 1. Frames are drawn when their turn comes.

    Args:
        config: The world's parameters.
        count: Number of scenes N.

    Attributes:
        observations: The newest frames, shape (N, height, width, 3), uint8.
        first_boxes: The true box in each episode's first frame, shape (N, 4), px.
        boxes: The true box in the newest frame, shape (N, 4), px.
        answers: The last answer, shape (N, 4), px; the first box before any.
        steps: Frames answered so far, shape (N,).
        reward: The last answer's IoU, shape (N,).
        terminated: Never; shape (N,), bool.
        truncated: All frames answered, shape (N,), bool.
        iou: The same as `reward`.
        center_error: Of the last answer, shape (N,), px.
        auc, precision, failures: Of the episode, shape (N,); 0 until `truncated`.
    """

    def __init__(self, config: ColorConfig, count: int) -> None:
        self.config = config
        self.count = count
        self._painters: list[Painter | None] = [None] * count
        self._overlaps, self._errors = np.zeros((count, config.horizon)), np.zeros((count, config.horizon))
        self.observations = np.zeros((count, config.height, config.width, 3), np.uint8)
        self.first_boxes, self.boxes = np.zeros((count, 4)), np.zeros((count, 4))
        self.answers = np.zeros((count, 4))
        self.steps = np.zeros(count, np.int64)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.reward, self.iou, self.center_error = np.zeros(count), np.zeros(count), np.zeros(count)
        self.auc, self.precision, self.failures = np.zeros(count), np.zeros(count), np.zeros(count, np.int64)

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows; the others are left as they are, to the bit.

        Args:
            rows: Which of the N.
            seeds: One episode seed for each, non-negative integers.
        """
        for row, seed in zip(rows, seeds, strict=True):
            painter = Painter(self.config, draw_scene(self.config, seed))
            self._painters[row] = painter
            self.first_boxes[row] = self.answers[row] = painter.scene.boxes[0]
            self.steps[row], self.truncated[row] = 0, False
            self.auc[row], self.precision[row], self.failures[row] = 0.0, 0.0, 0
            self._show(row)

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score every row's answer to its newest frame, and show the next frame.

        Args:
            answers: Shape (N, 4): left, top, width and height, px.
            running: Which of the N have an episode under way, (N,) bool; None for all. The others wait for their reset
                at the frame they are at.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        # Numbers whose products would be infinite tell no more than these.
        answers = np.minimum(np.maximum(answers, -_FARTHEST), _FARTHEST)
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

    def _show(self, row: int) -> None:
        painter = self._painters[row]
        assert painter is not None
        step = int(self.steps[row])
        self.observations[row], self.boxes[row] = painter.frame(step), painter.scene.boxes[step]

    def truth(self) -> dict[str, NDArray]:
        """What info tells of the newest frame: the target's box, hidden or not."""
        return {"box": self.boxes}

    def scores(self) -> dict[str, NDArray]:
        """What info tells of the last answer."""
        return {"iou": self.iou, "center_error": self.center_error}

    def episode_scores(self) -> dict[str, NDArray]:
        """What info tells of a whole episode when it has ended."""
        return {"auc": self.auc, "precision": self.precision, "failures": self.failures}

    def answered_overlaps(self, row: int) -> Array:
        """IoU of every answer of a row's episode so far, shape (steps,); a view."""
        return self._overlaps[row, : self.steps[row]]

    def privileged(self) -> dict[str, Array]:
        """The truth for oracles: `true_box`, shape (N, 4), px."""
        return {"true_box": self.boxes.copy()}

    def debug_view(self, row: int = 0) -> str:
        """One scene's state as text, for debugging."""
        box, answer = (np.round(b[row], 1).tolist() for b in (self.boxes, self.answers))
        return f"frame {self.steps[row]}/{self.config.horizon}  box={box}  answer={answer}  iou={self.iou[row]:.3f}"
