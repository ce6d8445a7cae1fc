"""One of CleanRL's scripts for continuous actions, unchanged.

    python cleanrl_script.py CLEANRL/cleanrl/sac_continuous_action.py --total-timesteps 20000

The scripts are written for Gymnasium 0.29; what newer versions call otherwise is given its old name here.
"""

import runpy
import sys
from pathlib import Path

import gymnasium as gym

from servotrack.envs import FlatSets

transform = gym.wrappers.TransformObservation


class Arms(gym.vector.SyncVectorEnv):
    """Environments that reset in the step that ends an episode, and report it as Gymnasium 0.29 did."""

    def __init__(self, makers):
        super().__init__(makers, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)

    def step(self, actions):
        """Step all environments."""
        *results, infos = super().step(actions)
        if "final_obs" in infos:
            infos["final_observation"], episode = infos["final_obs"], infos["final_info"]["episode"]
            ended = infos["_final_obs"].nonzero()[0]
            infos["final_info"] = [{"episode": {key: episode[key][row] for key in "rl"}} for row in ended]
        return (*results, infos)


gym.register(
    "Servo-v0", lambda **kw: gym.wrappers.FlattenObservation(FlatSets(gym.make("UncalibServo-v0", level=2, **kw)))
)
gym.vector.SyncVectorEnv = Arms
gym.wrappers.TransformObservation = lambda env, function: transform(env, function, env.observation_space)
sys.argv = [sys.argv[1], "--env-id", "Servo-v0", *sys.argv[2:]]
sys.path.insert(0, str(Path(sys.argv[0]).parents[1]))
runpy.run_path(sys.argv[0], run_name="__main__")
