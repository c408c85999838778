"""Candidate plans of an ego: what it could do next, as states for what-if forecasts, with what each would earn.

A plan model proposes them. highway-env has one; for another environment pass `what_if=` a `PlanModel`, or register one
for its class (docs/what_if.md has an example of 20 lines).
"""

from collections.abc import Callable

import gymnasium as gym

from envs.plans.base import PlanModel, Plans, checked_model, checked_plans
from envs.plans.highway import HighwayPlans
from envs.readers.base import check_registration
from envs.readers.highway import is_highway_env
from predictor.support.errors import UserError, reason_of

__all__ = [
    "HighwayPlans",
    "PlanModel",
    "Plans",
    "checked_model",
    "checked_plans",
    "plan_model_for",
    "register_plan_model",
]

MakePlanModel = Callable[[gym.Env], PlanModel]
"""Takes an environment (not reset yet, wrapped or not) and returns its plan model."""

_REGISTERED: dict[type, MakePlanModel] = {}


def register_plan_model(env_class: type, make_plan_model: MakePlanModel) -> None:
    """Registers a plan model for an environment class and what derives from it, for wrappers and the planner.

    Args:
        env_class: class of the unwrapped environment.
        make_plan_model: takes an environment (not reset yet, wrapped or not) and returns its plan model.

    Raises:
        UserError: the class is none, or the other cannot be called.
    """
    check_registration(env_class, make_plan_model, "plan model")
    _REGISTERED[env_class] = make_plan_model


def plan_model_for(env: gym.Env) -> PlanModel:
    """Returns the plan model of an environment: the one registered for its class, or highway-env's.

    Raises:
        UserError: there is none for the environment or its actions, a wrapper changes its actions, or the registered
            one cannot be made.
    """
    inside: gym.Env = env
    while isinstance(inside, gym.Wrapper):
        if isinstance(inside, gym.ActionWrapper) and not isinstance(inside, gym.wrappers.ClipAction):
            name = type(inside).__name__
            raise UserError(
                f"plans are made of actions of the environment itself, which {name} changes; put {name} around what "
                "needs plans, or pass a plan model of your own whose actions are those outside"
            )
        inside = inside.env
    for kind in type(env.unwrapped).__mro__:
        if kind in _REGISTERED:
            try:
                made = _REGISTERED[kind](env)
            except UserError:
                raise
            except Exception as error:
                raise UserError(f"the plan model registered for {kind.__name__} failed: {reason_of(error)}") from error
            return checked_model(made)
    if is_highway_env(env):
        return HighwayPlans(env)
    raise UserError(
        f"no plan model knows {type(env.unwrapped).__name__}: pass what_if= an object with names and plans(env, "
        "horizon_steps), or call register_plan_model for its class; see docs/what_if.md"
    )
