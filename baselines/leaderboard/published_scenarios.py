"""Agents in published scenarios of points in clutter, by the metric that the publication uses.

`scripts/published-scenarios` runs this module.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from servotrack.baselines.agents.clutter.catalog import SMOOTHER
from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.evaluation.statistics import Interval, bootstrap_mean
from servotrack.baselines.leaderboard.exact_filter import ENV_ID
from servotrack.baselines.leaderboard.meyer_scene import (
    MEYER_DIFFERENCES,
    MEYER_FILTERS,
    MEYER_SOURCE,
    meyer_scene,
    tracked,
)
from servotrack.baselines.reporting.embed import show
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.running.stopping import program
from servotrack.envs.track.clutter.scenarios import SCENARIOS
from servotrack.envs.track.scoring import REPORTED_FROM
from servotrack.estimators.metrics import gospa, ospa
from servotrack.estimators.types import Array

AGENTS = ("gm-phd", "gm-cbmember", "pmb", "pmbm", SMOOTHER, "association-oracle")
LAG = 10
"""Delay of the smoother's answers, scans."""
FIRST = 300_000
"""Offset of the seeds in the test range."""

_UNREAD = "not found: only the abstract of the article was at hand"
_NO_FIGURE = "none: {} shows one run"

Sets = tuple[list[Array], list[Array]]
"""True and reported positions at each scan of an episode. Shapes (n, 2) and (k, 2), m."""


@dataclass(frozen=True)
class PublishedMetric:
    """A metric of a publication.

    Attributes:
        title: Name, with unit and parameters.
        of_episode: Function that returns its value in one episode.
        squared: True if `of_episode` returns a mean of squares, of which the root over all episodes is shown.
        published: Source of the publication's figures, or the reason why there are none.
        figures: Value and error of the number of targets that the publication gives for an agent's filter.
    """

    title: str
    of_episode: Callable[[Sets], float]
    squared: bool = False
    published: str = _UNREAD
    figures: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def mean_ospa(cutoff: float) -> Callable[[Sets], float]:
    """Return the function of an episode's mean OSPA of order 1."""
    return lambda sets: float(np.mean([ospa(a, b, cutoff) for a, b in zip(*sets, strict=True)]))


def _squared_gospa(sets: Sets) -> float:
    return float(np.mean([gospa(a, b, 10.0, order=2.0).total ** 2 for a, b in zip(*sets, strict=True)]))


def _last_gospa(sets: Sets) -> float:
    return float(gospa(sets[0][-1], sets[1][-1], 2.0, order=1.0).total)


def circular_error_probability(sets: Sets, radius: float = 20.0) -> float:
    """Mean share of the true targets without an estimate within `radius` m (Vo and Ma 2006, section IV)."""
    shares = []
    for truth, estimates in zip(*sets, strict=True):
        if len(truth):
            distance = np.linalg.norm(truth[:, None] - estimates[None], axis=-1)
            shares.append(float(np.mean(~(distance < radius).any(axis=1))))
    return float(np.mean(shares))


MEYER = "meyer-2018"
"""Scenario with two sensors at once, which the environment does not play."""

METRICS: Mapping[str, PublishedMetric] = {
    "paper": PublishedMetric(
        "OSPA (c = 100 m)", mean_ospa(100.0), published="lost: the numbers of table 1 are not in the copy at hand"
    ),
    "vo-demo": PublishedMetric("OSPA (c = 100 m)", mean_ospa(100.0), published=_NO_FIGURE.format("the code")),
    "vo-ma-2006": PublishedMetric(
        "CPEP (20 m)", circular_error_probability, published=_NO_FIGURE.format("the article")
    ),
    "vo-ma-2006-pair": PublishedMetric(
        "CPEP (20 m)",
        circular_error_probability,
        published="figure 4, read from its vector graphics at 12.5e-6 false measurements per m^2",
        figures={"gm-phd": (0.0752, 0.2855)},
    ),
    "williams-2015": PublishedMetric("OSPA (c = 20 m)", mean_ospa(20.0)),
    "garcia-fernandez-2018": PublishedMetric("RMS GOSPA (c = 10 m, p = 2)", _squared_gospa, True),
    "pinto-2021": PublishedMetric("GOSPA of scan 20 (c = 2 m)", _last_gospa),
    MEYER: PublishedMetric("OSPA (c = 100 m, ours)", mean_ospa(100.0)),
}
"""Metric of each published scenario."""

