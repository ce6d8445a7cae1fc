"""Agent of the public board in Python: Broyden's rule learns how the image moves with the joints.

servotrack submit --command "python agent.py" --name my-agent
"""

import json
import sys

GAIN, PROBING, LEAST_MOVE, TRUST = 4.0, 6, 0.03, 0.3


def begin(observation):
    """Return the memory at the beginning of an episode: the Jacobian (px/rad), steps, joints and features."""
    return {"J": [[0.0, 0.0], [0.0, 0.0]], "step": 0, "q": observation["joint_angles"], "f": observation["features"]}


def learn(memory, observation):
    """Update the Jacobian by the move since the last update."""
    q, f, J = observation["joint_angles"], observation["features"], memory["J"]
    dq = [q[0] - memory["q"][0], q[1] - memory["q"][1]]
    size = dq[0] * dq[0] + dq[1] * dq[1]
    if size < LEAST_MOVE * LEAST_MOVE:
        return
    # The first moves, of single joints, are believed. Later ones also hold the target's motion.
    share = 1.0 if memory["step"] <= PROBING + 1 else TRUST
    for i in range(2):
        miss = f[i] - memory["f"][i] - (J[i][0] * dq[0] + J[i][1] * dq[1])
        J[i][0] += share * miss * dq[0] / size
        J[i][1] += share * miss * dq[1] / size
    memory["q"], memory["f"] = q, f


def act(memory, observation, max_joint_rate):
    """Return the joint rates as shares of the largest rate."""
    if observation["visible"][0] == 1.0:
        learn(memory, observation)
    memory["step"] += 1
    if memory["step"] <= PROBING:
        return [0.4, 0.0] if memory["step"] <= PROBING // 2 else [0.0, 0.4]
    (a, b), (c, d) = memory["J"]
    ex = observation["goal"][0] - observation["features"][0]
    ey = observation["goal"][1] - observation["features"][1]
    # The inverse of the Jacobian, damped so that rates stay small where it is singular.
    determinant = a * d - b * c
    scale = GAIN * determinant / (determinant * determinant + 1e4) / max_joint_rate
    return [scale * (d * ex - b * ey), scale * (a * ey - c * ex)]


def main():
    """Answer every observation with one line."""
    memory, max_joint_rate = None, 2.0
    for line in sys.stdin:
        message = json.loads(line)
        if message["message"] == "environment":
            max_joint_rate = message["max_joint_rate"]
        elif message["message"] == "end":
            return
        else:
            if message["message"] == "reset":
                memory = begin(message["observation"])
            print(json.dumps(act(memory, message["observation"], max_joint_rate)), flush=True)


if __name__ == "__main__":
    main()
