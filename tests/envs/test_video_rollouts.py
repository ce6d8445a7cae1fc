"""Short stored rollouts of the video environment, which detect unintended changes of behavior.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_video_rollouts.py`
stores them anew. The sequence is a MOTChallenge folder of PNG files, which every decoder reads alike.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
from stored_rollouts import assert_as_stored, digests, digests_elsewhere, print_or_store

import servotrack  # noqa: F401

STORED = Path(__file__).with_name("video_rollouts.npz")
ENV_ID = "VideoTracking-v0"
CASES: dict[str, dict[str, Any]] = {
    "frames": {"start": 1, "stride": 2, "max_estimates": 8},
    "detections": {"observation": "detections", "width": 48, "least_confidence": 0.3, "max_estimates": 8},
}
FRAMES, WIDTH, HEIGHT = 12, 96, 72
WALKERS = ((3, 4, 20, 5, (200, 60, 30)), (8, 70, 30, -4, (30, 40, 220)), (15, 40, 10, 1, (90, 230, 90)))
"""Identity, left, top, speed (px per frame) and color of each box."""


def write_sequence(folder: Path) -> None:
    """Write a sequence of three boxes that move over a shaded floor; the third occludes the second for a while."""
    for name in ("img1", "gt", "det"):
        (folder / name).mkdir()
    truth, detections = [], []
    for k in range(FRAMES):
        rows, columns = np.mgrid[:HEIGHT, :WIDTH]
        frame = np.stack([rows + columns, 2 * rows, 120 + columns], axis=-1).astype(np.uint8)
        for identity, left, top, speed, color in WALKERS:
            x = left + speed * k
            cv2.rectangle(frame, (x, top), (x + 11, top + 29), color, -1)
            visible = 0.1 if identity == 8 and 5 <= k < 8 else 1.0
            truth.append(f"{k + 1},{identity},{x},{top},12,30,1,1,{visible}\n")
            if (k + identity) % 5:
                detections.append(f"{k + 1},-1,{x - 1},{top + 2},13,27,{0.2 + 0.15 * ((k + identity) % 6):.2f}\n")
        cv2.imwrite(str(folder / "img1" / f"{k + 1:06}.png"), frame)
    (folder / "gt" / "gt.txt").write_text("".join(truth))
    (folder / "det" / "det.txt").write_text("".join(detections))
    (folder / "seqinfo.ini").write_text(
        f"[Sequence]\nname=Walk\nimDir=img1\nframeRate=12\nseqLength={FRAMES}\nimWidth={WIDTH}\nimHeight={HEIGHT}\n"
    )


def rollout(case: str) -> dict[str, Any]:
    """Return the whole rollout, one array for each quantity. Answers are slightly shifted true boxes."""
    with tempfile.TemporaryDirectory() as name:
        write_sequence(Path(name))
        env = gym.make(ENV_ID, source=name, **CASES[case])
        seen, info = env.reset(seed=3)
        rows, over = [], False
        while not over:
            truth, answer = info["truth"], np.zeros(env.action_space.shape)
            present = np.flatnonzero(truth["ids"] > 0)
            answer[truth["ids"][present], 0] = 1.0
            answer[truth["ids"][present], 1:] = truth["boxes"][present] + [2.0, -1.0, 1.0, 0.5]
            shown = seen
            seen, reward, _, over, info = env.step(answer)
            rows.append(
                {"seen": shown, "reward": reward, **truth, "ospa": info["ospa"], "missed": info["missed_error"]}
            )
        env.close()
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return arrays | {name: np.array(info[name]) for name in ("ospa2", "mota", "idf1", "hota")}


@pytest.mark.parametrize("case", CASES)
def test_the_stored_rollout_comes_out_again(case: str) -> None:
    assert_as_stored(STORED, case, rollout(case), tolerance=1e-9)


def test_another_process_gets_the_same_bits() -> None:
    assert digests_elsewhere(__file__) == digests(rollout, CASES)


if __name__ == "__main__":
    print_or_store(STORED, rollout, CASES)
