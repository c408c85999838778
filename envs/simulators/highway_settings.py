"""Names of highway-env's settings: highway-env merges any name into its own without a word, a mistyped one too."""

import difflib
import inspect
from collections.abc import Collection, Mapping
from typing import Any

import gymnasium as gym
from highway_env.envs.common.abstract import AbstractEnv

from predictor.support.errors import UserError, short

_INNER = {"observation_config": "agents_observation_types", "action_config": "agents_action_types"}
"""Setting of a kind for several agents → attribute with the kind of each of them."""


def check_settings(env: gym.Env, config: Mapping[str, Any]) -> None:
    """Checks that an environment has all settings of a config; any environment that is not highway-env's passes.

    The settings inside of "observation" and "action" are those of the chosen type.

    Args:
        env: environment that was made with `config`, wrapped or not.
        config: the config.

    Raises:
        UserError: the environment's class, or a type that the config chooses, has no setting of a name; names the
            nearest that it has.
    """
    if not isinstance(env.unwrapped, AbstractEnv):
        return
    env_id = env.spec.id if env.spec else type(env.unwrapped).__name__
    defaults = type(env.unwrapped).default_config()
    _check(config, defaults, f"'{env_id}'", "config")
    for part, kind in (("observation", env.unwrapped.observation_type), ("action", env.unwrapped.action_type)):
        if isinstance(config.get(part), Mapping):
            _check_part(config[part], kind, defaults.get(part, {}), env_id, part)


def _check_part(given: Mapping[str, Any], kind: Any, defaults: Mapping[str, Any], env_id: str, part: str) -> None:
    """Checks the settings of an observation or action, and those of its agents."""
    # highway-env's own configs hold a few names that no type takes
    _check(given, {*_arguments(kind), "type", *defaults}, f"{type(kind).__name__} of '{env_id}'", part)
    for inner, kinds in _INNER.items():
        if isinstance(given.get(inner), Mapping) and getattr(kind, kinds, None):
            _check_part(given[inner], getattr(kind, kinds)[0], defaults.get(inner, {}), env_id, f"{part}.{inner}")


def _arguments(kind: Any) -> set[str]:
    """Returns the names that the constructor of an observation or action takes, those of its bases included."""
    makers = [vars(base)["__init__"] for base in type(kind).__mro__ if "__init__" in vars(base)]
    parameters = [each for make in makers for each in inspect.signature(make).parameters.values()]
    return {each.name for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD} - {"self", "env"}


def _check(names: Collection[str], known: Collection[str], whose: str, where: str) -> None:
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=3, cutoff=0.75)
            hint = f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(sorted(known))}"
            raise UserError(f"{whose} has no setting '{short(name)}' in its {where}; {hint}")
