"""The example of docs/color.md runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from servotrack.baselines.agents.color.catalog import COLOR_TRACKERS

PAGE = Path(__file__).parents[2] / "docs" / "color.md"


def test_the_example_follows_what_moves(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    ground = cv2.resize(rng.integers(60, 120, (12, 16, 3), np.uint8), (160, 120), interpolation=cv2.INTER_CUBIC)
    for k in range(40):
        image = ground.copy()
        if k > 12:
            left = 10 + 3 * (k - 13)
            image[40:72, left : left + 12], image[40:72, left + 12 : left + 24] = (30, 30, 220), (220, 200, 40)
        assert cv2.imwrite(str(tmp_path / f"{k:03}.png"), image)
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0]
    scope: dict[str, Any] = {}
    exec(code, scope)
    boxes = list(scope["follow"](tmp_path))
    assert 20 <= len(boxes) <= 25
    assert boxes[-1] == pytest.approx([10 + 3 * 26, 40, 24, 32], abs=5.0)


def test_every_tracker_is_on_the_page() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert [name for name in COLOR_TRACKERS if f"`{name}`" not in text] == []
