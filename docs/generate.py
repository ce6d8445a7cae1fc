"""Write a page per environment from its docstring, its spaces and its configuration, an index of them, and pictures.

`python docs/generate.py` writes the pages and the README's pictures of worlds; with `--check` it writes nothing and
exits with 1 where a page is stale.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
import itertools
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import gymnasium as gym

from servotrack.baselines import create_agent
from servotrack.baselines.evaluation.evaluate import show_belief
from servotrack.envs.registration import ENVIRONMENTS

FOLDER = Path(__file__).parent / "environments"
IMAGES = Path(__file__).parent / "images"


class Picture(NamedTuple):
    """A picture of the README: an agent in an environment with these arguments, some steps into a train seed."""

    name: str
    env_id: str
    arguments: dict[str, Any]
    agent: str
    steps: int


PICTURES = (
    Picture("servo.png", "UncalibServo-v0", {"level": 3}, "lifted-kf", 160),
    Picture("pedestrian-servo.png", "PedestrianServo-v0", {"level": 2, "lamps": 2, "umbrellas": 1}, "phd-servo", 70),
    Picture("clutter-tracking.png", "ClutterTracking-v0", {}, "pmb", 88),
    Picture("pedestrians.png", "PedestrianTracking-v0", {"level": 1}, "pmb", 150),
    Picture("sonar.png", "SonarTracking-v0", {"level": 3}, "hmm-row", 184),
    Picture("color-tracking.png", "ColorTracking-v0", {"level": 2}, "monte-carlo-color", 120),
)


def pages() -> dict[Path, str]:
    """What every generated file has to hold."""
    texts = {FOLDER / f"{env_id}.md": page(env_id) for env_id in ENVIRONMENTS}
    texts[FOLDER / "index.md"] = index()
    return texts


def index() -> str:
    """The table of all environments."""
    lines = ["# Environments", "", "| id | in a line | `make_vec` |", "|---|---|---|"]
    for env_id, entry in ENVIRONMENTS.items():
        vector = "native" if "vector_entry_point" in entry else "Gymnasium's own"
        lines.append(f"| [{env_id}]({env_id}.md) | {_docstring(env_id).splitlines()[0]} | {vector} |")
    return "\n".join([*lines, ""])


def page(env_id: str) -> str:
    """One environment's page."""
    headline, _, body = _docstring(env_id).partition("\n")
    env: Any = gym.make(env_id).unwrapped
    facts = [
        "| | |",
        "|---|---|",
        f'| make | `gym.make("{env_id}")` after `import servotrack` |',
        f"| action space | {_space(env.action_space)} |",
        *_space_rows(env.observation_space),
        f"| render modes | {', '.join(f'`{mode}`' for mode in env.metadata['render_modes'])} |",
    ]
    parts = [f"# {env_id}", headline, "\n".join(facts), _linked(body.strip(), env_id)]
    config = getattr(env, "config", None)
    env.close()
    if dataclasses.is_dataclass(config):
        parts.append(_ladder(env_id, type(config)))
    return "\n\n".join(parts) + "\n"


def _docstring(env_id: str) -> str:
    module, _, name = ENVIRONMENTS[env_id]["entry_point"].partition(":")
    return inspect.cleandoc(getattr(importlib.import_module(module), name).__doc__)


def _space_rows(space: gym.Space[Any]) -> list[str]:
    if not isinstance(space, gym.spaces.Dict):
        return [f"| observation space | {_space(space)} |"]
    return [f"| observation `{key}` | {_space(part)} |" for key, part in space.items()]


def _space(space: gym.Space[Any]) -> str:
    if not isinstance(space, gym.spaces.Box):
        return f"`{space}`"
    bounds = f"{space.low.min():.6g}, {space.high.max():.6g}"
    return f"`Box({bounds}, {space.shape}, {space.dtype})`"


def _linked(body: str, env_id: str) -> str:
    """The text with every other environment's id made a link to its page; code blocks and calls stay as they are."""
    for other in ENVIRONMENTS:
        if other != env_id:
            body = body.replace(f"`{other}`", f"[`{other}`]({other}.md)")
    return body


def _ladder(env_id: str, config_type: type) -> str:
    """Every keyword with its meaning and its value at each level; a dot where a level changes nothing."""
    meanings, configs = _attributes(config_type), _configs(env_id)
    if len(configs) == 1:
        lines = ["## Keywords", "", "| keyword | meaning | default |", "|---|---|---|"]
    else:
        lines = [
            "## Keywords and their value at each level",
            "",
            "A dot: as at the level before.",
            "",
            "| keyword | meaning | " + " | ".join(map(str, range(len(configs)))) + " |",
            "|---|---|" + "---|" * len(configs),
        ]
    for field in dataclasses.fields(config_type):
        values = [_shown(getattr(config, field.name)) for config in configs]
        cells = [values[0]] + [now if now != before else "·" for before, now in itertools.pairwise(values)]
        lines.append(f"| `{field.name}` | {meanings[field.name]} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _configs(env_id: str) -> list[Any]:
    """The configuration at every level; one where there are no levels."""
    configs: list[Any] = []
    for level in itertools.count():
        try:
            env: Any = gym.make(env_id, level=level).unwrapped
        except ValueError:
            break
        except TypeError:
            env = gym.make(env_id).unwrapped
        configs.append(env.config)
        env.close()
        if not hasattr(env, "level"):
            break
    return configs


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        low, high = value
        return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value}".lower() if isinstance(value, bool) else f"{value}"


def _attributes(documented: type) -> dict[str, str]:
    """The sections `Attributes:` of a class and its bases, in the Google style: name to text."""
    meanings: dict[str, str] = {}
    for part in reversed(documented.__mro__):
        section = inspect.cleandoc(part.__doc__ or "").partition("Attributes:\n")[2]
        entries = re.findall(r"^ {4}(\w+): (.*?)(?=^ {4}\w|\Z)", section, re.MULTILINE | re.DOTALL)
        meanings |= {name: " ".join(text.split()) for name, text in entries}
    return meanings


def draw(picture: Picture) -> None:
    """Write a picture of an agent at work, some steps into a train seed."""
    env = gym.make(picture.env_id, render_mode="rgb_array", **picture.arguments)
    agent = create_agent(picture.agent, env)
    observation, _ = env.reset(seed=0)
    state: Any = None
    for _ in range(picture.steps):
        action, state = agent.predict(observation, state)
        show_belief(env, state)
        observation, *_ = env.step(action)
    frame: Any = env.render()
    env.close()
    IMAGES.mkdir(exist_ok=True)
    cv2.imwrite(str(IMAGES / picture.name), frame[..., ::-1])


def main() -> int:
    """Write or check the pages; the exit status is the number of stale ones, at most 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only compare")
    check = parser.parse_args().check
    texts = pages()
    stale = [path for path, text in texts.items() if not path.is_file() or path.read_text(encoding="utf-8") != text]
    stale += [path for path in FOLDER.glob("*.md") if path not in texts]
    for path in stale:
        print(f"{'stale' if check else 'wrote'}: {path}")
        if not check:
            FOLDER.mkdir(exist_ok=True)
            path.write_text(texts[path], encoding="utf-8") if path in texts else path.unlink()
    if not check:
        for picture in PICTURES:
            draw(picture)
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