VO_MA_CURVES = (
    (0.0, 0.98, 0.0477, 0.0432, 0.0314),
    (50.0, 0.98, 0.0752, 0.2855, 0.0449),
    (100.0, 0.98, 0.0926, 0.4100, 0.0578),
    (150.0, 0.98, 0.1144, 0.5048, 0.0690),
    (200.0, 0.98, 0.1397, 0.5659, 0.0931),
    (250.0, 0.98, 0.1660, 0.6063, 0.1116),
    (300.0, 0.98, 0.1974, 0.6422, 0.1357),
    (350.0, 0.98, 0.2260, 0.6663, 0.1677),
    (400.0, 0.98, 0.2552, 0.6882, 0.1941),
    (50.0, 0.70, 0.3904, 0.7420, 0.2008),
    (50.0, 0.75, 0.3315, 0.6533, 0.1537),
    (50.0, 0.80, 0.2737, 0.5653, 0.1239),
    (50.0, 0.85, 0.2165, 0.4812, 0.0982),
    (50.0, 0.90, 0.1643, 0.4089, 0.0797),
    (50.0, 0.95, 0.1189, 0.3443, 0.0527),
    (50.0, 1.00, 0.0381, 0.2344, 0.0342),
)
"""Curves of Vo and Ma 2006, figures 4 and 5, from the coordinates in their vector graphics: clutter rate, detection
probability, CPEP and error of the number of their GM-PHD filter, CPEP of their JPDA filter."""


def play(scenario: str, agent: str, seeds: Sequence[int], **axes: float) -> list[Sets]:
    """Play episodes, and return what was true and what was reported.

    Args:
        scenario: Published scenario.
        agent: Registered name. The smoother answers `LAG` scans late.
        seeds: Seeds of the episodes.
        **axes: Parameters of the environment that differ from the scenario's.
    """
    card, lag = agent_card(agent), LAG if agent == SMOOTHER else 0
    env = make_vector(ENV_ID, len(seeds), {"scenario": scenario, "lag": lag, **axes}, privileged=card.privileged)
    try:
        observer = create_agent(card, env)
        observation, info = env.reset(seed=list(seeds))
        state, starts = None, np.ones(len(seeds), np.bool_)
        truths: list[tuple[Array, Array]] = []
        found: list[Sets] = [([], []) for _ in seeds]
        for step in range(env.unwrapped.world.episode_steps):
            truths.append((info["truth"]["states"][..., [0, 2]], info["truth"]["exists"]))
            answer, state = observer.predict(observation, state=state, episode_start=starts, deterministic=True)
            starts = np.zeros(len(seeds), np.bool_)
            if step >= lag:
                positions, exists = truths[step - lag]
                for row, (true, reported) in enumerate(found):
                    true.append(positions[row][exists[row]])
                    reported.append(answer[row, answer[row, :, 0] >= REPORTED_FROM, 1:])
            observation, _, _, _, info = env.step(answer)
        return found
    finally:
        env.close()


def score(metric: PublishedMetric, episodes: Sequence[Sets]) -> tuple[Interval, Interval]:
    """Return a publication's metric, and the mean absolute error of the number of targets, over episodes."""
    value = bootstrap_mean([metric.of_episode(sets) for sets in episodes])
    if metric.squared:
        value = Interval(*np.sqrt(value).tolist())
    wrong = [np.mean([abs(len(a) - len(b)) for a, b in zip(*sets, strict=True)]) for sets in episodes]
    return value, bootstrap_mean(wrong)


