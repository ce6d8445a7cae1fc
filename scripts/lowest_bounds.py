"""Print pip constraints that pin every dependency to the lowest version pyproject.toml allows."""

from __future__ import annotations

import sys
from pathlib import Path

from packaging.requirements import Requirement

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# Older torch wheels cannot be had without several gigabytes of accelerator libraries.
NOT_PINNED = {"torch"}


def lowest_bounds(pyproject: Path) -> list[str]:
    """One `name==version` for each dependency, core or extra, that has a lower bound and applies to this Python.

    The tools of the extra dev are left out: they only matter in a checkout.
    """
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    extras = [lines for name, lines in project["optional-dependencies"].items() if name != "dev"]
    pins = []
    for text in [*project["dependencies"], *(line for extra in extras for line in extra)]:
        requirement = Requirement(text)
        if requirement.name in NOT_PINNED or (requirement.marker and not requirement.marker.evaluate()):
            continue
        pins += [f"{requirement.name}=={bound.version}" for bound in requirement.specifier if bound.operator == ">="]
    return pins


if __name__ == "__main__":
    print("\n".join(lowest_bounds(Path(__file__).parents[1] / "pyproject.toml")))
