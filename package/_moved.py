"""Import paths of version 0.1 that stay for one release, each with a DeprecationWarning that names the new one."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MOVED: Mapping[str, str] = {
    "servotrack.baselines.bench": "servotrack.baselines.evaluation.bench",
    "servotrack.baselines.evaluate": "servotrack.baselines.evaluation.evaluate",
    "servotrack.baselines.observers": "servotrack.baselines.agents.tracking",
    "servotrack.baselines.protocol": "servotrack.baselines.agents.protocol",
    "servotrack.baselines.registry": "servotrack.baselines.agents.registry",
    "servotrack.baselines.results": "servotrack.baselines.evaluation.results",
    "servotrack.baselines.sb3": "servotrack.baselines.training.sb3",
    "servotrack.baselines.seeds": "servotrack.baselines.evaluation.seeds",
    "servotrack.baselines.statistics": "servotrack.baselines.evaluation.statistics",
    "servotrack.baselines.video_trackers": "servotrack.baselines.agents.people.catalog",
    "servotrack.envs.track.frames": "servotrack.envs.track.files.frames",
    "servotrack.envs.track.levels": "servotrack.envs.track.clutter.config",
    "servotrack.envs.track.told": "servotrack.envs.track.clutter.scene_model",
    "servotrack.estimators.online": "servotrack.estimators.stateful",
}
"""New module by old module."""

RENAMED: Mapping[tuple[str, str], str] = {
    ("servotrack.estimators.online", "Online"): "Stateful",
    ("servotrack.envs.track.told", "told"): "scene_model_of",
}
"""New name by old module and old name, where both changed."""


class _MovedModule(ModuleType):
    """Forwards every name to the module at the new path.

    Where the old module has the name of a function of the package above it (`servotrack.baselines.evaluate`), it can be
    called like that function.
    """

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(importlib.import_module(MOVED[self.__name__]), RENAMED.get((self.__name__, name), name))

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **kwargs)


class _MovedFinder(MetaPathFinder, Loader):
    """Finds the old paths after all other finders have failed."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a spec for an old path, None for every other name."""
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the forwarding module and warn."""
        old, new = spec.name, MOVED[spec.name]
        warnings.warn(
            f"{old} has moved to {new} and goes away in version 0.3; import {new} instead",
            DeprecationWarning,
            # The frames between are those of the import system, which Python leaves out of the count.
            stacklevel=2,
        )
        return _MovedModule(old)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: names are forwarded when they are read."""


def install() -> None:
    """Make the old paths importable; safe to call twice."""
    if not any(isinstance(finder, _MovedFinder) for finder in sys.meta_path):
        sys.meta_path.append(_MovedFinder())
