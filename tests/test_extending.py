"""Extending the package edits few existing files: done here on a copy, and run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROOMS = ("package", "envs", "estimators", "baselines")


def extend(folder: Path, new: Mapping[str, str], edits: Mapping[str, tuple[str, str]], script: str) -> str:
    """Copy the rooms, add new files, edit existing ones, and run a script in the copy; returns what it printed.

    Args:
        folder: Empty folder.
        new: Text of new files by their paths.
        edits: Text to replace, and its replacement, by the paths of existing files.
        script: Python code.
    """
    # With the caches of compiled kernels, which are valid in a copy that keeps the files' times.
    tree = folder / "servotrack"
    shutil.copytree(ROOT / "package", tree)
    for room in ROOMS[1:]:
        shutil.copytree(ROOT / room, tree / room)
    for name, text in new.items():
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        (tree / name).write_text(text, encoding="utf-8")
    for name, (old, replacement) in edits.items():
        text = (tree / name).read_text(encoding="utf-8")
        assert text.count(old) == 1, f"{name} must hold {old!r} once"
        (tree / name).write_text(text.replace(old, replacement), encoding="utf-8")
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(folder)},
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return run.stdout


WORLD = '''"""A point on a line."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np


class LineEnv(gym.Env):
    """Reach the middle of a line."""

    metadata: ClassVar[dict[str, Any]] = {"servotrack_kind": "line", "render_modes": []}

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1.0, 1.0, 1).astype(np.float32), 0
        return self.place.copy(), {}

    def step(self, action):
        self.place = np.clip(self.place + 0.1 * np.asarray(action, np.float32), -1.0, 1.0)
        self.steps += 1
        gap = abs(float(self.place[0]))
        return self.place.copy(), -gap, False, self.steps == 20, {"gap": gap}
'''
LINE_SCORES = '''"""Scores of line episodes."""

import numpy as np


class LineScoreRecorder:
    """Collects the gap."""

    def __init__(self, rows, observation, max_steps):
        self.gaps = []

    def record(self, observation, info, ending):
        self.gaps.append(np.array(info["gap"]))

    def columns(self, row, length):
        return {"gap": float(np.mean([step[row] for step in self.gaps[:length]]))}
'''
LINE_CARDS = '''"""Cards of the line agents."""

from servotrack.baselines.agents.protocol import AgentCard

CARDS = (
    AgentCard(
        "steady",
        "servotrack.baselines.agents.line.steady:Steady",
        "calibrated",
        "moves to the middle",
        worlds=frozenset({"line"}),
    ),
)
'''
LINE_AGENT = '''"""An agent of the line."""

import numpy as np


