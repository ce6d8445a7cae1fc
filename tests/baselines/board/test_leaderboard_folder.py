"""Submissions in the repository: all are well-formed, and random cells of them are replayed."""

from __future__ import annotations

import random

import pytest
from board_cases import EXAMPLES, ROOT

from servotrack.baselines.board.submission import read_submission
from servotrack.baselines.board.suites import suite_names
from servotrack.baselines.board.verify import read_verdicts, submission_folders, verify

BOARD = ROOT / "leaderboard"
pytestmark = pytest.mark.skipif(not BOARD.is_dir(), reason="source distributions come without submissions")
AT_ONCE = 8
"""Submissions that one test run verifies, drawn at random."""


@pytest.mark.parametrize("suite", suite_names())
def test_a_random_sample_of_submissions_is_confirmed(suite: str) -> None:
    folders = submission_folders([BOARD / suite])
    assert len(folders) > 20
    chosen = random.SystemRandom().sample(folders, AT_ONCE)
    for verdict in verify(chosen, suite, sample=1):
        assert verdict.is_confirmed, verdict


@pytest.mark.parametrize("suite", suite_names())
def test_every_submission_has_a_verdict(suite: str) -> None:
    verdicts = read_verdicts(BOARD / suite / "verdicts.json")
    names = {verdict.folder: verdict for verdict in verdicts.values()}
    for folder in submission_folders([BOARD / suite]):
        assert names[folder.name].badge in ("replayed", "re-run"), names[folder.name]


def test_the_page_shows_the_example() -> None:
    page = (ROOT / "docs" / "board.md").read_text(encoding="utf-8")
    assert f"```python\n{(EXAMPLES / 'agent.py').read_text(encoding='utf-8')}```" in page


@pytest.mark.slow
@pytest.mark.parametrize("suite", suite_names())
def test_all_submissions_are_confirmed(suite: str) -> None:
    folders = submission_folders([BOARD / suite])
    for folder, verdict in zip(folders, verify(folders, suite), strict=True):
        assert verdict.badge == "replayed", verdict
        assert read_submission(folder).name == folder.name
