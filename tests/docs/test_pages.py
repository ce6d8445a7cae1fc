"""Python blocks of the documents run, and each has a check of its result."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from snippets import run_page, snippets

ROOT = Path(__file__).parents[2]
PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if snippets(page)]


def _film(folder: Path) -> Path:
    """A folder of 40 images: an empty scene, then a box of two colors that moves 3 px to the right per frame."""
    generator = np.random.default_rng(0)
    coarse = generator.integers(60, 120, (12, 16, 3), np.uint8)
    ground = cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC)
    folder.mkdir()
    for k in range(40):
        image = ground.copy()
        if k > 12:
            left = 10 + 3 * (k - 13)
            image[40:72, left : left + 12], image[40:72, left + 12 : left + 24] = (30, 30, 220), (220, 200, 40)
        assert cv2.imwrite(str(folder / f"{k:03}.png"), image)
    return folder


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT / "docs")))
def test_blocks_do_what_the_page_says(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)
    # Dataclasses look their module up by name.
    module = sys.modules["documented_page"] = ModuleType("documented_page")
    vars(module).update(np=np, film=_film(tmp_path / "film"))
    try:
        run_page(page, tmp_path, vars(module))
    finally:
        for name in set(sys.modules) - before:
            if name == "documented_page" or str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
                del sys.modules[name]