def table(scenario: str, seeds: Sequence[int]) -> Grid:
    """Return the scores of agents or filters in a published scenario, beside the figures of the publication."""
    metric = METRICS[scenario]
    if scenario == MEYER:
        scenes = [meyer_scene(seed) for seed in seeds]
        found = ((name, [tracked(scene, make) for scene in scenes]) for name, make in MEYER_FILTERS.items())
    else:
        found = ((agent, play(scenario, agent, seeds)) for agent in AGENTS)
    rows = [_compared(metric, name, *score(metric, episodes)) for name, episodes in found]
    columns = ["published value", "error of the number", "published error"]
    return Grid(["agent", metric.title, *columns], rows, words=1)


def _compared(metric: PublishedMetric, agent: str, value: Interval, number: Interval) -> list[str]:
    """Return an agent's name, and its scores beside the published ones."""
    published = [f"{figure:.3g}" for figure in metric.figures.get(agent, ())] or ["", ""]
    name = f"{agent}, {LAG} scans late" if agent == SMOOTHER else agent
    return [name, _shown(value), published[0], _shown(number), published[1]]


def vo_ma_curves(seeds: Sequence[int]) -> Grid:
    """Return the curves of Vo and Ma's example 2 beside those of this package's filters."""
    rows = []
    for clutter, detection, cpep, number, knowing in VO_MA_CURVES:
        axes = {"clutter_rate": clutter, "detection_probability": detection}
        metric = METRICS["vo-ma-2006-pair"]
        phd = score(metric, play("vo-ma-2006-pair", "gm-phd", seeds, **axes))
        pmb = score(metric, play("vo-ma-2006-pair", "pmb", seeds, **axes))
        cells = [f"{cpep:.3f}", _shown(phd[0]), f"{number:.3f}", _shown(phd[1]), f"{knowing:.3f}", _shown(pmb[0])]
        rows.append([f"{clutter:g}", f"{detection:g}", *cells, _shown(pmb[1])])
    heads = ["article's GM-PHD, CPEP", "gm-phd, CPEP", "article's GM-PHD, number", "gm-phd, number"]
    heads += ["article's JPDA (knows the number), CPEP", "pmb, CPEP", "pmb, number"]
    return Grid(["clutter rate", "p_D", *heads], rows, words=0)


def _shown(interval: Interval) -> str:
    return f"{interval.value:.3g} [{interval.low:.3g}, {interval.high:.3g}]"


def sources() -> Grid:
    """Return the source of each scenario and the figure that it publishes."""
    rows = []
    for name, metric in METRICS.items():
        known = SCENARIOS.get(name)
        source = (MEYER_SOURCE, MEYER_DIFFERENCES) if known is None else (known.source, known.differences)
        rows.append([name, source[0], source[1] or "none known", metric.published])
    return Grid(["scenario", "source", "what differs here", "published figure"], rows, words=4)


def main(arguments: Sequence[str] | None = None) -> None:
    """Play scenarios, print their tables and put them into the page `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/published-scenarios", description=__doc__)
    parser.add_argument("--episodes", type=int, default=100, help="test seeds of each scenario (default 100)")
    parser.add_argument("--scenarios", help="scenarios by commas (default: all)")
    parser.add_argument("--write", type=Path, help="page with the marks scenarios:begin, scenarios-NAME:begin and :end")
    given = parser.parse_args(arguments)
    if given.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {given.episodes}")
    chosen = given.scenarios.split(",") if given.scenarios else list(METRICS)
    for name in chosen:
        if name not in METRICS:
            parser.error(f"--scenarios must be of {', '.join(METRICS)}, got {name!r}")
    with program("tables of finished scenarios are written; run the same command for the others"):
        seeds = take("test", given.episodes, FIRST)
        show(as_markdown(sources()), given.write, "scenarios")
        for name in chosen:
            grids = [table(name, seeds), *([vo_ma_curves(seeds)] if name == "vo-ma-2006-pair" else [])]
            source = f"`scripts/published-scenarios --episodes {given.episodes} --scenarios {name}`"
            note = f"{given.episodes} test seeds, 95 % bootstrap intervals. Written by {source}, {code_version()}."
            show("\n\n".join([*(as_markdown(grid) for grid in grids), note]), given.write, f"scenarios-{name}")


if __name__ == "__main__":
    main()
