"""Partners: drivers of the agents of a PettingZoo environment that do not learn, beside those that do."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from predictor.support.errors import UserError

Partner = Callable[[ParallelEnv, dict[str, Any], np.random.Generator], Mapping[str, Any]]
"""Driver of the agents that do not learn: the env, their observations, a generator → an action for each of them."""


def random_actions(
    env: ParallelEnv, observations: dict[str, Any], generator: np.random.Generator
) -> dict[str, NDArray[Any] | int]:
    """Returns actions drawn uniformly from each agent's Discrete or bounded Box space: the partner "random".

    Raises:
        UserError: an agent's action space is another one.
    """
    actions: dict[str, NDArray[Any] | int] = {}
    for agent in observations:
        space = env.action_space(agent)
        if isinstance(space, gym.spaces.Discrete):
            actions[agent] = int(space.start + generator.integers(space.n))
        elif isinstance(space, gym.spaces.Box) and space.is_bounded():
            if np.issubdtype(space.dtype, np.integer):
                actions[agent] = generator.integers(space.low, space.high, endpoint=True, dtype=space.dtype)
            else:
                actions[agent] = np.asarray(generator.uniform(space.low, space.high), dtype=space.dtype)
        else:
            raise UserError(
                f"partner 'random' needs Discrete or bounded Box actions, agent '{agent}' has {space}; pass a callable"
            )
    return actions


PARTNERS: dict[str, Partner] = {"random": random_actions}
"""Partners by name."""


def chosen_partner(possible: Sequence[str], learners: list[str], partner: Partner | str | None) -> Partner | None:
    """Returns the partner of a name, or the one that is given; None where all agents learn.

    Raises:
        UserError: an unknown name, a partner that has nobody to drive, or none where one is needed.
    """
    others = [name for name in possible if name not in learners]
    if others and partner is None:
        raise UserError(f"{others} do not learn and need a driver; pass partner= ({', '.join(PARTNERS)})")
    if partner is not None and not others:
        raise UserError("a partner drives agents that do not learn, but all agents learn; name the learners in agents=")
    if isinstance(partner, str):
        if partner not in PARTNERS:
            raise UserError(f"no partner is called '{partner}'; known: {', '.join(PARTNERS)}, or pass a callable")
        return PARTNERS[partner]
    return partner
