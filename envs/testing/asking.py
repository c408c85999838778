"""Resets and steps an environment as the wrappers do, and says in one line where it does so otherwise than they expect.

That is the protocol of gymnasium and of PettingZoo's parallel environments: what `reset` takes, how many values `reset`
and `step` return, and which of them are dicts.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from predictor.support.errors import UserError, reason_of, short


class ReaderProblem(Exception):
    """Raised when an environment or a reader breaks the contract so that nothing else can be checked; one line."""


def check_reset(env: Any) -> None:
    """Checks that an environment takes what wrappers give to `reset`, those around it and itself.

    Raises:
        ReaderProblem: it does not.
    """
    inner = env
    while isinstance(inner, gym.Wrapper | BaseParallelWrapper):
        inner = inner.env
    if isinstance(inner, ParallelEnv) and not hasattr(inner, "possible_agents"):
        raise ReaderProblem(
            f"{type(inner).__name__} has no possible_agents; set it to the names of all agents that may ever be there"
        )
    try:
        takes = inspect.signature(inner.reset)
    except (TypeError, ValueError):  # written in C
        return
    try:
        takes.bind(seed=0, options=None)
    except TypeError as error:
        names = ", ".join(takes.parameters)
        raise ReaderProblem(
            f"{type(inner).__name__}.reset must take seed and options, got reset({names}); define "
            "reset(self, seed=None, options=None)"
        ) from error


def asked_reset(env: Any, seed: int) -> Any:
    """Resets the environment; returns the observation.

    Raises:
        ReaderProblem: it raised, or returned something else than observation and info.
    """
    found = _asked("reset", lambda: env.reset(seed=seed, options=None))
    names = ("observations", "infos") if isinstance(env, ParallelEnv) else ("observation", "info")
    _check(env, "reset", found, names)
    return found[0]


def asked_step(env: Any, action: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Steps the environment; returns what it does.

    Raises:
        ReaderProblem: it raised, or returned something else than five values.
    """
    found = _asked("step", lambda: env.step(action))
    names = ("observation", "reward", "terminated", "truncated", "info")
    if isinstance(env, ParallelEnv):
        names = ("observations", "rewards", "terminations", "truncations", "infos")
    _check(env, "step", found, names)
    if not isinstance(env, ParallelEnv):
        for name, value in zip(names[2:4], found[2:4], strict=True):
            if np.size(value) != 1:
                raise ReaderProblem(f"step: {name} must be True or False, got {short(repr(value), 60)}")
    elif kept := [agent for agent in env.agents if found[2].get(agent) or found[3].get(agent)]:
        raise ReaderProblem(f"step: {short(kept[0], 60)} has ended but is still in env.agents; take it out there")
    one, two, three, four, five = found
    return one, two, three, four, five


def _asked(what: str, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except UserError:
        raise
    except Exception as error:
        raise ReaderProblem(f"the environment's {what} failed with {reason_of(error)}") from error


def _check(env: Any, what: str, found: Any, names: tuple[str, ...]) -> None:
    if not isinstance(found, tuple | list) or len(found) != len(names):
        got = f"{len(found)} values" if isinstance(found, tuple | list) else type(found).__name__
        raise ReaderProblem(f"{what} must return {len(names)} values ({', '.join(names)}), got {got}")
    dicts = range(len(names)) if isinstance(env, ParallelEnv) else (len(names) - 1,)
    for place in dicts:
        if not isinstance(found[place], Mapping):
            raise ReaderProblem(f"{what}: {names[place]} must be a dict, got {type(found[place]).__name__}")
