"""Make a policy folder for `--policy.path` from an image that was taken at the wanted pose.

python -m lerobot_policy_servotrack goal.png my-goal --camera wrist
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_policy_servotrack.board_servo import find_corners
from lerobot_policy_servotrack.configuration_servotrack import ServotrackConfig
from lerobot_policy_servotrack.modeling_servotrack import ServotrackPolicy


def main() -> None:
    """Find the markers in the image and write the policy's folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("image", type=Path, help="image at the wanted pose, in the size that the camera delivers")
    parser.add_argument("folder", type=Path, help="folder to write")
    parser.add_argument("--camera", default="wrist", help="name of the camera in the robot's configuration")
    parser.add_argument("--markers", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--dictionary", default="DICT_4X4_50", help="name in cv2.aruco")
    parser.add_argument("--joints", type=int, default=5, help="joints to move, from the first on")
    parser.add_argument("--motors", type=int, default=6, help="positions in the robot's state and action")
    parser.add_argument("--fps", type=float, default=30.0, help="rate of the control loop, Hz")
    arguments = parser.parse_args()
    image = cv2.imread(str(arguments.image), cv2.IMREAD_COLOR)
    if image is None:
        parser.error(f"cannot read {arguments.image} as an image")
    corners = find_corners(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), tuple(arguments.markers), arguments.dictionary)
    missing = np.array(arguments.markers)[np.isnan(corners[::4, 0])].tolist()
    if missing:
        parser.error(f"markers {missing} are not seen in {arguments.image}; all of them must be")
    config = ServotrackConfig(
        input_features={
            f"{OBS_IMAGES}.{arguments.camera}": PolicyFeature(FeatureType.VISUAL, (3, *image.shape[:2])),
            OBS_STATE: PolicyFeature(FeatureType.STATE, (arguments.motors,)),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (arguments.motors,))},
        device="cpu",
        push_to_hub=False,
        goal=corners.ravel().round(3).tolist(),
        markers=arguments.markers,
        dictionary=arguments.dictionary,
        joints=arguments.joints,
        fps=arguments.fps,
    )
    ServotrackPolicy(config).save_pretrained(arguments.folder)
    for pipeline in make_pre_post_processors(config):
        pipeline.save_pretrained(arguments.folder)
    print(f"{arguments.folder}: pass it as --policy.path")


if __name__ == "__main__":
    main()
