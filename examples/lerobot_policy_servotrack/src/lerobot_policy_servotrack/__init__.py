"""Uncalibrated visual servoing as a LeRobot policy. Importing the package registers the policy type `servotrack`."""

from lerobot_policy_servotrack.configuration_servotrack import ServotrackConfig

__all__ = ["ServotrackConfig"]
