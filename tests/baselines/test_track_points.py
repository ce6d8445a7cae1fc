"""`servotrack track points.csv`: the reader's errors name the row, and the parameters are measured from the points."""

from __future__ import annotations

import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from servotrack.__main__ import app
from servotrack.baselines.reporting.trajectory_files import read_trajectories
from servotrack.envs.track.files.points import GeographicOrigin, PointScans, read_point_truth, read_points
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.envs.track.points.measured_model import measured_model
from servotrack.envs.track.points.point_model import clutter_intensity, track_points
from servotrack.envs.track.points.rounding import rounding_noise

GOOD = "time,x,y\n0,0,0\n0,5,5\n1,1,0\n2,,\n3,3,0\n"


def written(folder: Path, text: str, name: str = "points.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_rows_of_one_time_are_a_scan(tmp_path: Path) -> None:
    points = read_points(written(tmp_path, GOOD))
    assert points.times.tolist() == [0.0, 1.0, 2.0, 3.0] and [len(scan) for scan in points.scans] == [2, 1, 0, 1]
    assert points.covariances is None and points.identities is None and points.origin is None
    packed = tmp_path / "points.csv.gz"
    packed.write_bytes(gzip.compress(GOOD.encode()))
    assert [scan.tolist() for scan in read_points(packed).scans] == [scan.tolist() for scan in points.scans]


def test_a_row_that_is_stored_twice_is_one_point(tmp_path: Path) -> None:
    points = read_points(written(tmp_path, "time,x,y\n0,1,2\n0,3,4\n0,1.0,2\n1,1,2\n1,1,2\n"))
    assert [scan.tolist() for scan in points.scans] == [[[1.0, 2.0], [3.0, 4.0]], [[1.0, 2.0]]]
    assert points.repeated == 2
    # Two ships side by side have identities of their own.
    named = read_points(written(tmp_path, "time,id,x,y\n0,a,1,2\n0,b,1,2\n0,a,1,2\n1,a,1,2\n"))
    assert [len(scan) for scan in named.scans] == [2, 1] and named.repeated == 1
    assert named.identities == [["a", "b"], ["a"]]


def test_rows_are_sorted_by_time_whatever_their_order(tmp_path: Path) -> None:
    head, *rows = (
        "time,id,x,y,cov_xx,cov_xy,cov_yy\n2,c,5,6,3,0,3\n0,a,1,2,1,0,1\n1,,,,,,\n2,d,7,8,4,0,4\n0,b,3,4,2,0,2\n".splitlines()
    )
    given = read_points(written(tmp_path, "\n".join([head, *rows])))
    assert given.times.tolist() == [0.0, 1.0, 2.0] and given.identities == [["a", "b"], [], ["c", "d"]]
    assert [scan.tolist() for scan in given.scans] == [[[1.0, 2.0], [3.0, 4.0]], [], [[5.0, 6.0], [7.0, 8.0]]]
    assert given.covariances is not None
    assert [scan[:, 0, 0].tolist() for scan in given.covariances] == [[1.0, 2.0], [], [3.0, 4.0]]
    assert given.unsorted == 2
    tidy = read_points(written(tmp_path, "\n".join([head, *sorted(rows)])))
    assert tidy.unsorted == 0 and [len(scan) for scan in tidy.scans] == [2, 0, 2]


@pytest.mark.parametrize("mark", [";", "\t"])
def test_semicolons_and_tabs_separate_cells_and_decimals_have_commas(tmp_path: Path, mark: str) -> None:
    text = GOOD.replace(",", mark) + f"4{mark}-1,5{mark}2,25e1\n"
    points = read_points(written(tmp_path, text))
    assert points.scans[0].tolist() == [[0.0, 0.0], [5.0, 5.0]] and points.scans[4].tolist() == [[-1.5, 22.5]]


@pytest.mark.parametrize("name", ["timestamp", "DateTime", "BaseDateTime"])
def test_dates_have_columns_of_several_names(tmp_path: Path, name: str) -> None:
    points = read_points(written(tmp_path, f"{name},x,y\n2024-07-01 00:00:00,1,2\n2024-07-01T00:00:10Z,1,2\n"))
    assert points.dated and points.times[1] - points.times[0] == 10.0


def test_a_row_whose_cells_say_that_nothing_is_known_is_a_scan_without_detections(tmp_path: Path) -> None:
    points = read_points(written(tmp_path, "time,x,y\n0,1,2\n1,nan,NaN\n2,NA,null\n3,1,2\n"))
    assert [len(scan) for scan in points.scans] == [1, 0, 0, 1]


def test_three_axes_covariances_and_identities(tmp_path: Path) -> None:
    head = "id,Time,x,y,z,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz,quality"
    points = read_points(written(tmp_path, f"{head}\na,0,1,2,3,4,1,0,5,0,6,?\nb,1,1,2,3,4,1,0,5,0,6,?\n"))
    assert points.dimensions == 3 and points.identities == [["a"], ["b"]]
    assert points.covariances is not None
    assert points.covariances[0].tolist() == [[[4.0, 1.0, 0.0], [1.0, 5.0, 0.0], [0.0, 0.0, 6.0]]]


def test_dates_and_degrees(tmp_path: Path) -> None:
    text = "MMSI,BaseDateTime,LAT,LON\n1,2024-05-01T00:00:00,56,179.999\n1,2024-05-01T00:00:10Z,56.01,-179.999\n"
    points = read_points(written(tmp_path, text))
    assert points.dated and np.diff(points.times).tolist() == [10.0]
    assert points.origin == GeographicOrigin(56.0, 179.999)
    # Across the date line: 0.002 deg of longitude, 0.01 deg of latitude.
    np.testing.assert_allclose(points.scans[1], [[124.36, 1111.95]], rtol=1e-3)
    np.testing.assert_allclose(points.origin.to_map(points.scans[1]), [[-179.999, 56.01]], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("time,a,b\n0,1,2\n", "row 1 must name the columns time, x, y"),
        ("x,y\n0,1\n", "row 1 must name the columns time"),
        ("time,x,x,y\n0,1,2,3\n", "row 1 must name each column once"),
        ("time,x,y\n", "two times or more, got 0"),
        ("time,x,y\n0,1,2\n0,3,4\n", "two times or more, got 1"),
        ("time,x,y\n0,,\n1,,\n", "no row with a position"),
        ("time,x,y\n0,1,2\n1,nan,2\n", "row 3: x must be a finite number, got 'nan'"),
        ("time,x,y\n0,1,2\n1,,2\n", "row 3: x must be a finite number, got ''"),
        ("time,x,y\n0,1,2\n1,1_0,2\n", "row 3: x must be a finite number"),
        ("time,x,y\ninf,1,2\n1,1,2\n", "row 2: time must be finite"),
        ("time,x,y\nnoon,1,2\n1,1,2\n", "row 2: time must be seconds or a date"),
        ("time,x,y\n0,1,2\n2024-05-01,1,2\n", "row 3 must have a time of the kind of the first row"),
        ("time;x;y\n0;1,5;2\n1;1,5,2;2\n", "row 3: x must be a finite number, got '1,5,2'"),
        ("time,x,y\n0,1,2\n1,1\n", "row 3 must have 3 columns"),
        ("time,x,y,cov_xx\n0,1,2,1\n1,1,2,1\n", "all of cov_xx, cov_xy, cov_yy or none, got cov_xx"),
        ("time,x,y,cov_xx,cov_xy,cov_yy\n0,1,2,1,2,1\n1,1,2,1,0,1\n", "row 2 must have a positive definite"),
        ("time,x,y,cov_xx,cov_xy,cov_yy\n0,1,2,1e-9,0,1e9\n1,1,2,1,0,1\n", "row 2 .* not nearly singular"),
        ("time,lat,lon\n0,91,0\n1,1,1\n", "row 2 must have a latitude"),
        ("time,lat,lon\n0,89,0\n1,1,1\n", "row 2: latitude must be at most 85 in magnitude, got 89"),
        ("time,x,y\n0,1e10,2\n1,1,2\n", "row 2: x must be at most 1e.09 in magnitude, got '1e10'"),
        ("time,x,y\n1719827000123,1,2\n", "row 2: time must be at most 1e.10 s .*milliseconds divided by 1000"),
        ("time,x,y\n9999-12-31,1,2\n", "row 2: time must be at most 1e.10 s"),
        (
            "time,x,y\n" + "".join(f"0,1,{k}\n" for k in range(5001)) + "1,1,1\n",
            "row 5002 must have at most 5000 points of one time",
        ),
        ("time,x,y\n0,1,2\n" + "\n" * 1001, "more than 1000 blank rows"),
        ("time,x,y" + ",c" * 600_000 + "\n", "row 1 has more than 1048576 characters"),
        ('time,x,y\n0,1,"' + "2\n" * 101 + '"\n', "at most 100 lines; is a quotation mark missing"),
        ('time,x,y\n0,"1,2\n', "is no row of a CSV file"),
    ],
)
def test_bad_files_are_refused_with_their_row(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        read_points(written(tmp_path, text))


def test_a_damaged_gzip_file_and_binary_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "points.csv.gz"
    path.write_bytes(gzip.compress(GOOD.encode())[:-6])
    with pytest.raises(SequenceError, match="damaged gzip"):
        read_points(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SequenceError, match="UTF-8"):
        read_points(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,x,y\n0,1,2\n1,1,2\n", "must have a column of identities"),
        ("time,id,x,y,z\n0,a,1,2,3\n1,a,1,2,3\n", "must have the same coordinates"),
        ("time,id,x,y\n10,a,1,2\n11,a,1,2\n", "must overlap the points in time"),
        ("time,id,x,y\n0,a,1,2\n0,a,1,3\n1,a,1,1\n", "one row of target 'a' at time 0, got two"),
    ],
)
def test_a_bad_truth_is_refused(tmp_path: Path, text: str, message: str) -> None:
    points = read_points(written(tmp_path, GOOD))
    with pytest.raises(SequenceError, match=message):
        read_point_truth(written(tmp_path, text, "truth.csv"), points)


