"""Agents in published scenarios of points in clutter, by the metric that the publication uses.

`scripts/published-scenarios` runs this module.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servotrack.baselines.agents.clutter.catalog import SMOOTHER
from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.evaluation.statistics import Interval, bootstrap_mean
from servotrack.baselines.leaderboard.exact_filter import ENV_ID
from servotrack.baselines.reporting.embed import embed
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

_UNREAD = "not compared: the article was not at hand"

Sets = tuple[list[Array], list[Array]]
"""True and reported positions at each scan of an episode. Shapes (n, 2) and (k, 2), m."""


@dataclass(frozen=True)
class PublishedMetric:
    """A metric of a publication.

    Attributes:
        title: Name, with unit and parameters.
        of_episode: Function that returns its value in one episode.
        squared: True if `of_episode` returns a mean of squares, of which the root over all episodes is shown.
        published: Figure of the publication, or the reason why there is none.
    """

    title: str
    of_episode: Callable[[Sets], float]
    squared: bool = False
    published: str = _UNREAD


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


METRICS: Mapping[str, PublishedMetric] = {
    "paper": PublishedMetric(
        "OSPA (c = 100 m)", mean_ospa(100.0), published="lost: the numbers of table 1 are not in the copy at hand"
    ),
    "vo-ma-2006": PublishedMetric("CPEP (20 m)", circular_error_probability),
    "williams-2015": PublishedMetric("OSPA (c = 20 m)", mean_ospa(20.0)),
    "garcia-fernandez-2018": PublishedMetric("RMS GOSPA (c = 10 m, p = 2)", _squared_gospa, True),
    "pinto-2021": PublishedMetric("GOSPA of scan 20 (c = 2 m)", _last_gospa),
}
"""Metric of each published scenario."""


def play(scenario: str, agent: str, seeds: Sequence[int]) -> list[Sets]:
    """Play episodes, and return what was true and what was reported.

    Args:
        scenario: Published scenario.
        agent: Registered name. The smoother answers `LAG` scans late.
        seeds: Seeds of the episodes.
    """
    card, lag = agent_card(agent), LAG if agent == SMOOTHER else 0
    env = make_vector(ENV_ID, len(seeds), {"scenario": scenario, "lag": lag}, privileged=card.privileged)
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


def table(seeds: Sequence[int]) -> Grid:
    """Return the agents' scores in all published scenarios."""
    rows = []
    for scenario, metric in METRICS.items():
        for agent in AGENTS:
            value, number = score(metric, play(scenario, agent, seeds))
            name = f"{agent}, {LAG} scans late" if agent == SMOOTHER else agent
            rows.append([scenario, metric.title, name, _shown(value), _shown(number)])
    return Grid(["scenario", "metric", "agent", "value", "error of the number"], rows, words=3)


def _shown(interval: Interval) -> str:
    return f"{interval.value:.3g} [{interval.low:.3g}, {interval.high:.3g}]"


def sources() -> Grid:
    """Return the source of each scenario and the figure that it publishes."""
    rows = [
        [name, SCENARIOS[name].source, SCENARIOS[name].differences or "none known", metric.published]
        for name, metric in METRICS.items()
    ]
    return Grid(["scenario", "source", "what differs here", "published figure"], rows, words=4)


def main(arguments: Sequence[str] | None = None) -> None:
    """Play all scenarios, print the tables and put them into the page `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/published-scenarios", description=__doc__)
    parser.add_argument("--episodes", type=int, default=100, help="test seeds of each scenario (default 100)")
    parser.add_argument("--write", type=Path, help="page with the marks scenarios:begin and :end")
    given = parser.parse_args(arguments)
    if given.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {given.episodes}")
    with program("nothing is written; run the same command again"):
        seeds = take("test", given.episodes, FIRST)
        note = (
            f"{given.episodes} test seeds each ({seeds[0]} to {seeds[-1]}), with 95 % bootstrap intervals. Written by "
            f"`scripts/published-scenarios --episodes {given.episodes}`, servotrack {code_version()}."
        )
        text = "\n\n".join([as_markdown(sources()), as_markdown(table(seeds)), note])
        print(text)
        if given.write:
            embed(text, given.write, "scenarios")


if __name__ == "__main__":
    main()
