"""The table of axes that no level has."""

from __future__ import annotations

from pathlib import Path

import pytest

from servotrack.baselines.leaderboard import ladder_axes
from servotrack.baselines.leaderboard.ladder import main
from servotrack.envs.servo.levels import servo_config


def test_every_shown_axis_changes_the_world() -> None:
    plain = servo_config(ladder_axes.LEVEL)
    for name, axes in ladder_axes.AXES_SHOWN.items():
        assert (servo_config(ladder_axes.LEVEL, **axes) == plain) == (name == "none")


def test_the_table_is_written_into_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ladder_axes, "AGENTS_SHOWN", ("kf",))
    monkeypatch.setattr(ladder_axes, "AXES_SHOWN", {name: ladder_axes.AXES_SHOWN[name] for name in ("none", "zoom")})
    page = tmp_path / "page.md"
    page.write_text("<!-- servo-axes:begin -->\n<!-- servo-axes:end -->\n", encoding="utf-8")
    main(["--axes", "--episodes", "2", "--write", str(page)])
    rows = [line.split("|") for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    assert [row[1].strip() for row in rows[2:]] == ["none", "zoom"]
    assert rows[2][4] != rows[3][4]
