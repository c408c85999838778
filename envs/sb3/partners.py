"""Partners: drivers of the agents of a PettingZoo environment that do not learn, beside those that do."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv

from envs.sampled_actions import uniform_action
from predictor.support.errors import UserError

Partner = Callable[[ParallelEnv, dict[str, Any], np.random.Generator], Mapping[str, Any]]
"""Driver of the agents that do not learn: the env, their observations, a generator → an action for each of them."""


def random_actions(env: ParallelEnv, observations: dict[str, Any], generator: np.random.Generator) -> dict[str, Any]:
    """Returns actions drawn uniformly (`envs.sampled_actions`): the partner "random".

    Raises:
        UserError: an agent's action space cannot be drawn from.
    """
    return {
        agent: uniform_action(env.action_space(agent), generator, "random partners", "pass a callable as partner")
        for agent in observations
    }


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
