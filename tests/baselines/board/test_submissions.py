"""Suites, seeds, traces and submissions."""

from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from board_cases import CELL, contents_of, submitted, write_suite
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.action_grid import ActionGrid
from servotrack.baselines.board.equal_forms import divided, form_means
from servotrack.baselines.board.recording import AgentPlayer
from servotrack.baselines.board.replay import Episode, ReplayError, replayed
from servotrack.baselines.board.sealed_seeds import FIRST, agent_digest, derived_seeds, form_of
from servotrack.baselines.board.seed_luck import luckiest, scores_of
from servotrack.baselines.board.submission import SubmissionError, read_submission
from servotrack.baselines.board.submit import registered_candidate, submit
from servotrack.baselines.board.suites import load_suite, suite_names
from servotrack.baselines.board.trace_files import Trace, decoded, encoded
from servotrack.baselines.evaluation.seeds import TEST
from servotrack.baselines.reporting.files import ResultsError


@pytest.mark.parametrize("name", suite_names())
def test_worlds_behave_as_when_the_suite_was_frozen(name: str) -> None:
    stale = [cell.name for cell in load_suite(name).cells if cell.is_stale()]
    assert not stale, (
        f"rollouts or scores of {', '.join(stale)} changed: rows on the board are stale. Undo it, or freeze a new suite"
    )


def test_a_changed_world_is_stale(tmp_path: Path) -> None:
    suite = load_suite(str(write_suite(tmp_path, behavior="0" * 64)))
    assert suite.cells[0].is_stale()
    with pytest.raises(SubmissionError, match="differs from that of suite tiny"):
        submit(registered_candidate("kf", ""), suite, tmp_path / "kf")


def test_derived_seeds_are_apart_from_all_others() -> None:
    seeds = derived_seeds(f"2027a/{CELL}", 500)
    assert len(set(seeds)) == 500
    assert min(seeds) >= FIRST > TEST.stop
    assert max(seeds) < 2**53
    assert not set(seeds) & set(derived_seeds(f"2027b/{CELL}", 500))
    assert derived_seeds(f"2027a/{CELL}", 3) == seeds[:3]


def test_the_files_of_an_agent_choose_one_form_for_all_cells() -> None:
    suite = load_suite("2027a")
    for cell in suite.cells:
        pool = suite.pool(cell)
        digests = [agent_digest({"agent.py": b"pass" + b" " * k}) for k in range(60)]
        forms = {tuple(suite.sealed_seeds(cell, digest)) for digest in digests}
        assert len(forms) == cell.form_count
        assert sorted(seed for form in forms for seed in form) == sorted(pool)
        number = form_of(digests[0], suite.name, cell.form_count)
        assert suite.sealed_seeds(cell, digests[0]) == [
            s for s, f in zip(pool, cell.forms, strict=True) if int(f) == number
        ]
        assert not set(pool) & set(suite.fresh_seeds(cell, digests[0], "nonce", 100))


def test_a_stranger_can_compute_the_sealed_seeds() -> None:
    # By the words of docs/board.md alone.
    files, suite = {"b.txt": b"2", "a.py": b"1"}, load_suite("2027a")
    parts = (b"a.py", b"1", b"b.txt", b"2")
    digest = hashlib.sha256(b"".join(bytes([len(part)]) + bytes(7) + part for part in parts)).hexdigest()
    assert digest == agent_digest(files)

    def bits(text: str) -> int:
        return int(hashlib.sha256(text.encode()).hexdigest()[:12], 16)

    cell = suite.cells[3]
    form = bits(f"{digest}/2027a") % 4
    own = [2**32 + bits(f"2027a/{cell.name}/{k}") for k in range(len(cell.forms)) if cell.forms[k] == str(form)]
    assert own == suite.sealed_seeds(cell, digest)


@pytest.mark.parametrize("forms", ["011", "0112", "1122", "0g"])
def test_forms_must_be_equally_large(tmp_path: Path, forms: str) -> None:
    with pytest.raises(ResultsError, match="forms"):
        load_suite(str(write_suite(tmp_path, forms=forms)))


