"""The board's page: data that scripts deliver, replays, the arm in JavaScript. `scripts/check-board` looks at it."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hostile_board import NAMES, hostile_entries
from recorded_arms import STEPS, recorded_arms
from typer.testing import CliRunner

from servotrack.__main__ import app
from servotrack.baselines.board.submission import read_submission
from servotrack.baselines.board.verification import CellVerdict, Verdict
from servotrack.baselines.board.verify import write_verdicts
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.leaderboard.site import replays
from servotrack.baselines.leaderboard.site.entries import Entry, entries_of, rerun_actions
from servotrack.baselines.leaderboard.site.packing import ANGLE_STEP, Packer
from servotrack.baselines.leaderboard.site.set_replays import Clutter
from servotrack.baselines.leaderboard.site.write import LARGEST_SITE, SCRIPTS, write_site
from servotrack.baselines.reporting.files import ResultsError

ASSETS = Path(str(resources.files("servotrack.baselines.leaderboard.site").joinpath("assets")))
SUBMISSION = Path(__file__).parents[2] / "leaderboard" / "2027a" / "kf"
SEEDS = [200_000, 200_001, 200_002]
AGENTS = ("random", "oracle", "lifted-kf", "ppo")
_NODE = shutil.which("node")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board") / "results"
    for agent in AGENTS:
        evaluate("UncalibServo-v0", agent, SEEDS, {"level": 3}, folder=ResultsFolder(folder), timing=False)
    return folder


@pytest.fixture(scope="module")
def site(results: Path) -> Path:
    folder = results.parent / "site"
    paths = write_site(entries_of(results), folder, "servotrack leaderboard results --site site")
    assert paths[0] == folder / "index.html"
    return folder


def delivered(path: Path) -> dict[str, Any]:
    """The document that a script hands to the page."""
    text = path.read_text(encoding="ascii")
    found = re.fullmatch(r"servotrack\.deliver\('([a-z0-9-]+)','([A-Za-z0-9+/=]*)'\);\n", text)
    assert found is not None and found[1] == path.stem
    return json.loads(zlib.decompress(base64.b64decode(found[2])))


def unpacked(document: dict[str, Any]) -> list[np.ndarray]:
    """Curves of a document, decoded as the page does it."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(document["samples"])), np.uint8).astype(np.int64)
    words = planes[: len(planes) // 2] | (planes[len(planes) // 2 :] << 8)
    bends = (words >> 1) ^ -(words & 1)
    curves, at = [], 0
    for first, length, step, order in document["curves"]:
        values = bends[at : at + length]
        for _ in range(order):
            values = np.cumsum(values)
        curves.append((first + values) * step)
        at += length
    return curves


@pytest.mark.skipif(_NODE is None, reason="needs node")
def test_the_arm_in_javascript_moves_as_the_reference_engine(tmp_path: Path) -> None:
    (tmp_path / "arms.json").write_text(json.dumps(recorded_arms()), encoding="ascii")
    code = (
        "const fs = require('fs');"
        "require('vm').runInThisContext(fs.readFileSync(process.argv[1], 'utf8'));"
        "const cases = JSON.parse(fs.readFileSync(process.argv[2], 'utf8'));"
        "console.log(JSON.stringify(servotrack.arm.compare(cases)));"
    )
    command = [str(_NODE), "-e", code, str(ASSETS / "arm.js"), str(tmp_path / "arms.json")]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)
    assert len(found) >= 7
    for case in found:
        assert case["steps"] == STEPS
        assert max(case["joints"], case["tool"], case["error"]) < 1e-9, case


def test_curves_come_back_rounded() -> None:
    rng = np.random.default_rng(0)
    curves = [np.cumsum(rng.normal(0.0, 0.02, 50)), np.array([-1.5]), np.full(7, 2.0)]
    packer = Packer()
    for number, curve in enumerate(curves):
        assert packer.add(curve, ANGLE_STEP) == number
    for curve, again in zip(curves, unpacked({"curves": packer.curves, "samples": packer.text()}), strict=True):
        np.testing.assert_allclose(again, curve, atol=0.5 * ANGLE_STEP + 1e-12)


@pytest.mark.parametrize("values", [[0.0, np.nan], [0.0, 50.0, 0.0], [1e300]])
def test_curves_that_do_not_fit_are_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="values must"):
        Packer().add(values, ANGLE_STEP)


