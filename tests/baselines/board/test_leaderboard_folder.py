"""Submissions in the repository: all are well-formed, and random cells of them are replayed."""

from __future__ import annotations

import json

import pytest
from board_cases import EXAMPLES, ROOT

from servotrack.baselines.board.submission import read_submission
from servotrack.baselines.board.suites import suite_names
from servotrack.baselines.board.verify import read_verdicts, submission_folders, verify

BOARD = ROOT / "leaderboard"
pytestmark = pytest.mark.skipif(not BOARD.is_dir(), reason="source distributions come without submissions")


@pytest.mark.parametrize("suite", suite_names())
def test_a_random_cell_of_every_submission_is_confirmed(suite: str) -> None:
    folders = submission_folders([BOARD / suite])
    assert len(folders) > 5
    for verdict in verify(folders, suite, sample=1):
        assert verdict.is_confirmed, verdict


@pytest.mark.parametrize("suite", suite_names())
def test_verdicts_are_about_the_present_submissions(suite: str) -> None:
    cards = {
        folder.name: json.loads((folder / "card.json").read_bytes()) for folder in submission_folders([BOARD / suite])
    }
    assert {name: card["name"] for name, card in cards.items()} == {name: name for name in cards}
    seals = {card["seal"]: name for name, card in cards.items()}
    # A submission without a verdict is self-reported until a maintainer has verified it.
    for seal, verdict in read_verdicts(BOARD / suite / "verdicts.json").items():
        assert seals.get(seal) == verdict.folder, f"{verdict.folder} was changed: verify it again"
        assert verdict.badge != "self-reported"


def test_the_pages_show_the_examples() -> None:
    page = (ROOT / "docs" / "board.md").read_text(encoding="utf-8")
    assert f"```python\n{(EXAMPLES / 'agent.py').read_text(encoding='utf-8')}```" in page
    observer = (EXAMPLES / "observer.py").read_text(encoding="utf-8")
    assert f"```python\n{observer}```" in (ROOT / "docs" / "board-observer.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("suite", suite_names())
def test_all_submissions_are_confirmed(suite: str) -> None:
    folders = submission_folders([BOARD / suite])
    for folder, verdict in zip(folders, verify(folders, suite), strict=True):
        assert verdict.badge == "replayed", verdict
        assert read_submission(folder).name == folder.name