def test_forms_are_equal_for_agents_that_agree_on_what_is_hard() -> None:
    draws = np.random.default_rng(3)
    hard = draws.normal(size=160)
    scores = [hard * share + 0.3 * draws.normal(size=160) for share in (1.0, 2.0, 0.5)]
    forms = {"cell": divided(scores, 8)}
    chance = {"cell": divided([np.zeros(160)], 8)}
    assert sorted(Counter(forms["cell"]).items()) == [(f"{k}", 20) for k in range(8)]
    for own in scores:
        assert np.ptp(form_means({"cell": own}, forms)) < 0.1 * np.ptp(form_means({"cell": own}, chance))
    unknown = {"cell": hard + 0.3 * draws.normal(size=160)}
    assert np.ptp(form_means(unknown, forms)) < 0.5 * np.ptp(form_means(unknown, chance))
    with pytest.raises(ValueError, match="multiple of 8"):
        divided([hard[:-1]], 8)


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["kf", "fixed-jacobian", "latency-bank-lifted-kf"])
def test_no_form_of_the_suite_is_lucky(agent: str) -> None:
    suite = load_suite("2027a")
    for env_id in ("UncalibServo-v0", "UncalibServoReach-v0"):
        means = form_means(scores_of(suite, agent, env_id), {cell.name: cell.forms for cell in suite.cells})
        assert luckiest(means) < 0.01, (env_id, means)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=5), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_traces_come_back(lengths: list[int], width: int, seed: int) -> None:
    draws = np.random.default_rng(seed)
    episodes = tuple(draws.integers(-32_767, 32_768, (length, width)).astype(np.int16) for length in lengths)
    content = encoded(Trace(32_767, episodes))
    trace = decoded(content, len(lengths), width, 32_767, 40)
    assert all(np.array_equal(a, b) for a, b in zip(trace.episodes, episodes, strict=True))


def test_the_grid_keeps_its_points_and_the_bounds() -> None:
    grid = ActionGrid.of(spaces.Box(-1.0, 1.0, (2,), np.float32), 32_767)
    points = np.arange(-32_767, 32_768, dtype=np.int16).repeat(2).reshape(-1, 2)
    actions = grid.actions(points)
    assert actions.dtype == np.float32
    assert np.array_equal(grid.rounded(actions), points)
    assert np.array_equal(actions[[0, -1]], [[-1, -1], [1, 1]])
    assert np.array_equal(grid.rounded(np.array([[-7.0, 7.0]])), [[-32_767, 32_767]])
    with pytest.raises(ValueError, match="must be finite"):
        grid.rounded(np.array([[np.nan, 0.0]]))


def test_replay_gives_the_same_bits_in_any_company(suite: Path) -> None:
    frozen = load_suite(str(suite))
    cell = frozen.cells[0]
    episodes = AgentPlayer(agent_card("random")).play(frozen, cell, list(range(200_000, 200_008)))
    together = replayed(frozen, cell, episodes)
    assert together == [row for episode in episodes for row in replayed(frozen, cell, [episode])]
    shortened = Episode(episodes[0].seed, episodes[0].points[:-1])
    lengthened = Episode(episodes[0].seed, np.concatenate([episodes[0].points, episodes[0].points[:1]]))
    rows = replayed(frozen, cell, [shortened, lengthened, episodes[1]])
    assert [isinstance(row, ReplayError) for row in rows] == [True, True, False]


def test_submissions_repeat(tmp_path: Path, suite: Path, original: dict[str, bytes]) -> None:
    again = contents_of(submitted(tmp_path / "kf", suite))
    assert {name for name in again if again[name] != original[name]} <= {"card.json"}


def test_a_submission_is_what_the_suite_demands(tmp_path: Path, suite: Path) -> None:
    folder = submitted(tmp_path / "kf", suite)
    submission = read_submission(folder, load_suite(str(suite)))
    assert submission.is_complete
    assert submission.information == "model-free"
    (results,) = submission.results("public")
    assert (results.agent, results.seeds) == ("kf", [200_000, 200_001])
    assert all(row["length"] == len(episode.points) for row, episode in zip(
        results.rows, submission.cells[0].episodes("public"), strict=True
    ))  # fmt: skip
    with pytest.raises(SubmissionError, match="exists"):
        submitted(folder, suite)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kf"]


def test_unknown_suites_and_cells_are_named(tmp_path: Path, suite: Path) -> None:
    with pytest.raises(ResultsError, match="no suite is called '2026z'; known are 2027a"):
        load_suite("2026z")
    with pytest.raises(ValueError, match="has no cell 'UncalibServo-v0,level=9'"):
        load_suite(str(suite)).cell("UncalibServo-v0,level=9")
    (tmp_path / "bad.yaml").write_text("name: x")
    with pytest.raises(ResultsError, match=r"bad\.yaml is not a suite"):
        load_suite(str(tmp_path / "bad.yaml"))
