"""Following one of many: a set filter on a moving camera, and a memory of which of its tracks is the one."""

from servotrack.estimators.follow.ego_motion import CameraMotion, JacobianMotion, LiftedMotion, StillCamera
from servotrack.estimators.follow.follower import FollowState, PersonFollower, Sighting
from servotrack.estimators.follow.patch import patch_color
from servotrack.estimators.follow.vision import PeopleFromAbove

__all__ = [
    "CameraMotion",
    "FollowState",
    "JacobianMotion",
    "LiftedMotion",
    "PeopleFromAbove",
    "PersonFollower",
    "Sighting",
    "StillCamera",
    "patch_color",
]
