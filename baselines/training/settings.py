"""Hyper-parameters of training: one YAML file per environment, in the format of rl-zoo3."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from servotrack.baselines.agents.learned.card_fields import CARD, check_encoding
from servotrack.baselines.reporting.files import ResultsError, read_strict_yaml

FOLDER = Path(__file__).parent / "hyper_parameters"
SUPERVISED = ("student", "jacobian", "set", "eyes")
"""Supervised algorithms: servo policy, Jacobian estimator, set predictor, marker network (`eyes`)."""
ALGORITHMS = ("ppo", "a2c", "sac", "td3", "recurrent_ppo", "tqc", *SUPERVISED)
"""Algorithms of Stable-Baselines3 and sb3-contrib, then the supervised ones."""
_OWN = (
    "algorithm", "n_envs", "n_timesteps", "policy", "normalize", "encoding", "curriculum", "measurements", "summary"
)  # fmt: skip
_ZOO_ONLY = ("env_wrapper", "vec_env_wrapper", "frame_stack", "callback", "normalize_kwargs", "env_kwargs")


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training of one agent.

    Attributes:
        recipe: Key in the file.
        algorithm: One of `ALGORITHMS`.
        n_envs: Number of environments side by side.
        n_timesteps: Environment steps of a run.
        policy: Name of Stable-Baselines3's policy class.
        normalize: True normalizes rows by their running mean and deviation.
        encoding: Encoding of observations; see `create_encoding`.
        curriculum: Levels of each stage, one or more side by side; stages have equally many steps. Empty: the
            environment's own level.
        measurements: Number of evaluations on tune seeds in a run, each followed by a checkpoint.
        summary: Description of the agent in one line.
        hyper_parameters: Keyword arguments of the algorithm.
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
        """Check values, as far as possible without Stable-Baselines3."""
        if self.algorithm not in ALGORITHMS:
            raise ValueError(f"algorithm must be one of {', '.join(ALGORITHMS)}, got {self.algorithm!r}")
        for name in ("n_envs", "n_timesteps", "measurements"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or int(value) != value or value < 1:
                raise ValueError(f"{name} must be a whole number >= 1, got {value!r}")
            object.__setattr__(self, name, int(value))
        # The agent's card holds them, and is read again after every evaluation.
        CARD.fields["name"].check(self.recipe, "recipe")
        CARD.fields["summary"].check(self.summary, "summary")
        check_encoding(self.encoding)
        self._check_curriculum()

    def _check_curriculum(self) -> None:
        stages = self.curriculum
        if not isinstance(stages, (list, tuple)) or not all(
            isinstance(stage, (list, tuple)) and 0 < len(stage) <= self.n_envs and all(type(n) is int for n in stage)
            for stage in stages
        ):
            raise ValueError(f"curriculum must be a list of stages, each a list of levels, got {stages!r}")
        if stages and self.algorithm in SUPERVISED:
            raise ValueError(f"curriculum is supported by reinforcement learning only, got it with {self.algorithm}")
        object.__setattr__(self, "curriculum", tuple(tuple(stage) for stage in stages))

    @property
    def levels(self) -> tuple[int, ...]:
        """Levels of the last stage if they are more than one, else (): those that the agent is trained for."""
        last = self.curriculum[-1] if self.curriculum else ()
        return last if len(last) > 1 else ()

    def as_record(self) -> dict[str, Any]:
        """Return the settings as JSON can hold them."""
        return asdict(self)


def load_settings(env_id: str, recipe: str, level: int | None = None, path: Path | None = None) -> TrainingSettings:
    """Read the settings of an environment from its file, those of its level if the file has any.

    Args:
        env_id: Gymnasium id.
        recipe: Key in the file, where " level=L" may follow it: one of `ALGORITHMS`, or any other name if the entry
            has an `algorithm`.
        level: Level of the environment.
        path: Another file than the package's.

    Raises:
        ValueError: No file, no such key in it, or invalid values.
    """
    file = path or FOLDER / f"{env_id}.yml"
    try:
        document = read_strict_yaml(file)
    except ResultsError as error:
        known = ", ".join(sorted(found.stem for found in FOLDER.glob("*.yml")))
        raise ValueError(f"{error}; give --settings FILE, or name one of the worlds with a file: {known}") from error
    if not isinstance(document, dict):
        raise ValueError(f"{file} must map algorithms to hyper-parameters, got {type(document).__name__}")
    names = [recipe] if level is None else [f"{recipe} level={level}", recipe]
    chosen = next((document[name] for name in names if name in document), None)
    if not isinstance(chosen, dict):
        raise ValueError(f"{file} has no hyper-parameters for {recipe!r}, only for {', '.join(map(str, document))}")
    if strange := [name for name in _ZOO_ONLY if chosen.get(name)]:
        raise ValueError(f"{file}: {', '.join(strange)} of rl-zoo3 is not supported; use encoding and --set")
    own = {name: chosen[name] for name in _OWN if name in chosen}
    rest = {name: _read(value) for name, value in chosen.items() if name not in own and name not in _ZOO_ONLY}
    return TrainingSettings(recipe, **{"algorithm": recipe, **own}, hyper_parameters=rest)


def _read(value: Any) -> Any:
    """Parse a value of rl-zoo3: `dict(...)` in a text is read as a literal and never evaluated."""
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
    """Convert a learning rate or clip range for Stable-Baselines3: `lin_X` falls linearly from X to 0."""
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
