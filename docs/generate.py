"""Write a page per environment from its docstring, its spaces and its configuration, and an index of them.

`python docs/generate.py` writes the pages. With `--pictures` it also draws the pictures and animations of the
environments, which takes some minutes. With `--check` it writes nothing and exits with 1 if a page is stale.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
import itertools
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import gymnasium as gym
from PIL import Image

from servotrack.baselines import create_agent
from servotrack.baselines.agents.people.catalog import create_tracker
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.evaluation.evaluate import make_single, show_belief
from servotrack.baselines.track_command.counts import Counter, parse_places
from servotrack.baselines.track_command.opening import SourceRequest, open_input, working_size
from servotrack.baselines.track_command.painter import BoxPainter
from servotrack.baselines.track_command.rendered import render_sequence
from servotrack.baselines.track_command.timed import TimedTracker, estimates
from servotrack.envs.arguments import RENDER_MODES
from servotrack.envs.registration import ENVIRONMENTS

FOLDER = Path(__file__).parent / "environments"
IMAGES = Path(__file__).parent / "images"
ANIMATION_WIDTH = 520
"""Width of an animation, px. Wider animations make larger files."""
ANIMATION_QUALITY = 40
"""Quality of an animation's frames, 0 to 100."""


class Picture(NamedTuple):
    """Picture for the README and the guides: an agent in an environment, some steps into a train seed.

    Attributes:
        name: File name.
        env_id: Gymnasium id.
        arguments: Keyword arguments of the environment.
        agent: Name of the agent.
        steps: Steps before the picture is taken.
    """

    name: str
    env_id: str
    arguments: dict[str, Any]
    agent: str
    steps: int


class Animation(NamedTuple):
    """Animation for an environment's page: a reference agent at work on train seed 0.

    Attributes:
        arguments: Keyword arguments of the environment.
        agent: Name of the agent.
        first: Steps before the animation begins.
        frames: Number of frames.
        every: Steps per frame; larger values show a longer part of the episode.
        duration: Time per frame, ms.
    """

    arguments: dict[str, Any]
    agent: str
    first: int = 0
    frames: int = 60
    every: int = 2
    duration: int = 100


PICTURES = (
    Picture("servo.png", "UncalibServo-v0", {"level": 3}, "lifted-kf", 160),
    Picture("pedestrian-servo.png", "PedestrianServo-v0", {"level": 2, "lamps": 2, "umbrellas": 1}, "crowd-servo", 70),
    Picture("clutter-tracking.png", "ClutterTracking-v0", {}, "pmb", 88),
    Picture("pedestrians.png", "PedestrianTracking-v0", {"level": 1}, "pmb", 150),
    Picture("sonar.png", "SonarTracking-v0", {"level": 3}, "hmm-row", 184),
    Picture("color-tracking.png", "ColorTracking-v0", {"level": 2}, "monte-carlo-color", 120),
)

COUNTED_FRAMES = 200
"""Frames of the picture of counts."""

ANIMATIONS = {
    "UncalibServo-v0": Animation({"level": 3}, "lifted-kf", frames=72),
    "UncalibServoReach-v0": Animation({"level": 3}, "lifted-kf", frames=50, every=2),
    "UncalibServoPixels-v0": Animation({"level": 3}, "lifted-kf", frames=72),
    "UncalibServo3D-v0": Animation({"level": 3, "arm": "so101"}, "any-arm", frames=60),
    "PedestrianServo-v0": Animation({"level": 2}, "crowd-servo", frames=50),
    "ClutterTracking-v0": Animation({}, "pmb", first=20, frames=60, every=1, duration=120),
    "RecordedPoints-v0": Animation({"lag": 8}, "trajectory-pmb", frames=50, every=1, duration=150),
    "PedestrianTracking-v0": Animation({"level": 1}, "pmb", first=40, frames=40, every=5, duration=160),
    "ColorTracking-v0": Animation({"level": 2}, "monte-carlo-color-plus", frames=60, every=3, duration=120),
    "SonarTracking-v0": Animation({"level": 1}, "hmm-row", frames=58, every=1, duration=150),
    "VideoTracking-v0": Animation({}, "pmb", frames=29, every=2, duration=120),
}
"""One per environment."""


def pages() -> dict[Path, str]:
    """Return the text of every generated file."""
    texts = {FOLDER / f"{env_id}.md": page(env_id) for env_id in ENVIRONMENTS}
    texts[FOLDER / "index.md"] = index()
    return texts


def index() -> str:
    """Return the page with the table of all environments."""
    lines = [
        "# Environments",
        "",
        "Environments of servoing move an arm; environments of tracking expect the set of targets as the action.",
        "`make_vec` says whether an environment has a vector environment of its own, which gives the same episodes.",
        "",
        "| id | summary | `make_vec` |",
        "|---|---|---|",
    ]
    for env_id, entry in ENVIRONMENTS.items():
        vector = "native" if "vector_entry_point" in entry else "Gymnasium's own"
        lines.append(f"| [{env_id}]({env_id}.md) | {_docstring(env_id).splitlines()[0]} | {vector} |")
    return "\n".join([*lines, ""])


def page(env_id: str) -> str:
    """Return the page of one environment."""
    headline, _, body = _docstring(env_id).partition("\n")
    env: Any = gym.make(env_id).unwrapped
    facts = [
        "| property | value |",
        "|---|---|",
        f'| make | `gym.make("{env_id}")` after `import servotrack` |',
        f"| action space | {_space(env.action_space)} |",
        *_space_rows(env.observation_space),
        f"| render modes | {', '.join(f'`{mode}`' for mode in RENDER_MODES)} |",
    ]
    parts = [f"# {env_id}", headline, _animated(env_id), "\n".join(facts), _linked(body.strip(), env_id)]
    config = getattr(env, "config", None)
    env.close()
    if dataclasses.is_dataclass(config):
        parts.append(_ladder(env_id, type(config)))
    return "\n\n".join(parts) + "\n"