def test_the_site_is_whole_and_small(site: Path) -> None:
    page = (site / "index.html").read_text(encoding="utf-8")
    named = re.findall(r'(?:src|href)="([^"#:]+)"', page)
    assert set(SCRIPTS) | {"board.css", "data/board.js"} == set(named)
    board = delivered(site / "data" / "board.js")
    tasks = [task for suite in board["suites"] for world in suite["worlds"] for task in world["tasks"]]
    assert [task["name"] for task in tasks] == ["UncalibServo-v0,level=3"]
    for name in (*named, "data/race.js", *(f"data/{task['chunk']}.js" for task in tasks)):
        assert (site / name).is_file(), name
    assert sum(path.stat().st_size for path in site.rglob("*") if path.is_file()) < LARGEST_SITE
    assert not re.search(r"https?://(?!www\.w3\.org)", "".join((site / name).read_text("utf-8") for name in SCRIPTS))


def test_rows_have_scores_intervals_and_proof(site: Path) -> None:
    rows = {
        row["agent"]: row for row in delivered(site / "data" / "board.js")["suites"][0]["worlds"][0]["tasks"][0]["rows"]
    }
    assert set(rows) == set(AGENTS)
    assert rows["random"]["score"][0] == pytest.approx(0.0, abs=1e-9)
    assert rows["oracle"]["score"][0] > 0.8
    assert rows["oracle"]["privileged"] and rows["lifted-kf"]["information"] == "structure"
    assert {row["proof"] for row in rows.values()} == {"self-reported"}
    low, high = rows["lifted-kf"]["score"][1:]
    assert low <= rows["lifted-kf"]["score"][0] <= high


def test_replays_show_the_episodes_of_the_rows(site: Path, results: Path) -> None:
    document = delivered(site / "data" / "task-0.js")
    curves = unpacked(document)
    rows = {entry.cell.agent: {row["seed"]: row for row in entry.cell.rows} for entry in entries_of(results)}
    seen: dict[str, set[str]] = {name: set() for name in AGENTS}
    for replay in document["replays"]:
        row, scene = rows[replay["agent"]][replay["seed"]], document["scenes"][str(replay["seed"])]
        seen[replay["agent"]] |= set(replay["labels"])
        (l1, l2), (first, second) = scene["links"], (curves[number] for number in replay["joints"])
        x, y = (curves[number][: len(first)] for number in scene["path"])
        tool = l1 * np.exp(1j * first) + l2 * np.exp(1j * (first + second))
        error = np.abs(tool - (x + 1j * y))
        assert len(error) == row["length"] + 1
        if row["length"] == len(curves[scene["path"][0]]) - 1:
            assert error[61:].mean() == pytest.approx(row["steady"], abs=1e-4)
    # The random agent's actions depend on the episodes beside it.
    seen.pop("random")
    assert all(labels == {"best", "median", "worst"} for labels in seen.values())


def _runs(packed: list[Any], curves: list[np.ndarray]) -> dict[tuple[int, int], np.ndarray]:
    """Points of packed tracks by number of the track and scan."""
    listed, numbers = packed
    points = np.stack([curves[number] for number in numbers], axis=1)
    places = [(number, first + k) for number, first, length in listed for k in range(length)]
    return dict(zip(places, points, strict=True))


@pytest.mark.parametrize("level", [1, 4])
def test_replays_of_sets_show_targets_measurements_and_answers(level: int, tmp_path: Path) -> None:
    kwargs = {"level": level, "horizon": 12}
    for agent in ("association-oracle", "raw-measurements"):
        evaluate("ClutterTracking-v0", agent, SEEDS[:1], kwargs, folder=ResultsFolder(tmp_path / "r"), timing=False)
    write_site(entries_of(tmp_path / "r"), tmp_path / "site", "test")
    document = delivered(tmp_path / "site" / "data" / "task-0.js")
    curves, scene = unpacked(document), document["scenes"][str(SEEDS[0])]
    env = gym.make("ClutterTracking-v0", **kwargs)
    _, info = env.reset(seed=SEEDS[0])
    truth, rounding = _runs(scene["truth"], curves), (scene["window"][2] - scene["window"][0]) / 512
    for scan in range(kwargs["horizon"]):
        states = info["truth"]["states"][info["truth"]["exists"]][:, [0, 2]]
        shown = np.array([point for (_, at), point in truth.items() if at == scan]).reshape(-1, 2)
        np.testing.assert_allclose(np.sort(shown, axis=0), np.sort(states, axis=0), atol=rounding)
        assert (info["truth"]["source"] == -1).sum() == scene["clutter"]["counts"][scan]
        _, _, _, _, info = env.step(np.zeros(env.action_space.shape))
    missed, seen = curves[scene["seen"][0]], curves[scene["seen"][1]]
    assert len(missed) == len(truth) and len(seen) == (missed == 0.0).sum() > 0
    replays_by_agent = {replay["agent"]: replay for replay in document["replays"]}
    row = next(entry.cell.rows[0] for entry in entries_of(tmp_path / "r") if entry.cell.agent == "association-oracle")
    oracle = replays_by_agent["association-oracle"]
    assert curves[oracle["errors"]].mean() == pytest.approx(row["ospa"], abs=0.25)
    assert set(_runs(oracle["tracks"], curves)) and (replays_by_agent["raw-measurements"]["tracks"] is None) == (
        level == 1
    )


