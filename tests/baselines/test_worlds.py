"""Kinds of worlds: every environment declares its own, and everything else follows from the kind's record."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import pytest

from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.evaluation.bench import default_agents, suite_of
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.results import ResultsFolder, read_cell
from servotrack.baselines.leaderboard.summary import summarize
from servotrack.baselines.leaderboard.table import task_grid
from servotrack.baselines.worlds import OTHER, WORLDS, kind_of, kind_of_id, world_of_id
from servotrack.envs.registration import ENVIRONMENTS

IDS = [(env_id, world.kind) for world in WORLDS.values() for env_id in world.ids]
CLUTTER = ENVIRONMENTS["ClutterTracking-v0"]


@pytest.fixture(params=[False, True], ids=["single", "vector"])
def hard_clutter(request: pytest.FixtureRequest) -> Iterator[str]:
    """A new id of a user's, made of the clutter world's classes, with and without a vector environment of its own."""
    entry = CLUTTER if request.param else {"entry_point": CLUTTER["entry_point"]}
    gym.register("HardClutter-v0", **entry, kwargs={"level": 5, "horizon": 12})
    yield "HardClutter-v0"
    del gym.registry["HardClutter-v0"]


def test_every_id_of_the_package_has_a_record() -> None:
    assert sorted(env_id for env_id, _ in IDS) == sorted(ENVIRONMENTS)


@pytest.mark.parametrize(("env_id", "kind"), IDS)
def test_an_environment_declares_its_kind_through_wrappers_and_vector_environments(env_id: str, kind: str) -> None:
    assert kind_of_id(env_id) == kind
    made = [gym.make(env_id), gym.wrappers.RecordEpisodeStatistics(gym.make(env_id))]
    vectors = [gym.make_vec(env_id, num_envs=1, vectorization_mode=mode) for mode in ("vector_entry_point", "sync")]
    made += [*vectors, gym.wrappers.vector.RecordEpisodeStatistics(vectors[0])]
    assert [kind_of(env) for env in made] == [kind] * len(made)


def test_asynchronous_vector_environments_declare_it_too() -> None:
    env = gym.make_vec("ClutterTracking-v0", num_envs=1, vectorization_mode="async", horizon=5)
    assert kind_of(env) == "clutter"
    env.close()


def test_environments_that_declare_nothing_are_of_no_kind_and_unknown_kinds_are_refused() -> None:
    assert kind_of_id("CartPole-v1") == kind_of_id("NotHere-v3") == OTHER

    class Foreign(gym.Env):
        metadata = {"servotrack_kind": "submarine"}  # noqa: RUF012

    with pytest.raises(ValueError, match=r"must be one of servo, clutter.*got 'submarine'"):
        kind_of(Foreign())


def test_records_name_agents_that_exist() -> None:
    for world in WORLDS.values():
        anchors = () if world.anchors is None else (world.anchors.lower, world.anchors.upper, world.anchors.bound)
        for name in (world.reference, *filter(None, anchors)):
            assert world.kind in AGENTS[name].worlds, name


def test_a_new_id_is_ranked_as_its_kind(hard_clutter: str, tmp_path: Path) -> None:
    assert world_of_id(hard_clutter).kind == "clutter"
    assert default_agents(hard_clutter) == default_agents("ClutterTracking-v0")
    offered = {cell.agent for cell in suite_of(hard_clutter)}
    # Learned agents have no network for an id that they were not trained in.
    assert offered == {name for name in default_agents(hard_clutter) if AGENTS[name].trained_in is None}
    folder = ResultsFolder(tmp_path)
    cells = [
        evaluate(hard_clutter, name, range(100_000, 100_006), folder=folder) for name in ("pmb", "gm-phd", "random")
    ]
    task = summarize(cells)[0]
    assert task.world.headline.column == "ospa2"
    assert {row.agent for row in task.rows if row.difference is not None} == {"pmb", "random"}
    assert [row.agent for row in task.rows][-1] == "random"
    grid = task_grid(task)
    assert "OSPA(2) m" in grid.headings and "− gm-phd m" in grid.headings


def test_a_stored_result_keeps_its_kind_where_the_id_is_unknown(tmp_path: Path) -> None:
    gym.register("HardClutter-v1", **CLUTTER, kwargs={"level": 5, "horizon": 12})
    folder = ResultsFolder(tmp_path)
    evaluate("HardClutter-v1", "gm-phd", [100_000], folder=folder, timing=False)
    del gym.registry["HardClutter-v1"]
    assert read_cell(folder.file_of("HardClutter-v1", {}, "gm-phd")).kind == "clutter"
