"""Files of trajectories: CSV keeps every bit and refuses damage, GeoJSON and figure show what they should."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from servotrack.baselines.reporting.figure import save_figure
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.reporting.trajectory_figure import draw_trajectories
from servotrack.baselines.reporting.trajectory_files import read_trajectories, write_geojson, write_trajectories
from servotrack.estimators.rfs import Trajectory


def trajectory(label: int, scans: int, n: int = 4) -> Trajectory:
    rng = np.random.default_rng(label)
    roots = rng.normal(size=(scans, n, n))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    covariances = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    times = np.cumsum(rng.uniform(0.1, 2.0, scans))
    return Trajectory(label, times, 1e3 * rng.normal(size=(scans, n)), covariances, rng.random(scans))


@pytest.mark.parametrize("names", [("x", "vx", "y", "vy"), ("x", "vx", "y", "vy", "z", "vz")])
def test_csv_keeps_every_bit(tmp_path: Path, names: tuple[str, ...]) -> None:
    given = [trajectory(label, scans, len(names)) for label, scans in ((3, 5), (1, 1), (7, 12))]
    write_trajectories(tmp_path / "tracks.csv", given, names)
    for a, b in zip(given, read_trajectories(tmp_path / "tracks.csv"), strict=True):
        assert a.label == b.label
        for name in ("times", "states", "covariances", "existence"):
            assert np.array_equal(getattr(a, name), getattr(b, name))
    write_trajectories(tmp_path / "none.csv", [], names)
    assert read_trajectories(tmp_path / "none.csv") == []


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: "", "must begin with the columns label"),
        (lambda text: text.replace("existence", "presence"), "must begin with the columns label"),
        (lambda text: text.replace("\n3,", "\nthree,", 1), "row 2 must hold numbers"),
        (lambda text: text[:-20] + "\n", "finite numbers|must hold"),
        (lambda text: text + text.splitlines()[1] + "\n", "times must increase"),
        (lambda text: text.replace(text.splitlines()[1].split(",")[2], "nan", 1), "row 2 must hold 17 finite numbers"),
        (
            lambda text: text.replace(text.splitlines()[1].split(",")[2], "1.5", 1),
            r"row 2 must have an existence in \[0, 1\]",
        ),
        (lambda text: text.replace(text.splitlines()[1].split(",")[7], "-4.0", 1), "row 2 must have variances"),
        (lambda text: text + '4,"', "is no row of a table"),
        (lambda text: "label,time,existence" + ",x" * 101 + ",cov" * 5151 + "\n", "a state of up to 100 entries"),
    ],
)
def test_a_damaged_csv_is_refused(tmp_path: Path, damage: object, message: str) -> None:
    path = tmp_path / "tracks.csv"
    write_trajectories(path, [trajectory(3, 4)])
    path.write_text(damage(path.read_text()))  # type: ignore[operator]
    with pytest.raises(ResultsError, match=message):
        read_trajectories(path)


def test_names_must_fit(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="names must be of the 6 entries"):
        write_trajectories(tmp_path / "tracks.csv", [trajectory(1, 2, 6)])
    assert not list(tmp_path.iterdir())


def test_geojson_has_lines_points_times_and_the_caller_s_coordinates(tmp_path: Path) -> None:
    given = [trajectory(1, 4), trajectory(2, 1)]
    write_geojson(tmp_path / "t.json", given, transform=lambda p: p / 1e5, stamp=lambda t: f"t={t:.0f}")
    line, point = json.loads((tmp_path / "t.json").read_text())["features"]
    assert (line["geometry"]["type"], point["geometry"]["type"]) == ("LineString", "Point")
    np.testing.assert_allclose(line["geometry"]["coordinates"], given[0].states[:, [0, 2]] / 1e5)
    assert line["properties"]["times"] == [f"t={t:.0f}" for t in given[0].times]
    assert len(line["properties"]["deviation"]) == 4 and line["properties"]["label"] == 1
    with pytest.raises(ValueError, match="transform must return finite values"):
        write_geojson(tmp_path / "t.json", given, transform=lambda p: p[:, :1])
    assert json.loads((tmp_path / "t.json").read_text())["features"]


def test_the_figure_is_written(tmp_path: Path) -> None:
    figure = draw_trajectories([trajectory(1, 20), trajectory(2, 1)], measurements=np.zeros((3, 2)))
    save_figure(figure, tmp_path / "t.png")
    assert (tmp_path / "t.png").stat().st_size > 10_000