def _animated(env_id: str) -> str:
    animation = ANIMATIONS[env_id]
    made = "".join(f" with `{name}={value!r}`" for name, value in animation.arguments.items())
    return (
        f"![Animation of the agent {animation.agent} in {env_id}](../images/environments/{env_id}.webp)\n\n"
        f"*Agent `{animation.agent}`{made}, seed 0.*"
    )


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
    """Return the text with every other environment's id as a link to its page; code and calls stay as they are."""
    for other in ENVIRONMENTS:
        if other != env_id:
            body = body.replace(f"`{other}`", f"[`{other}`]({other}.md)")
    return body


def _ladder(env_id: str, config_type: type) -> str:
    """Return the table of keywords: meaning and value at each level, with a dot where a level changes nothing."""
    meanings, configs = _attributes(config_type), _configs(env_id)
    if len(configs) == 1:
        lines = ["## Keywords", "", "| keyword | meaning | default |", "|---|---|---|"]
    else:
        lines = [
            "## Keywords and their value at each level",
            "",
            "A dot stands for the value of the level before.",
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
    """Return the configuration at every level; one configuration for an environment without levels."""
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
    """Return the entries of the sections `Attributes:` of a class and its bases, keyed by name."""
    meanings: dict[str, str] = {}
    for part in reversed(documented.__mro__):
        section = inspect.cleandoc(part.__doc__ or "").partition("Attributes:\n")[2]
        entries = re.findall(r"^ {4}(\w+): (.*?)(?=^ {4}\w|\Z)", section, re.MULTILINE | re.DOTALL)
        meanings |= {name: " ".join(text.split()) for name, text in entries}
    return meanings


def _frames(env_id: str, arguments: dict[str, Any], agent_name: str) -> Iterator[Any]:
    """Yield the rendered frame after every step of an agent on train seed 0."""
    arguments = {"render_mode": "rgb_array", **arguments}
    env: Any = make_single(env_id, arguments, privileged=agent_card(agent_name).privileged)
    agent = create_agent(agent_name, env)
    observation, _ = env.reset(seed=0)
    state: Any = None
    over = False
    while not over:
        action, state = agent.predict(observation, state)
        show_belief(env, state)
        observation, _, terminated, truncated, _ = env.step(action)
        over = bool(terminated or truncated)
        yield env.render()
    env.close()


def draw(picture: Picture) -> None:
    """Write a picture."""
    frames = _frames(picture.env_id, picture.arguments, picture.agent)
    frame = next(itertools.islice(frames, picture.steps - 1, None))
    cv2.imwrite(str(IMAGES / picture.name), frame[..., ::-1])


def draw_counts() -> None:
    """Write the picture of zones and lines with their counts: people of a rendered scene."""
    places = parse_places(["square=120,150,250,150,300,270,90,270"], ["path=300,288,240,60"])
    counter = Counter(places)
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        render_sequence(scene, {"level": 1}, 0, lambda left: None)
        source, _ = open_input(SourceRequest(str(scene), frames=COUNTED_FRAMES))
        assert source.source_size is not None
        tracker = TimedTracker(create_tracker("pmb", working_size(source), source.frame_rate), source.frame_rate)
        painter = BoxPainter(source.source_size, counter=counter)
        for step, estimate in estimates(source, tracker):
            counter.step(step.number, estimate)
            frame = painter(step, estimate)
    cv2.imwrite(str(IMAGES / "counts.png"), frame[..., ::-1])


def animate(env_id: str, animation: Animation) -> Path:
    """Write an animation as a looping WebP file and return its path."""
    end = animation.first + animation.frames * animation.every
    images = []
    for frame in itertools.islice(
        _frames(env_id, animation.arguments, animation.agent), animation.first, end, animation.every
    ):
        height = round(frame.shape[0] * ANIMATION_WIDTH / frame.shape[1])
        small = cv2.resize(frame, (ANIMATION_WIDTH, height), interpolation=cv2.INTER_AREA)
        images.append(Image.fromarray(small))
    path = IMAGES / "environments" / f"{env_id}.webp"
    path.parent.mkdir(exist_ok=True)
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=animation.duration,
        loop=0,
        quality=ANIMATION_QUALITY,
        method=6,
    )
    return path


def main() -> int:
    """Write or check the pages. Returns 1 if `--check` finds a stale page, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare only")
    parser.add_argument("--pictures", action="store_true", help="also draw pictures and animations")
    parser.add_argument("--only", metavar="ID", help="draw only the animation of this environment")
    arguments = parser.parse_args()
    check = arguments.check
    texts = pages()
    stale = [path for path, text in texts.items() if not path.is_file() or path.read_text(encoding="utf-8") != text]
    stale += [path for path in FOLDER.glob("*.md") if path not in texts]
    for path in stale:
        print(f"{'stale' if check else 'wrote'}: {path}")
        if not check:
            FOLDER.mkdir(exist_ok=True)
            path.write_text(texts[path], encoding="utf-8") if path in texts else path.unlink()
    if arguments.pictures and not check:
        for env_id, animation in ANIMATIONS.items():
            if arguments.only in (None, env_id):
                path = animate(env_id, animation)
                print(f"wrote: {path} ({path.stat().st_size / 1e3:.0f} kB)")
        for picture in PICTURES if arguments.only is None else ():
            draw(picture)
        if arguments.only is None:
            draw_counts()
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
