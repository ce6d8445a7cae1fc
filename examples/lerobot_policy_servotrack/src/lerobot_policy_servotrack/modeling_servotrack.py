"""Policy type `servotrack`: LeRobot's interface around `BoardServo`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_policy_servotrack.board_servo import BoardServoState
from lerobot_policy_servotrack.configuration_servotrack import ServotrackConfig


class ServotrackPolicy(PreTrainedPolicy):
    """Servo of a board of markers as a LeRobot policy: one robot, one action per observation, no parameters.

    Args:
        config: Configuration.
        **kwargs: LeRobot's statistics of a data set, which are not used.

    Raises:
        ValueError: Features or settings that do not fit.
    """

    config_class = ServotrackConfig
    name = "servotrack"

    def __init__(self, config: ServotrackConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self._servo = config.servo()
        self.reset()

    def reset(self) -> None:
        """Forget everything that was learned about arm and camera. Call it when one of them has been moved by hand."""
        self._state: BoardServoState | None = None
        self._held: Tensor | None = None

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the joints' set points for one period.

        Args:
            batch: Image, shape (1, 3, H, W), from 0 to 1, and state, shape (1, s).
            **kwargs: Not used.

        Returns:
            Action. Shape (1, a).

        Raises:
            ValueError: More than one robot in the batch.
        """
        image, state = batch[self.config.camera_key], batch[OBS_STATE]
        if image.ndim != 4 or image.shape[0] != 1 or state.shape[0] != 1:
            raise ValueError(
                f"the policy drives one robot: image and state must have a batch size of 1, got shapes "
                f"{tuple(image.shape)} and {tuple(state.shape)}"
            )
        if self._held is None:
            self._held = state.clone()
        pixels = (image[0] * 255.0).round().clamp(0, 255).to("cpu", torch.uint8).permute(1, 2, 0).contiguous().numpy()
        positions = state[0, : self.config.joints].to("cpu", torch.float64).numpy()
        scale = self.config.units_per_radian
        self._state, set_points = self._servo.step(self._state, pixels, positions / scale)
        action = self._held[:, : self.config.action_feature.shape[0]].clone()
        action[0, : self.config.joints] = torch.from_numpy(np.asarray(scale * set_points)).to(action)
        return action

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return a chunk of one action. Shape (1, 1, a)."""
        return self.select_action(batch)[:, None]

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        """Raise NotImplementedError: there is nothing to train."""
        raise NotImplementedError("servotrack learns while it drives; there is nothing to train: call select_action")

    def get_optim_params(self) -> list:
        """Return an empty list: there are no parameters."""
        return []
