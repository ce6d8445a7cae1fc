"""One suite and one submission for all tests of the board."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from board_cases import contents_of, submitted, write_suite


@pytest.fixture(scope="session")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of a suite of one short cell."""
    return write_suite(tmp_path_factory.mktemp("suite"))


@pytest.fixture(scope="session")
def original(tmp_path_factory: pytest.TempPathFactory, suite: Path) -> dict[str, bytes]:
    """Contents of a valid submission of `kf`."""
    return contents_of(submitted(tmp_path_factory.mktemp("original") / "kf", suite))


@pytest.fixture
def folder(tmp_path: Path, original: dict[str, bytes]) -> Callable[..., Path]:
    """Function that writes a changed copy of the submission."""
    from board_cases import write_contents

    return lambda contents: write_contents(tmp_path / "kf", contents)