@pytest.mark.skipif(_NODE is None, reason="needs node")
@pytest.mark.parametrize("level", [2, 4])
def test_false_measurements_in_javascript_are_those_of_the_environment(level: int) -> None:
    world = gym.make_vec("ClutterTracking-v0", num_envs=1, level=level, horizon=9)
    world.reset(seed=[SEEDS[1]])
    clutter = Clutter.of(world.unwrapped.world, 0, 9)
    assert clutter is not None
    code = (
        "globalThis.window = { servotrack: {} };"
        "require('vm').runInThisContext(require('fs').readFileSync(process.argv[1], 'utf8'));"
        "console.log(JSON.stringify(window.servotrack.sets.clutterOf(JSON.parse(process.argv[2]))));"
    )
    command = [str(_NODE), "-e", code, str(ASSETS / "sets.js"), json.dumps(clutter.packed())]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)
    for step, points in enumerate(found):
        scan, source, _, _ = world.unwrapped.world.scan(0, step)
        false = scan[source == -1, 1:]
        if clutter.sensor is not None:
            turn = np.exp(1j * false[:, 1]) * false[:, 0]
            false = clutter.sensor + np.stack([turn.real, turn.imag], axis=1)
        np.testing.assert_allclose(np.sort(points, axis=0), np.sort(false, axis=0), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "form"),
    [
        ("SonarTracking-v0", {"horizon": 6}, "bearings"),
        ("ColorTracking-v0", {"horizon": 5}, "boxes"),
        ("PedestrianTracking-v0", {"horizon": 5}, "boxes"),
        ("RecordedPoints-v0", {"horizon": 6}, "points"),
    ],
)
def test_worlds_without_an_arm_have_replays(env_id: str, kwargs: dict[str, Any], form: str, tmp_path: Path) -> None:
    cell = evaluate(env_id, "random", SEEDS[:2], kwargs, folder=ResultsFolder(tmp_path), timing=False)
    made = replays.replay(cell, rerun_actions(cell, cell.seeds))
    assert made.faithful and set(made.motions) == set(SEEDS[:2])
    packer = Packer()
    scene = made.scenes[SEEDS[0]].packed(packer)
    answers = made.motions[SEEDS[0]].packed(packer)
    assert (scene["form"], scene["steps"]) == (form, kwargs["horizon"])
    assert answers["tracks"][0] and len(unpacked({"curves": packer.curves, "samples": packer.text()})) > 1


def test_a_race_has_both_opponents_on_every_seed(site: Path) -> None:
    race = delivered(site / "data" / "race.js")
    (course,) = race["courses"]
    assert set(course["seeds"]) <= set(SEEDS) and course["seeds"]
    pairs = {(replay["agent"], replay["seed"]) for replay in course["replays"]}
    assert pairs == {(agent, seed) for agent in race["racers"] for seed in course["seeds"]}
    assert course["anchors"][0] > course["anchors"][1] > 0.0


@pytest.mark.skipif(not SUBMISSION.is_dir(), reason="needs leaderboard/ of the repository")
def test_submissions_have_the_badge_that_the_verifier_gave(tmp_path: Path) -> None:
    folder = tmp_path / "2027a" / "kf"
    shutil.copytree(SUBMISSION, folder)
    before = entries_of(tmp_path)
    assert {entry.proof for entry in before} == {"self-reported"} and all(entry.traced for entry in before)
    cells = {
        entry.cell.environment: CellVerdict("equal", {"public": 0.9, "sealed": 0.9}, fresh=(0.8, 0.01))
        for entry in before[1:]
    }
    cells[before[0].cell.environment] = CellVerdict("skipped")
    seal = read_submission(folder).seal
    write_verdicts([Verdict("kf", "kf", "registered", "2027a", seal, "re-run", cells=cells)], tmp_path / "v.json")
    first, *others = entries_of(tmp_path, tmp_path / "v.json")
    assert first.proof == "self-reported" and {entry.proof for entry in others} == {"re-run"}
    assert others[0].fresh == (0.8, 0.01)
    whole = replace(first.cell, rows=[*first.cell.rows, *first.sealed])
    assert first.sealed and replays.replay(whole, first.actions(whole, whole.seeds)).faithful