class Steady:
    """Moves against the place."""

    def __init__(self, env):
        pass

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.clip(-10.0 * observation, -1.0, 1.0).astype(np.float32), state
'''


def test_a_new_kind_of_world_edits_two_modules(tmp_path: Path) -> None:
    # Besides: pyproject (packages), mkdocs.yml, README and CHANGELOG make six existing files.
    output = extend(
        tmp_path,
        {
            "envs/line/__init__.py": '"""A point on a line."""\n',
            "envs/line/env.py": WORLD,
            "baselines/evaluation/line_scores.py": LINE_SCORES,
            "baselines/agents/line/__init__.py": '"""Agents of the line."""\n',
            "baselines/agents/line/cards.py": LINE_CARDS,
            "baselines/agents/line/steady.py": LINE_AGENT,
        },
        {
            "envs/registration.py": (
                'ENVIRONMENTS: dict[str, dict[str, Any]] = {\n',
                'ENVIRONMENTS: dict[str, dict[str, Any]] = {\n    "Line-v0": {"entry_point": '
                '"servotrack.envs.line.env:LineEnv", "max_episode_steps": 20},\n',
            ),
            "baselines/worlds.py": (
                '        World(\n            OTHER,',
                '        World(\n            "line",\n            "a point on a line",\n            ("Line-v0",),\n'
                '            RankingMetric("gap", "gap"),\n            "steady",\n'
                '            f"{_RECORDERS}.line_scores:LineScoreRecorder",\n'
                '            f"{_AGENTS}.line.cards:CARDS",\n        ),\n        World(\n            OTHER,',
            ),
        },
        "import servotrack, sys\n"
        "from servotrack.__main__ import main\n"
        "sys.argv = ['servotrack', 'bench', '--env', 'Line-v0', '-n', '20', '-j', '1', '--format', 'csv']\n"
        "main()\n",
    )  # fmt: skip
    rows = output.splitlines()
    assert rows[0] == "table,agent,information,n,return,gap,− steady,µs/step,tuning steps"
    assert [row.split(",")[1] for row in rows[1:]] == ["steady", "random"]


def test_a_new_estimator_edits_three_modules(tmp_path: Path) -> None:
    # Besides: CHANGELOG makes four existing files.
    output = extend(
        tmp_path,
        {
            "estimators/jacobian/slow.py": (
                '"""A Kalman filter for Jacobians that hardly change."""\n\n'
                "from servotrack.estimators.jacobian.kf import KalmanJacobian\n\n\n"
                "class SlowJacobian(KalmanJacobian):\n"
                '    """The same filter under another name."""\n'
            )
        },
        {
            "estimators/jacobian/__init__.py": (
                "from servotrack.estimators.jacobian.kf import KalmanJacobian\n",
                "from servotrack.estimators.jacobian.kf import KalmanJacobian\n"
                "from servotrack.estimators.jacobian.slow import SlowJacobian\n",
            ),
            "baselines/agents/servo/catalog.py": (
                '    "kf": KalmanJacobian,\n',
                '    "kf": KalmanJacobian,\n    "slow-kf": '
                '__import__("servotrack.estimators.jacobian", fromlist=["x"]).SlowJacobian,\n',
            ),
            "baselines/agents/servo/cards.py": (
                '    _servo("kf",',
                '    _servo("slow-kf", "model-free", "for slow Jacobians"),\n    _servo("kf",',
            ),
        },
        "import servotrack\n"
        "from servotrack.baselines import evaluate\n"
        "rows = [evaluate('UncalibServo-v0', name, [200_000], {'level': 2}).rows for name in ('kf', 'slow-kf')]\n"
        "assert rows[0] == rows[1]\n"
        "from servotrack.baselines.evaluation.bench import default_agents\n"
        "print('slow-kf' in default_agents())\n",
    )
    assert output == "True\n"


def test_a_new_metric_edits_two_modules(tmp_path: Path) -> None:
    output = extend(
        tmp_path,
        {},
        {
            "baselines/evaluation/set_scores.py": (
                '        found["count_error"]',
                '        found["worst_ospa"] = float(np.max(steps["ospa"]))\n        found["count_error"]',
            ),
            "baselines/worlds.py": (
                '            (RankingMetric("ospa", "OSPA", "m"),),\n',
                '            (RankingMetric("ospa", "OSPA", "m"), RankingMetric("worst_ospa", "worst OSPA", "m")),\n',
            ),
        },
        "import servotrack, sys\n"
        "from servotrack.__main__ import main\n"
        "sys.argv = 'servotrack evaluate ClutterTracking-v0 gnn --set horizon=8 -n 2 --format csv'.split()\n"
        "main()\n",
    )
    heading, row = output.splitlines()
    assert "OSPA m,worst OSPA m,OSPA(2) m" in heading
    assert row.count("[") == 4


def test_a_new_paper_edits_one_module(tmp_path: Path) -> None:
    # Besides: claims.yaml and pyproject (packages) make three existing files.
    output = extend(
        tmp_path,
        {
            "baselines/papers/kalman_sixty/__init__.py": '"""Kalman 1960."""\n',
            "baselines/papers/kalman_sixty/report.py": (
                '"""Reproduction of one claim."""\n\n\n'
                "def reproduce(request):\n"
                '    """Say how many runs were asked for."""\n'
                '    print("runs", request.runs)\n'
            ),
        },
        {
            "baselines/papers/reproduce.py": (
                '        Paper(\n            "transfer",',
                '        Paper("kalman_sixty", "Kalman 1960", "", f"{_ROOM}.kalman_sixty.report:reproduce", 3),\n'
                '        Paper(\n            "transfer",',
            ),
        },
        "import servotrack, sys\n"
        "from servotrack.__main__ import main\n"
        "sys.argv = ['servotrack', 'reproduce', 'kalman-sixty']\n"
        "main()\n",
    )  # fmt: skip
    assert output == "runs 3\n"
