"""Calibrated servo agents by name: what they read of an environment."""

from __future__ import annotations

from typing import Any

from servotrack.baselines.agents.servo3d.calibrated import LAWS, OBSERVATION_KEYS, CalibratedServo
from servotrack.baselines.worlds import public_attribute

_LIMITS = ("max_joint_rate", "joint_low", "joint_high")


def create_calibrated_servo(env: Any, law: str) -> CalibratedServo:
    """Create a calibrated servo; only the environment's joint limits and its observation space are read.

    Args:
        env: A serial-arm environment or vector environment, with the truth in its observations.
        law: A key of `LAWS`.

    Raises:
        ValueError: Another environment, observations without the truth, or too few points for the law.
    """
    space = getattr(env, "single_observation_space", env.observation_space)
    keys = set(getattr(space, "spaces", ()))
    limits = [public_attribute(env, name) for name in _LIMITS]
    if any(limit is None for limit in limits) or not keys.issuperset(OBSERVATION_KEYS):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"a calibrated servo ({law}) needs {', '.join(_LIMITS)} and the observations "
            f"{', '.join(OBSERVATION_KEYS)}; {name} lacks them: "
            "wrap UncalibServo3D-v0 in PrivilegedObservation, or choose another agent"
        )
    points = space["visible"].shape[0]
    if points < LAWS[law]:
        raise ValueError(f"this law ({law}) needs at least {LAWS[law]} points on the board, got points={points}")
    return CalibratedServo(law, *limits)