def scene(
    noise: float, detection: float, clutter: float, seed: int = 0, steps: int = 60
) -> tuple[PointScans, np.ndarray]:
    """Six targets of constant velocity in a square of 2 km, and their true tracks."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(-600, 600, (6, 2)), rng.normal(0, 8, (6, 2))
    times = np.cumsum(rng.choice([0.5, 1.0, 1.5], steps))
    truth = start[:, None] + velocity[:, None] * (times - times[0])[:, None]
    scans = []
    for k in range(steps):
        seen = truth[rng.random(6) < detection, k]
        seen = seen + rng.normal(0, noise, seen.shape)
        scans.append(np.concatenate([seen, rng.uniform(-1000, 1000, (rng.poisson(clutter), 2))]))
    return PointScans(times, scans, None, None, None, False), truth


@pytest.mark.parametrize(("noise", "detection", "clutter"), [(2.0, 0.95, 5.0), (10.0, 0.9, 3.0), (1.0, 0.7, 10.0)])
def test_parameters_are_measured(noise: float, detection: float, clutter: float) -> None:
    points, truth = scene(noise, detection, clutter)
    model, notes = measured_model(points)
    assert not notes
    assert model.measurement_noise == pytest.approx(noise, rel=0.2)
    assert model.detection == pytest.approx(detection, abs=0.06)
    assert model.clutter_rate == pytest.approx(clutter, rel=0.2)
    trajectories = track_points(points, model)
    assert len(trajectories) == 6
    last = np.array([one.states[-1, [0, 2]] for one in trajectories])
    assert all(np.linalg.norm(last - end, axis=1).min() < 5.0 * noise for end in truth[:, -1])


@pytest.mark.parametrize(("length", "time"), [(1e-9, 1e-6), (1.0, 1e-9), (1e5, 1e4), (2.0**-20, 2.0**10)])
def test_parameters_do_not_depend_on_units(length: float, time: float) -> None:
    points, _ = scene(2.0, 0.95, 3.0, steps=40)
    model, _ = measured_model(points)
    other = points._replace(times=points.times * time, scans=[scan * length + 3.0 * length for scan in points.scans])
    scaled, _ = measured_model(other)
    assert scaled.measurement_noise == pytest.approx(model.measurement_noise * length, rel=1e-6)  # type: ignore[operator]
    assert scaled.speed == pytest.approx(model.speed * length / time, rel=1e-6)
    assert scaled.process_noise == pytest.approx(model.process_noise * length / time**1.5, rel=1e-6)
    ours, theirs = track_points(points, model), track_points(other, scaled)
    assert len(ours) == len(theirs) == 6
    for one, two in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(two.times, other.times[np.isin(points.times, one.times)])
        np.testing.assert_allclose(two.states[:, ::2], one.states[:, ::2] * length + 3.0 * length, rtol=1e-4)


def plain(times: np.ndarray, places: np.ndarray) -> PointScans:
    return PointScans(times, [place[None] for place in places], None, None, None, False)


@pytest.mark.parametrize("place", [(0.0, 0.0), (5.0, 5.0), (1e9, -1e9)])
def test_points_at_one_place_are_a_track(place: tuple[float, float]) -> None:
    points = plain(np.arange(30.0), np.tile(place, (30, 1)))
    model, _ = measured_model(points)
    trajectories = track_points(points, model)
    assert len(trajectories) == 1 and np.isfinite(trajectories[0].covariances).all()
    np.testing.assert_allclose(trajectories[0].states[:, ::2], np.tile(place, (len(trajectories[0]), 1)), atol=1e-3)


def test_measuring_begins_at_the_first_point_and_far_points_are_noted() -> None:
    points, _ = scene(2.0, 0.95, 3.0, steps=40)
    before = np.arange(400.0) - 500.0
    late = points._replace(
        times=np.concatenate([before, points.times]), scans=[np.zeros((0, 2))] * len(before) + points.scans
    )
    assert len(track_points(late, measured_model(late)[0])) == 6
    far = points._replace(scans=[*points.scans[:-1], np.array([[1e7, 0.0]])])
    assert any("1 points are more than 30 times as far out" in note for note in measured_model(far)[1])


def any_points(seed: int) -> PointScans:
    """Points of any scale: at random, in lines, at few places, with outliers, gaps and covariances."""
    rng = np.random.default_rng(seed)
    scans, d = int(rng.integers(2, 25)), int(rng.integers(2, 4))
    steps = np.exp(rng.normal(0.0, rng.choice([0.0, 0.5, 4.0]), scans)) * 10.0 ** rng.uniform(-12, 6)
    times = np.cumsum(np.maximum(steps, 1e-14)) + rng.choice([0.0, 0.0, 1.7e9, -1e9])
    kinds = {
        "random": lambda n, k: rng.uniform(-1.0, 1.0, (n, d)),
        "line": lambda n, k: np.full((n, d), k / scans) + np.arange(n)[:, None],
        "places": lambda n, k: rng.integers(-1, 2, (n, d)).astype(np.float64),
        "one": lambda n, k: np.ones((n, d)),
        "wide": lambda n, k: rng.uniform(-1.0, 1.0, (n, d)) * 10.0 ** rng.uniform(-8.0, 0.0, (n, d)),
        "flat": lambda n, k: rng.uniform(-1.0, 1.0, (n, d)) * (np.arange(d) == 0),
    }
    draw = kinds[str(rng.choice(list(kinds)))]
    scale, most = 10.0 ** rng.uniform(-14, 8), int(rng.integers(1, 12))
    found = [scale * draw(int(rng.integers(0, most + 1)), k) for k in range(scans)]
    found[int(rng.integers(scans))] = scale * draw(1, 0) * rng.choice([1.0, 1.0, 10.0])
    covariances = None
    if rng.random() < 0.3:
        covariances = [
            np.array([np.diag(10.0 ** rng.uniform(-20, 10, 1) * 10.0 ** rng.uniform(-5, 5, d)) for _ in scan]).reshape(
                -1, d, d
            )
            for scan in found
        ]
    _, kept = np.unique(times, return_index=True)
    return PointScans(
        times[kept],
        [found[k] for k in kept],
        None if covariances is None else [covariances[k] for k in kept],
        None,
        None,
        False,
    )


def check_any_points(seed: int) -> bool:
    """Return True if the points were tracked, False if they were refused; anything else fails."""
    points = any_points(seed)
    if len(points.times) < 2 or not any(map(len, points.scans)):
        return False
    try:
        model, _ = measured_model(points)
        trajectories = track_points(points, model)
    except SequenceError:
        return False
    except Exception as error:
        raise AssertionError(f"points of seed {seed}") from error
    if model.clutter_map is not None:
        assert (model.clutter_map.density > 0.0).all() and np.isfinite(model.clutter_map.density).all(), seed
    for name, value in model._replace(clutter_map=None)._asdict().items():
        allowed = name in ("low", "high") or value is None or value > 0.0 or (name, value) == ("maneuver", 0.0)
        assert allowed and (value is None or np.isfinite(value).all()), (seed, name, value)
    for one in trajectories:
        assert np.isfinite(one.states).all() and np.isfinite(one.covariances).all(), seed
        assert (np.einsum("kii->ki", one.covariances) >= 0.0).all(), seed
        assert np.isin(one.times, points.times).all(), seed
    return True


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_any_points_are_tracked_or_refused() -> None:
    assert sum(map(check_any_points, range(30))) > 10


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_many_points_are_tracked_or_refused() -> None:
    count = int(os.environ.get("SERVOTRACK_FUZZED_POINTS", "3000"))
    print(f"{sum(map(check_any_points, range(count)))} of {count} tracked")


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, 1.0, 1.0 + 1e-9, 2.0, 3.0], "1e-06 of the usual step"),
        ([0.0, 1e-9, 2e-9, 3e-9, 1e9], "at most 1e.09 usual steps"),
        ([0.0, 1e-20, 2e-20, 3e-20, 4e-20], "must be at least 1e-15"),
    ],
)
def test_time_steps_that_rounding_would_decide_are_refused(times: list[float], message: str) -> None:
    points = plain(np.array(times), np.arange(2.0 * len(times)).reshape(-1, 2))
    with pytest.raises(SequenceError, match=message):
        measured_model(points)


def test_tiny_covariances_are_raised_to_what_rounding_allows() -> None:
    points, _ = scene(3.0, 0.95, 3.0, steps=30)
    given = points._replace(covariances=[np.tile(1e-30 * np.eye(2), (len(scan), 1, 1)) for scan in points.scans])
    for one in track_points(given, measured_model(given)[0]):
        assert np.isfinite(one.states).all() and np.isfinite(one.covariances).all()


def test_inputs_are_not_replaced_and_a_failed_run_leaves_the_earlier_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, _ = scene(2.0, 0.95, 3.0, steps=20)
    rows = [f"{t},{x},{y}" for t, scan in zip(points.times, points.scans, strict=True) for x, y in scan]
    source = written(tmp_path, "\n".join(["time,x,y", *rows]))
    out = tmp_path / "out"
    arguments = ["track", str(source), "--out", str(out)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    own = CliRunner().invoke(app, ["track", str(out / "tracks.csv"), "--out", str(out)])
    assert "would be replaced by this run's output" in str(own.exception)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    source.write_text("\n".join(["time,x,y", *rows[:-5]]))

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("servotrack.baselines.track_command.points_command.save_figure", fail)
    assert CliRunner().invoke(app, arguments).exit_code != 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_a_plane_that_is_too_large_is_noted(tmp_path: Path) -> None:
    rows = [f"{k},{40 + k / 2},{k / 4}" for k in range(40)]
    source = written(tmp_path, "\n".join(["time,lat,lon", *rows]))
    result = CliRunner().invoke(app, ["track", str(source), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0 and "distances to the east are off by up to 34 %" in " ".join(result.output.split())


def test_command_writes_tracks_map_figure_and_scores(tmp_path: Path) -> None:
    points, truth = scene(2.0, 0.95, 3.0, steps=40)
    rows = ["time,x,y", *(f"{t},{x},{y}" for t, scan in zip(points.times, points.scans, strict=True) for x, y in scan)]
    source = written(tmp_path, "\n".join(rows))
    lines = [
        f"{t},{i},{truth[i, k, 0]},{truth[i, k, 1]}" for k, t in enumerate(points.times) for i in range(len(truth))
    ]
    true = written(tmp_path, "\n".join(["time,id,x,y", *lines]), "truth.csv")
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["track", str(source), "--truth", str(true), "--out", str(out), "--format", "csv"])
    assert result.exit_code == 0, result.output
    assert "position noise" in result.output and "6 tracks" in result.output
    assert len(read_trajectories(out / "tracks.csv")) == 6
    assert len(json.loads((out / "tracks.geojson").read_text())["features"]) == 6
    scores = json.loads((out / "scores.json").read_text())["scores"]
    assert scores["ospa2"] < 5.0 and scores["count_error"] < 0.1
    assert (out / "tracks.png").exists()
    again = CliRunner().invoke(app, ["track", str(source), "--out", str(out)])
    assert again.exit_code == 0 and not (out / "scores.json").exists()
    refused = CliRunner().invoke(app, ["track", str(source), "--stride", "2"])
    assert refused.exit_code != 0
    assert "--stride" in str(refused.exception) or "--stride" in refused.output


def test_covariances_of_the_file_are_used() -> None:
    points, _ = scene(3.0, 0.95, 3.0)
    given = points._replace(covariances=[np.tile(9.0 * np.eye(2), (len(scan), 1, 1)) for scan in points.scans])
    model, _ = measured_model(given)
    assert model.measurement_noise is None
    assert len(track_points(given, model)) == 6


def test_scans_of_single_ships_are_tracked() -> None:
    # Every scan holds one message of one of four ships.
    rng = np.random.default_rng(1)
    start, velocity = rng.uniform(-4000, 4000, (4, 2)), rng.normal(0, 5, (4, 2))
    times = np.arange(240.0)
    scans = [start[k % 4] + velocity[k % 4] * t + rng.normal(0, 5, (1, 2)) for k, t in enumerate(times)]
    points = PointScans(times, scans, None, None, None, False)
    model, _ = measured_model(points)
    assert model.detection == pytest.approx(0.25, abs=0.05)
    assert len(track_points(points, model)) == 4


def moving(
    times: np.ndarray, noise: float, acceleration: float, clutter: float, *, seed: int, stops: bool = False
) -> PointScans:
    """Four targets whose velocity drifts, or that stop and go, among clutter in a square of 1 km."""
    rng = np.random.default_rng(seed)
    steps = np.diff(times, prepend=times[0])[:, None, None]
    drift = acceleration * np.sqrt(steps) * rng.standard_normal((len(times), 4, 2))
    velocity = rng.normal(0.0, 6.0, (4, 2)) + np.cumsum(drift, axis=0)
    if stops:
        velocity = velocity * (np.arange(len(times)) // 15 % 2 == 0)[:, None, None]
    truth = rng.uniform(-400.0, 400.0, (4, 2)) + np.cumsum(velocity * steps, axis=0)
    scans = []
    for where in truth:
        seen = where[rng.random(4) < 0.9]
        false = rng.uniform(-500.0, 500.0, (rng.poisson(clutter), 2))
        scans.append(np.concatenate([seen + rng.normal(0.0, noise, seen.shape), false]))
    return PointScans(times, scans, None, None, None, False)


def test_two_sensors_that_follow_each_other_closely_are_one_clock() -> None:
    times = np.sort(np.concatenate([np.arange(40.0), np.arange(40.0) + 0.002]))
    points = moving(times, 2.0, 0.1, 1.0, seed=1)
    model, notes = measured_model(points)
    assert not notes and model.period == pytest.approx(0.998)
    assert model.measurement_noise == pytest.approx(2.0, rel=0.2) and model.survival > 0.98
    assert len(track_points(points, model)) == 4


def test_targets_that_stop_and_go_keep_their_identities() -> None:
    points = moving(np.arange(90.0), 1.0, 0.05, 1.0, seed=3, stops=True)
    model, _ = measured_model(points)
    assert model.maneuver > 0.0 and model.agility > 5.0
    without = track_points(points, model._replace(maneuver=0.0))
    assert len(track_points(points, model)) < 6 < len(without)


def test_clutter_from_one_place_is_not_a_crowd() -> None:
    points = moving(np.arange(60.0), 2.0, 0.1, 0.5, seed=4)
    rng = np.random.default_rng(4)
    spot = [np.array([300.0, 300.0]) + 30.0 * rng.standard_normal((rng.poisson(6), 2)) for _ in points.scans]
    points = points._replace(scans=[np.concatenate(pair) for pair in zip(points.scans, spot, strict=True)])
    model, _ = measured_model(points)
    assert model.clutter_map is not None and model.clutter_map(np.array([[300.0, 300.0]]))[0] > 20.0
    assert model.clutter_rate == pytest.approx(6.5, rel=0.2)
    assert len(track_points(points, model)) < 7
    intensity = clutter_intensity(model)
    assert not isinstance(intensity, float)
    # The mean over the region is that of uniform clutter.
    axes = [
        np.linspace(low, high, 161)[:-1] + (high - low) / 320 for low, high in zip(*model.clutter_map[:2], strict=True)
    ]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    area = float(np.prod(model.high - model.low))
    assert float(intensity(places).mean()) * area == pytest.approx(model.clutter_rate)
    uniform, _ = measured_model(scene(2.0, 0.95, 3.0)[0])
    assert uniform.clutter_map is None


def test_targets_that_come_late_are_measured_where_they_are() -> None:
    rng = np.random.default_rng(5)
    late = moving(np.arange(60.0), 2.0, 0.1, 0.5, seed=5)
    before = [rng.uniform(-500.0, 500.0, (rng.poisson(0.5), 2)) for _ in range(330)]
    points = late._replace(times=np.arange(390.0), scans=before + list(late.scans))
    model, notes = measured_model(points)
    assert not notes and model.measurement_noise == pytest.approx(2.0, rel=0.25)
    assert len(track_points(points, model)) == 4


@pytest.mark.parametrize("step", [5.0, 1e-4])
def test_rounded_coordinates_are_no_exact_ones(tmp_path: Path, step: float) -> None:
    # Slow targets whose rounded coordinates repeat, in meters and in degrees.
    rng = np.random.default_rng(42)
    scale = 1.0 if step > 1.0 else 1.0 / 111_195.0
    start, velocity = rng.uniform(-400.0, 400.0, (4, 2)), rng.normal(0.0, 1.5, (4, 2))
    rows = ["time,x,y" if step > 1.0 else "time,lat,lon"]
    for k in range(60):
        places = np.round((start + velocity * k + rng.normal(0.0, 0.5, (4, 2))) * scale / step) * step
        rows += [f"{k},{x:.4f},{y:.4f}" for x, y in places[rng.random(4) < 0.9]]
    points = read_points(written(tmp_path, "\n".join(rows)))
    model, notes = measured_model(points)
    side = step / scale
    assert not notes and model.measurement_noise is not None
    assert 0.9 * side / np.sqrt(12.0) < model.measurement_noise < 0.6 * side
    assert len(track_points(points, model)) == 4


def test_rounding_shows_in_differences_only() -> None:
    rng = np.random.default_rng(1)
    smooth = np.cumsum(rng.normal(0.0, 3.0, (200, 3, 2)), axis=1)
    assert rounding_noise(smooth) == rounding_noise(smooth[:0]) == 0.0
    assert rounding_noise(np.round(smooth)) == pytest.approx(1.0 / np.sqrt(12.0))
    assert rounding_noise(np.round(smooth / [0.5, 2.0]) * [0.5, 2.0]) == pytest.approx(np.sqrt(4.25 / 24.0))
    # Targets that rest on a grid, or move at whole speeds, are not rounded.
    grid = rng.integers(0, 9, (200, 1, 2)) * 100.0
    assert rounding_noise(np.repeat(grid, 3, axis=1)) == 0.0
    assert rounding_noise(grid + np.arange(3.0)[:, None] * rng.integers(1, 5, (200, 1, 2))) == 0.0


def test_position_noise_that_the_motion_hides_is_noted() -> None:
    # Animals with a fix per hour: what they move between two is far more than a fix is wrong.
    rng, hour = np.random.default_rng(6), 3600.0
    motion = np.linalg.cholesky([[hour**3 / 3.0, hour**2 / 2.0], [hour**2 / 2.0, hour]])
    moved = 0.002 * np.einsum("ij,...j->...i", motion, rng.standard_normal((80, 3, 2, 2)))
    velocity = np.cumsum(moved[..., 1], axis=0)
    places = np.cumsum(moved[1:, ..., 0] + hour * velocity[:-1], axis=0) + 30e3 * np.arange(3)[:, None]
    scans = list(places + rng.normal(0.0, 15.0, places.shape))
    points = PointScans(hour * np.arange(79.0), scans, None, None, None, False)
    assert any("tell position noise from process noise poorly" in note for note in measured_model(points)[1])


def test_sensors_that_share_a_time_are_noted(tmp_path: Path) -> None:
    rows = [f"{k},{name},{k + offset},0" for k in range(6) for name, offset in (("a", 0.0), ("b", 0.1))]
    source = written(tmp_path, "\n".join(["time,sensor,x,y", *rows, "6,a,6,0"]))
    assert read_points(source).shared == 6
    result = CliRunner().invoke(app, ["track", str(source), "--out", str(tmp_path / "out")])
    assert "6 times have points of several sensors" in " ".join(result.output.split())