def test_changed_rows_are_not_replayed(results: Path) -> None:
    (entry,) = (entry for entry in entries_of(results) if entry.cell.agent == "lifted-kf")
    actions = rerun_actions(entry.cell, SEEDS)
    assert replays.replay(entry.cell, actions).faithful
    rows = [{**row, "steady": row["steady"] * 0.9} if row["seed"] == SEEDS[1] else row for row in entry.cell.rows]
    changed = replays.replay(replace(entry.cell, rows=rows), actions)
    assert not changed.faithful and set(changed.motions) == {SEEDS[0], SEEDS[2]}
    cut = replays.replay(entry.cell, {**actions, SEEDS[0]: actions[SEEDS[0]][:100]})
    assert not cut.faithful and SEEDS[0] not in cut.motions


def test_traces_prove_rows(results: Path, tmp_path: Path) -> None:
    entries = [replace(entry, traced=True) for entry in entries_of(results)]
    false = replace(entries[0].cell, rows=[{**row, "return": row["return"] + 1.0} for row in entries[0].cell.rows])
    entries[0] = replace(entries[0], cell=false)
    write_site(entries, tmp_path, "test")
    rows = delivered(tmp_path / "data" / "board.js")["suites"][0]["worlds"][0]["tasks"][0]["rows"]
    proofs = {row["agent"]: row["proof"] for row in rows}
    assert proofs.pop(entries[0].cell.agent) == "self-reported"
    assert set(proofs.values()) == {"replayed"}


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    write_site(hostile_entries(), tmp_path, NAMES[0])
    for path in (tmp_path / "data").iterdir():
        delivered(path)
    board = delivered(tmp_path / "data" / "board.js")
    assert set(NAMES) == {row["agent"] for row in board["suites"][0]["worlds"][0]["tasks"][0]["rows"]}
    assert NAMES[0] not in (tmp_path / "index.html").read_text(encoding="utf-8")
    scripts = "".join((ASSETS / name).read_text(encoding="utf-8") for name in SCRIPTS)
    assert not re.search(r"innerHTML|insertAdjacentHTML|outerHTML|document\.write|\beval\b|new Function", scripts)


def test_a_foreign_agent_is_not_run(results: Path) -> None:
    entry = entries_of(results)[0]
    assert rerun_actions(replace(entry.cell, agent="os:system"), SEEDS) == {}


def test_the_command_writes_the_site_alone(results: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["leaderboard", str(results), "--site", str(tmp_path / "site")])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "site" / "index.html").is_file() and not (results / "leaderboard.html").exists()
    both = CliRunner().invoke(app, ["leaderboard", str(results), "--site", str(tmp_path / "x"), "--details"])
    assert isinstance(both.exception, ValueError) and "--site" in str(both.exception)


def test_sources_without_rows_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="no submissions and no results"):
        entries_of(tmp_path)
    with pytest.raises(ValueError, match="at least one row"):
        write_site(list[Entry](), tmp_path, "test")


def test_every_seed_can_be_watched_if_all_are_wanted(tmp_path: Path) -> None:
    """The usual site has best, median, worst and the first shared seeds of 20; the large one has all of both agents."""
    agents, seeds = ("random", "kf"), range(200_000, 200_020)
    for agent in agents:
        evaluate("UncalibServo-v0", agent, seeds, {"level": 1}, folder=ResultsFolder(tmp_path / "r"), timing=False)
    entries = entries_of(tmp_path / "r")
    watched = {}
    for every in (False, True):
        paths = write_site(entries, tmp_path / f"site-{every}", "test", every_seed=every)
        task = next(path for path in paths if path.name == "task-0.js")
        watched[every] = {(replay["agent"], replay["seed"]) for replay in delivered(task)["replays"]}
    assert watched[True] == {(agent, seed) for agent in agents for seed in seeds}
    assert watched[False] < watched[True]
