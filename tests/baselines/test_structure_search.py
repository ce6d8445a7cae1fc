"""Search of a structure within a budget: what it draws, what it spends, what it finds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from servotrack.baselines.agents.servo.structured import structured_controller
from servotrack.baselines.evaluation.seeds import TUNE
from servotrack.baselines.tuning.racing import search_cell, search_structure
from servotrack.baselines.tuning.search import Measured
from servotrack.baselines.tuning.structures import GridStructures, ServoStructures, structures_for

STEPS = 10


class _Points:
    """Candidates are numbers; the cost of an episode is their distance from 3, with noise of its seed."""

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        return {"x": float(rng.uniform(-10.0, 10.0))}

    def changed(self, structure: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        return {"x": structure["x"] + float(rng.normal(0.0, 0.5))}

    def card(self, structure: dict[str, Any]) -> Any:
        raise NotImplementedError


def _play(structure: dict[str, Any], seeds: Sequence[int]) -> Measured:
    assert all(seed in TUNE for seed in seeds)
    noise = np.array([np.random.default_rng(seed).normal(0.0, 0.3) for seed in seeds])
    return Measured(abs(structure["x"] - 3.0) + noise, STEPS * len(seeds))


@pytest.mark.parametrize("budget", [3_000, 20_000, 400_000])
def test_the_search_spends_its_budget_and_not_more(budget: int) -> None:
    found = search_structure(_Points(), _play, budget, STEPS, np.random.default_rng(0))
    assert 0.7 * budget < found.steps <= budget
    assert found.steps == sum(race.steps for race in found.races)


def test_a_larger_budget_comes_closer() -> None:
    def distance(budget: int) -> float:
        rngs = [np.random.default_rng(seed) for seed in range(8)]
        found = [search_structure(_Points(), _play, budget, STEPS, rng).chosen["x"] for rng in rngs]
        return float(np.mean(np.abs(np.array(found) - 3.0)))

    assert distance(30_000) < distance(3_000)
    assert distance(30_000) < 0.25


def test_the_winner_is_one_that_played_most() -> None:
    race = search_structure(_Points(), _play, 20_000, STEPS, np.random.default_rng(1)).races[0]
    assert race.episodes[race.candidates.index(race.winner)] == max(race.episodes)
    assert len(race.candidates) == 27


def test_a_budget_without_room_for_the_first_race_is_refused() -> None:
    with pytest.raises(ValueError, match="budget must be at least 2025 environment steps"):
        search_structure(_Points(), _play, 1_000, STEPS, np.random.default_rng(0))


def test_every_draw_and_change_is_a_controller() -> None:
    space, rng = ServoStructures(), np.random.default_rng(2)
    filters, laws = set(), set()
    for _ in range(150):
        structure = space.draw(rng)
        for _ in range(3):
            # What a record holds comes back the same.
            assert json.loads(json.dumps(structure)) == structure
            structured_controller(structure, 2.0)
            filters.add(structure["filter"])
            laws.add(structure["law"])
            structure = space.changed(structure, rng)
    assert filters == {"kf", "lifted"}
    assert laws == {"pi", "proportional", "one-step"}


@pytest.mark.parametrize(("field", "value"), [("filter", "magic"), ("law", "magic")])
def test_an_unknown_part_is_refused(field: str, value: str) -> None:
    structure = {**ServoStructures().draw(np.random.default_rng(0)), field: value}
    with pytest.raises(ValueError, match=f"{field} must be"):
        structured_controller(structure, 2.0)


def test_followers_are_drawn_from_their_grids() -> None:
    space, rng = structures_for("PedestrianServo-v0"), np.random.default_rng(0)
    assert isinstance(space, GridStructures)
    agents = set()
    for _ in range(20):
        structure = space.draw(rng)
        agents.add(structure["agent"])
        assert space.changed(structure, rng)["values"].keys() == structure["values"].keys()
        assert space.card(structure).name == "structured"
    assert agents == {"phd-servo", "crowd-servo"}
    with pytest.raises(ValueError, match="env_id must be"):
        structures_for("ClutterTracking-v0")


def test_a_run_repeats() -> None:
    first, second = (search_cell("UncalibServoReach-v0", 1, 22_000, 3) for _ in range(2))
    assert first.as_record() == second.as_record()
    assert first.steps <= 22_000
