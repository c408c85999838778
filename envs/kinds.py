"""Which wrapper serves which kind of environment: one sentence for an environment that was given to another one."""

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import Autoreset

from predictor.support.errors import UserError, short

ForecastKind = tuple[type, str]
"""Class of the environments that a wrapper takes, and what they are called."""
SINGLE: ForecastKind = (gym.Env, "one gymnasium environment")
VECTOR: ForecastKind = (gym.vector.VectorEnv, "a gymnasium vector environment (SyncVectorEnv, gym.make_vec)")


def require_kind(env: Any, kind: ForecastKind, wrapper: str) -> None:
    """Checks that a wrapper is given an environment of its kind.

    Args:
        env: what was given.
        kind: what is required.
        wrapper: name of the wrapper, for messages.

    Raises:
        UserError: it is of another kind, for which the message names the wrapper.
    """
    wanted, name = kind
    of_kind: Any = env if isinstance(env, wanted) else None
    if of_kind is None or _is_pool(env) or (kind is SINGLE and _has_several_egos(of_kind)):
        raise UserError(f"{wrapper} wraps {name}, got {_described(env)}")


def refuse_autoreset(env: gym.Env, wrapper: str) -> None:
    """Checks that nothing inside of a wrapper begins episodes in `step`, which no history would notice.

    Raises:
        UserError: Gymnasium's `Autoreset` does.
    """
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Autoreset):
            raise UserError(
                f"{wrapper} must see each reset, but Autoreset inside of it begins episodes in step(), so that the "
                f"history of one would leak into the next; put Autoreset around {wrapper}, or use VectorForecast"
            )
        env = env.env


def _packages(env: Any) -> set[str]:
    """Returns the packages in which the class of an environment and its bases are defined."""
    return {kind.__module__.partition(".")[0] for kind in type(env).__mro__}


def _is_pool(env: Any) -> bool:
    """Returns whether an environment is EnvPool's own, which is of both of Gymnasium's classes."""
    return isinstance(env, gym.vector.VectorEnv) and isinstance(env, gym.Env)


def _has_several_egos(env: gym.Env) -> bool:
    """Returns whether an environment is highway-env's with several controlled vehicles."""
    composed = isinstance(env.unwrapped.action_space, gym.spaces.Tuple)
    return composed and "highway_env" in _packages(env.unwrapped)


def _described(env: Any) -> str:
    """Returns what was given, and what to do with it."""
    name = type(env).__name__
    if isinstance(env, type):
        return f"the class {env.__name__}; make an environment of it: {env.__name__}(...)"
    if isinstance(env, str):
        return f"the text '{short(env, 80)}'; make the environment first, for example with gym.make(...)"
    packages = _packages(env)
    if _is_pool(env):
        return (
            f"{name}, a pool of EnvPool's; make it with gym.make('envpool/...') after envs.register_envpool_ids(), or "
            "with EnvPoolVecEnv (envs.sb3.envpool), or take a ForecastStream (docs/envpool.md)"
        )
    if isinstance(env, gym.Env) and _has_several_egos(env):
        return (
            f"the environment {type(env.unwrapped).__name__} with several egos; highway-env's intersection for several "
            "is HighwayParallelEnv, in ForecastParallelEnv"
        )
    if isinstance(env, gym.vector.VectorEnv):
        return f"the gymnasium vector environment {name}; use VectorForecast (envs.vector)"
    if isinstance(env, gym.Env):
        return f"the single environment {name}; use ForecastObservation (envs.wrappers)"
    if "stable_baselines3" in packages:
        return f"the Stable-Baselines3 environment {name}; use VecForecast (envs.sb3.forecast)"
    if "pettingzoo" in packages:
        return f"the PettingZoo environment {name}; use ForecastParallelEnv (envs.parallel)"
    return f"{name}; derive the environment from that class, or convert it"
