"""Summaries of a policy's episodes: means with standard errors, rates with Wilson intervals."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from agents.vec_envs import EpisodeResult
from envs.rollouts.driving_measures import DrivingMeasures

NEARLY_CONSTANT = 0.95
"""Least share of one action from which on a policy is called nearly constant."""

EXTREMES = ("best", "median", "worst")
"""Names of the extreme episodes of a policy, by return; each can be filmed."""


@dataclass(frozen=True)
class PolicySummary:
    """Results of one policy over all episodes: a line of the table."""

    policy: str
    """Name of the policy or driver."""
    episodes: int
    """Number of episodes."""
    return_mean: float
    """Mean undiscounted return."""
    return_se: float
    """Standard error of `return_mean`; NaN for a single episode."""
    length_mean: float
    """Mean length [policy steps]."""
    length_se: float
    """Standard error of `length_mean`; NaN for a single episode."""
    crash_rate: float | None
    """Share of episodes with a crash; None if the env does not report crashes."""
    crash_low: float | None
    """Lower end of the 95 % Wilson interval of `crash_rate`."""
    crash_high: float | None
    """Upper end of the 95 % Wilson interval of `crash_rate`."""
    mean_speed_mps: float
    """Mean over episodes of the mean speed [m/s]; NaN if the env does not report speeds."""
    role_returns: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Mean return of the learners of each role, with its standard error; empty if there is one role."""
    action_shares: dict[str, float] = field(default_factory=dict)
    """Share of each action among the steps of all episodes, the commonest first; empty if actions are not discrete."""
    success_rate: float | None = None
    """Share of episodes with success; None if the env does not report success."""
    success_low: float | None = None
    """Lower end of the 95 % Wilson interval of `success_rate`."""
    success_high: float | None = None
    """Upper end of the 95 % Wilson interval of `success_rate`."""
    driving: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Mean of each field of `DrivingMeasures` over the episodes that have it, with its standard error; empty if driving
    is not measured."""


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Computes the 95 % Wilson score interval of a rate, which lies within [0, 1] and never has zero width.

    Args:
        successes: number of events.
        trials: number of trials; at least 1.
    """
    from scipy import stats  # half a second, which other commands need not wait for

    found = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def percent_digits(rate: float) -> int:
    """Returns the number of decimals of a rate in percent: one where 0 or 100 % would hide one episode of 200."""
    return 1 if 0.0 < rate < 0.01 or 0.99 < rate < 1.0 else 0


def mean_and_standard_error(values: Sequence[float]) -> tuple[float, float]:
    """Returns the mean and its standard error (sample standard deviation / √n; NaN for a single value)."""
    array = np.asarray(values, dtype=np.float64)
    error = float(array.std(ddof=1) / math.sqrt(len(array))) if len(array) > 1 else math.nan
    return float(array.mean()), error


def summarize(
    policy: str,
    episodes: Sequence[EpisodeResult],
    silent_is_safe: bool = False,
    silent_is_failure: bool = False,
    reports_success: bool = False,
) -> PolicySummary:
    """Computes the summary of one policy's episodes.

    Args:
        policy: its name.
        episodes: its episodes.
        silent_is_safe: whether an episode without a word on crashes had none; see `reports_only_events`.
        silent_is_failure: whether an episode without a word on success had none; see there, too.
        reports_success: whether any episode of this environment has a word on success: a policy that only crashes
            then has none.
    """
    reports = silent_is_safe or any(e.crashed is not None for e in episodes)
    told = any(e.success is not None for e in episodes) or (reports_success and all(e.crashed for e in episodes))
    return_mean, return_se = mean_and_standard_error([e.episode_return for e in episodes])
    length_mean, length_se = mean_and_standard_error([float(e.length) for e in episodes])
    roles = list(dict.fromkeys(role for e in episodes for role in e.returns_by_role))
    actions = sum((Counter(e.action_counts) for e in episodes), Counter())
    return PolicySummary(
        policy,
        len(episodes),
        return_mean,
        return_se,
        length_mean,
        length_se,
        *_rate([bool(e.crashed) if reports else None for e in episodes]),
        mean_of_known([e.mean_speed_mps for e in episodes]),
        {
            role: mean_and_standard_error([e.returns_by_role[role] for e in episodes if role in e.returns_by_role])
            for role in roles
        },
        {action: count / max(1, actions.total()) for action, count in actions.most_common()},
        *_rate([_success(e, told, silent_is_failure) for e in episodes]),
        _mean_driving([e.driving for e in episodes if e.driving is not None]),
    )


def _success(episode: EpisodeResult, told: bool, silent_is_failure: bool) -> bool | None:
    """Returns whether an episode was a success; one with a crash was none, if the policy's episodes tell of success."""
    crashed_silently = told and episode.success is None and bool(episode.crashed)
    return bool(episode.success) if silent_is_failure or crashed_silently else episode.success


def reports_only_events(reported: Iterable[bool | None]) -> bool:
    """Returns whether an environment reports crashes, or success, only when they happen, judged by all its episodes."""
    return set(reported) - {None} == {True}


def _rate(events: Sequence[bool | None]) -> tuple[float | None, float | None, float | None]:
    """Returns the share of episodes with an event and its Wilson interval; None if no episode reports it."""
    known = [event for event in events if event is not None]
    return (sum(known) / len(known), *wilson_interval(sum(known), len(known))) if known else (None, None, None)


def _mean_driving(measured: Sequence[DrivingMeasures]) -> dict[str, tuple[float, float]]:
    """Returns mean and standard error of each measure over the episodes in which it is defined."""
    found = {}
    for measure in fields(DrivingMeasures) if measured else ():
        values = [float(value) for e in measured if (value := getattr(e, measure.name)) is not None]
        found[measure.name] = mean_and_standard_error(values) if values else (math.nan, math.nan)
    return found


def mean_of_known(values: Sequence[float]) -> float:
    """Returns the mean of the values that are not NaN; NaN if all are."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan
