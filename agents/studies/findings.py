"""What the results of a study say, as numbers: scores by run, means, pairs, headroom, times."""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from agents.studies.estimators import (
    RESAMPLES,
    Runs,
    bootstrapped,
    gain,
    gain_with_t_interval,
    interquartile_mean,
    mean,
    mean_with_t_interval,
    probability_of_improvement,
    share_of_headroom,
)
from agents.studies.plan import Study, is_constant
from agents.studies.results import Result
from agents.summaries import NEARLY_CONSTANT, reports_only_events, wilson_interval
from envs.drivers.planner import ORACLE, PLANNER, is_planner, planner_checkpoint
from predictor.evaluation.standard_errors import Estimate


class Line(NamedTuple):
    """Line of a table: an arm under an algorithm, or a driver."""

    arm: str
    """Name of the arm or driver."""
    algorithm: str | None
    """Learning algorithm; None for a driver."""


class Pair(NamedTuple):
    """Comparison of two arms under one algorithm."""

    ours: Line
    """Arm that is compared."""
    rival: Line
    """Arm that it is compared with."""
    probability: Estimate
    """Probability of improvement."""
    gain: Estimate
    """Difference of the mean scores."""


@dataclass(frozen=True)
class Findings:
    """Results of a study, with the numbers that its report shows.

    Each interval has its own generator, seeded by what it is about: another arm or scenario in the study changes none.
    """

    study: Study
    """The study."""
    results: Mapping[tuple[str, Line], Sequence[Result]]
    """Results by scenario and line, in the order of the seeds."""
    resamples: int = RESAMPLES
    """Number of draws of each bootstrap."""

    @classmethod
    def of(cls, study: Study, results: Sequence[Result], resamples: int = RESAMPLES) -> "Findings":
        """Sorts results by scenario and line."""
        found: dict[tuple[str, Line], list[Result]] = {}
        for result in results:
            found.setdefault((result.scenario, Line(result.arm, result.algorithm)), []).append(result)
        return cls(study, found, resamples)

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Names of the scenarios with results."""
        return tuple(dict.fromkeys(scenario for scenario, _ in self.results))

    def lines(self, scenario: str | None = None, trained: bool | None = None) -> tuple[Line, ...]:
        """Returns the lines of a scenario, or of all; arms alone (`trained`), drivers alone (False), or both (None)."""
        found = (line for name, line in self.results if scenario in (None, name))
        return tuple(dict.fromkeys(x for x in found if trained in (None, x.algorithm is not None)))

    def label(self, line: Line) -> str:
        """Returns the name of a line in tables; it has the algorithm where the study has several."""
        several = line.algorithm is not None and len(self.study.algorithms) > 1
        return f"{line.arm} ({line.algorithm})" if several else line.arm

    def runs(self, scenario: str, line: Line) -> Float[np.ndarray, " runs"]:
        """Returns the score of each run: the mean return over its test episodes."""
        return np.array([np.mean(column(r, "episode_return")) for r in self.results[scenario, line]])

    def mean_return(self, scenario: str, line: Line) -> Estimate:
        """Returns the mean return with its interval over runs; that of a driver is over episodes."""
        if line.algorithm is None:
            return mean_with_t_interval(column(self.results[scenario, line][0], "episode_return"))
        return mean_with_t_interval(self.runs(scenario, line))

    def middle_return(self, scenario: str, line: Line) -> Estimate:
        """Returns the interquartile mean over runs with its bootstrap interval."""
        runs = [self.runs(scenario, line)]
        return self.estimate(interquartile_mean, runs, about=("iqm", scenario, *line))

    def crash_rate(self, scenario: str, line: Line) -> Estimate | None:
        """Returns the share of test episodes with a crash and its bootstrap interval over runs; None if not reported.

        The interval of a driver is Wilson's, over its episodes.
        """
        crashed = [_crashed(r) for r in self.results[scenario, line]]
        if all(each is None for run in crashed for each in run) and not self._silence_is_safe(scenario):
            return None
        reported = [np.array([bool(each) for each in run], dtype=np.float64) for run in crashed]
        if line.algorithm is None:
            return Estimate(mean(reported), wilson_interval(int(reported[0].sum()), len(reported[0])))
        rates = np.array([np.mean(found) for found in reported])
        return self.estimate(mean, [rates], about=("crashes", scenario, *line))

    def _silence_is_safe(self, scenario: str) -> bool:
        lines = (results for (name, _), results in self.results.items() if name == scenario)
        return reports_only_events(crashed for results in lines for r in results for crashed in _crashed(r))

    def mean_of(self, scenario: str, line: Line, field: str) -> float:
        """Returns the mean of a field over all episodes of all runs; NaN if it is not reported."""
        values = np.concatenate([column(r, field) for r in self.results[scenario, line]])
        return float(np.mean(values)) if len(values) else float("nan")

    def constant_runs(self, scenario: str, line: Line) -> Counter[str]:
        """Returns how many runs (nearly) always take one action, by the name of the action."""
        found: Counter[str] = Counter()
        for result in self.results[scenario, line]:
            counts = sum((Counter(e.get("action_counts") or {}) for e in result.episodes), Counter[str]())
            action, taken = next(iter(counts.most_common(1)), ("", 0))
            if taken and taken >= NEARLY_CONSTANT * counts.total():
                found[action] += 1
        return found

    def estimate(self, statistic: Callable[..., float], *samples: Runs, about: Sequence[str | None]) -> Estimate:
        """Returns a statistic of samples with its bootstrap interval; `about` names what it is, and seeds the draws."""
        return bootstrapped(statistic, *samples, generator=generator_of(*about), resamples=self.resamples)

    def pairs(self, scenarios: Sequence[str]) -> list[Pair]:
        """Compares every arm with every rival, under each algorithm, over scenarios in which both have results.

        Two rivals are compared once, with the one that comes first. Over several scenarios scores are rescaled
        (`scaled_runs`); over one they are returns.
        """
        found: list[Pair] = []
        for place, rival in enumerate(self.study.compared_with):
            for ours in self.lines(trained=True):
                other = Line(rival, ours.algorithm)
                done = ours.arm in self.study.compared_with[: place + 1]
                if not done and all((s, x) in self.results for s in scenarios for x in (ours, other)):
                    found.append(self._pair(ours, other, scenarios))
        return found

    def _pair(self, ours: Line, rival: Line, scenarios: Sequence[str]) -> Pair:
        runs = self.scaled_runs if len(scenarios) > 1 else self.raw_runs
        samples = (runs(ours, scenarios), runs(rival, scenarios))
        about = (*scenarios, *ours, *rival)
        probability = self.estimate(probability_of_improvement, *samples, about=("probability", *about))
        if len(scenarios) == 1:
            return Pair(ours, rival, probability, gain_with_t_interval(samples[0][0], samples[1][0]))
        return Pair(ours, rival, probability, self.estimate(gain, *samples, about=("gain", *about)))

    def raw_runs(self, line: Line, scenarios: Sequence[str]) -> Runs:
        """Returns the scores of a line's runs in each scenario."""
        return [self.runs(scenario, line) for scenario in scenarios]

    def scaled_runs(self, line: Line, scenarios: Sequence[str]) -> Runs:
        """Returns scores of which 0 is the lowest and 1 the highest mean of any line of the scenario."""
        scaled = []
        for scenario in scenarios:
            means = [self.mean_return(scenario, other).value for other in self.lines(scenario)]
            low, width = min(means), (max(means) - min(means)) or 1.0
            scaled.append((self.runs(scenario, line) - low) / width)
        return scaled

    def even_runs(self, line: Line) -> Runs:
        """Returns rescaled scores of as many runs of each scenario, the first ones, so that all weigh the same."""
        scaled = self.scaled_runs(line, self.scenarios)
        return [scores[: min(map(len, scaled))] for scores in scaled]

    def common_lines(self) -> tuple[Line, ...]:
        """Returns the arms with results in every scenario."""
        return tuple(x for x in self.lines(trained=True) if all((s, x) in self.results for s in self.scenarios))

    def headroom(self, scenario: str, algorithm: str) -> Estimate | None:
        """Returns the mean return of the ceiling above that of the floor; None if one of them has no results."""
        ends = [Line(self.study.ceiling, algorithm), Line(self.study.floor, algorithm)]
        if any((scenario, end) not in self.results for end in ends):
            return None
        return gain_with_t_interval(*(self.runs(scenario, end) for end in ends))

    def headroom_used(self, scenario: str, line: Line) -> Estimate | None:
        """Returns the share of the headroom that an arm uses; None where there is none to be seen.

        None is also returned where the interval of the headroom reaches 0: a share of it would have no meaning.
        """
        assert line.algorithm is not None
        headroom = self.headroom(scenario, line.algorithm)
        if headroom is None or headroom.interval is None or headroom.interval[0] <= 0:
            return None
        ends = [Line(name, line.algorithm) for name in (self.study.floor, self.study.ceiling)]
        samples = [[self.runs(scenario, x)] for x in (line, *ends)]
        return self.estimate(share_of_headroom, *samples, about=("share", scenario, *line))

    def best_constant(self, scenario: str) -> Line | None:
        """Returns the best of the drivers that take one action in every step; None if there is none."""
        drivers = [x for x in self.lines(scenario, trained=False) if not is_planner(x.arm)]
        constant = [x for x in drivers if is_constant(x.arm)]
        return max(constant, key=lambda x: self.mean_return(scenario, x).value, default=None)

    def heuristic(self, scenario: str) -> Line | None:
        """Returns the line of the heuristic that drives agents of PettingZoo environments; None if there is none."""
        return next((x for x in self.lines(scenario, trained=False) if x.arm == "heuristic"), None)

    def planner(self, scenario: str, true_futures: bool = False) -> Line | None:
        """Returns the line of the planner, with forecasts or with true futures; None if there is none."""
        planners = [x for x in self.lines(scenario, trained=False) if is_planner(x.arm)]
        found = [x for x in planners if (planner_checkpoint(x.arm) == ORACLE) == true_futures]
        return min(found, key=lambda x: x.arm != PLANNER, default=None)  # with the shipped forecasts, if it is listed


def column(result: Result, field: str) -> Float[np.ndarray, " episodes"]:
    """Returns a field of all episodes of a result, without those that do not report it."""
    values: list[Any] = [episode.get(field) for episode in result.episodes]
    return np.array([float(value) for value in values if value is not None], dtype=np.float64)


def _crashed(result: Result) -> list[bool | None]:
    return [episode.get("crashed") for episode in result.episodes]


def generator_of(*names: str | None) -> np.random.Generator:
    """Returns a generator that is seeded by names alone."""
    digest = hashlib.sha256("\0".join(map(str, names)).encode()).digest()
    return np.random.default_rng(list(digest))
