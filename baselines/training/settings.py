"""Hyper-parameters of training: one YAML file per environment, in the form of rl-zoo3's."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parent / "hyper_parameters"
SUPERVISED = ("student", "jacobian", "set", "eyes")
"""Trainings that are none of reinforcement; see the modules of these names in this folder."""
ALGORITHMS = ("ppo", "a2c", "sac", "td3", "recurrent_ppo", "tqc", *SUPERVISED)
"""Those of Stable-Baselines3 and sb3-contrib, then those of `student`, `jacobian_training`, `set_training` and
`eyes_training` of this folder."""
_OWN = (
    "algorithm", "n_envs", "n_timesteps", "policy", "normalize", "encoding", "curriculum", "measurements", "summary"
)  # fmt: skip
_ZOO_ONLY = ("env_wrapper", "vec_env_wrapper", "frame_stack", "callback", "normalize_kwargs", "env_kwargs")


@dataclass(frozen=True)
class TrainingSettings:
    """How one agent is trained.

    Attributes:
        recipe: Key in the file.
        algorithm: One of `ALGORITHMS`.
        n_envs: Environments side by side.
        n_timesteps: Environment steps of a run.
        policy: Name of Stable-Baselines3's policy class.
        normalize: Whether rows are normalized by their running mean and deviation.
        encoding: What `create_encoding` takes.
        curriculum: Levels that are trained in, one stage of equally many steps after the other, each of one or more
            levels side by side; empty: the environment's own level.
        measurements: On tune seeds in the course of a run; as often the run is saved.
        summary: Of the agent, one line for people.
        hyper_parameters: Keywords of the algorithm.
    """

    recipe: str
    algorithm: str
    n_envs: int = 64
    n_timesteps: int = 1_000_000
    policy: str = "MlpPolicy"
    normalize: bool = False
    encoding: Mapping[str, Any] = field(default_factory=lambda: {"kind": "flat"})
    curriculum: tuple[tuple[int, ...], ...] = ()
    measurements: int = 20
    summary: str = ""
    hyper_parameters: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check what can be checked without Stable-Baselines3."""
        if self.algorithm not in ALGORITHMS:
            raise ValueError(f"algorithm must be one of {', '.join(ALGORITHMS)}, got {self.algorithm!r}")
        for name in ("n_envs", "n_timesteps", "measurements"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or int(value) != value or value < 1:
                raise ValueError(f"{name} must be a whole number from 1 on, got {value!r}")
            object.__setattr__(self, name, int(value))
        self._check_curriculum()

    def _check_curriculum(self) -> None:
        stages = self.curriculum
        if not isinstance(stages, (list, tuple)) or not all(
            isinstance(stage, (list, tuple)) and 0 < len(stage) <= self.n_envs and all(type(n) is int for n in stage)
            for stage in stages
        ):
            raise ValueError(f"curriculum must be a list of stages, each a list of levels, got {stages!r}")
        if stages and self.algorithm in SUPERVISED:
            raise ValueError(f"curriculum is for reinforcement learning, not for {self.algorithm}")
        object.__setattr__(self, "curriculum", tuple(tuple(stage) for stage in stages))

    @property
    def levels(self) -> tuple[int, ...]:
        """Levels that an agent is trained for, where they are more than one: those of the last stage."""
        last = self.curriculum[-1] if self.curriculum else ()
        return last if len(last) > 1 else ()

    def as_record(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return asdict(self)


def load_settings(env_id: str, recipe: str, level: int | None = None, path: Path | None = None) -> TrainingSettings:
    """Settings of an environment from its file; those of its level where the file has any.

    Args:
        env_id: Gymnasium id.
        recipe: Key in the file, or with " level=L" behind it: one of `ALGORITHMS`, or any name of a recipe that says
            itself which `algorithm` it is for.
        level: Of the environment.
        path: A file of one's own.

    Raises:
        ValueError: No file, no such key in it, or values that nobody can use.
    """
    file = path or FOLDER / f"{env_id}.yml"
    try:
        document = yaml.safe_load(file.read_text(encoding="utf-8"))
    except OSError as error:
        known = ", ".join(sorted(found.stem for found in FOLDER.glob("*.yml")))
        raise ValueError(
            f"{file.name} cannot be read ({error.strerror}); give --settings FILE, there are files for {known}"
        ) from error
    except yaml.YAMLError as error:
        raise ValueError(f"{file} is no YAML: {error}") from error
    if not isinstance(document, dict):
        raise ValueError(f"{file} must map algorithms to hyper-parameters, got {type(document).__name__}")
    names = [recipe] if level is None else [f"{recipe} level={level}", recipe]
    chosen = next((document[name] for name in names if name in document), None)
    if not isinstance(chosen, dict):
        raise ValueError(f"{file} has no hyper-parameters for {recipe!r}, only for {', '.join(map(str, document))}")
    if strange := [name for name in _ZOO_ONLY if chosen.get(name)]:
        raise ValueError(f"{file}: {', '.join(strange)} of rl-zoo3 has no meaning here; use encoding and --set")
    own = {name: chosen[name] for name in _OWN if name in chosen}
    rest = {name: _read(value) for name, value in chosen.items() if name not in own and name not in _ZOO_ONLY}
    return TrainingSettings(recipe, **{"algorithm": recipe, **own}, hyper_parameters=rest)


def _read(value: Any) -> Any:
    """A value of rl-zoo3: texts that look like Python are read as literals, `dict(...)` included, never evaluated."""
    if not isinstance(value, str) or not value.startswith("dict("):
        return value
    try:
        return _literal(ast.parse(value, mode="eval").body)
    except (SyntaxError, ValueError) as error:
        raise ValueError(f"hyper-parameters must be literals and dict(...), got {value!r} ({error})") from error


def _literal(node: ast.expr) -> Any:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dict" and not node.args:
        return {str(keyword.arg): _literal(keyword.value) for keyword in node.keywords}
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "nn":
        return f"nn.{node.attr}"
    if isinstance(node, ast.List):
        return [_literal(item) for item in node.elts]
    return ast.literal_eval(node)


def schedule(value: Any) -> Any:
    """A learning rate or clip range as Stable-Baselines3 takes it: `lin_X` falls from X to 0 along the training."""
    if not isinstance(value, str):
        return value
    kind, _, first = value.partition("_")
    try:
        initial = float(first)
    except ValueError:
        initial = float("nan")
    if kind != "lin" or not initial > 0.0:
        raise ValueError(f"a schedule must be a number or lin_NUMBER, got {value!r}")

    def falling(remaining: float) -> float:
        return remaining * initial

    scheduled: Callable[[float], float] = falling
    return scheduled
