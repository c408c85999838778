"""Paired differences of returns: every policy against one of them, episode by episode on the same seeds.

Seeds differ more than policies do, so the interval of a paired difference is smaller than those of the means suggest.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from agents.vec_envs import EpisodeResult
from predictor.evaluation.standard_errors import Estimate, bootstrap_sums, central_interval

DRAWS = 10_000
"""Number of bootstrap draws of episodes."""


def reference_policy(results: Mapping[str, Sequence[EpisodeResult]]) -> str | None:
    """Returns the policy that the others are compared with: the constant action of the highest mean return.

    A constant action is a driver that is named after the only action that it took, or the idle driver where actions are
    discrete. Without one, the reference is the first policy; None without any.
    """
    constant = [name for name, episodes in results.items() if _takes_one_action(name, episodes)]
    if not constant:
        return next(iter(results), None)
    return max(constant, key=lambda name: float(np.mean([e.episode_return for e in results[name]])))


def return_differences(
    results: Mapping[str, Sequence[EpisodeResult]], reference: str, seed: int = 0
) -> dict[str, Estimate]:
    """Computes the mean difference of returns to the reference, with its 95 % percentile bootstrap over episodes.

    Args:
        results: results of the episodes, by policy; only seeds that both have played are compared.
        reference: policy that is subtracted.
        seed: random seed of the draws; equal numbers of episodes have equal draws.

    Returns:
        The differences of all other policies that have a seed in common with the reference; a single episode has no
        interval.
    """
    subtracted = {e.seed: e.episode_return for e in results[reference]}
    found: dict[str, Estimate] = {}
    for name, episodes in results.items():
        pairs = np.array([e.episode_return - subtracted[e.seed] for e in episodes if e.seed in subtracted])
        if name == reference or not len(pairs):
            continue
        means = bootstrap_sums(pairs[:, None], seed, DRAWS)[:, 0] / len(pairs) if len(pairs) > 1 else None
        found[name] = Estimate(float(pairs.mean()), None if means is None else central_interval(means))
    return found


def _takes_one_action(policy: str, episodes: Sequence[EpisodeResult]) -> bool:
    taken = {action for episode in episodes for action in episode.action_counts}
    return len(taken) == 1 and (policy == "idle" or policy in taken)
