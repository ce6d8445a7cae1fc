"""Following one person among many with a moving camera: a set filter and a memory of the followed track."""

from servotrack.estimators.follow.crowd_follower import CrowdFollower, CrowdState
from servotrack.estimators.follow.ego_motion import CameraMotion, JacobianMotion, LiftedMotion, StillCamera
from servotrack.estimators.follow.follower import FollowState, PersonFollower, Sighting
from servotrack.estimators.follow.patch import patch_color
from servotrack.estimators.follow.vision import PeopleFromAbove

__all__ = [
    "CameraMotion",
    "CrowdFollower",
    "CrowdState",
    "FollowState",
    "JacobianMotion",
    "LiftedMotion",
    "PeopleFromAbove",
    "PersonFollower",
    "Sighting",
    "StillCamera",
    "patch_color",
]
