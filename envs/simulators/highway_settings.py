"""Names of highway-env's settings: highway-env merges any name into its own without a word, a mistyped one too."""

import difflib
from collections.abc import Iterable

import gymnasium as gym
from highway_env.envs.common.abstract import AbstractEnv

from predictor.support.errors import UserError, short


def check_settings(env: gym.Env, names: Iterable[str]) -> None:
    """Checks that an environment has settings of these names; any environment that is not highway-env's passes.

    Names inside of "observation" and "action" are those of the chosen class, and are not checked.

    Args:
        env: environment, wrapped or not.
        names: names in the `config` that it was made with.

    Raises:
        UserError: the environment's class has no setting of a name; names the nearest that it has.
    """
    if not isinstance(env.unwrapped, AbstractEnv):
        return
    known = type(env.unwrapped).default_config()
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=3, cutoff=0.75)
            hint = f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(sorted(known))}"
            env_id = env.spec.id if env.spec else type(env.unwrapped).__name__
            raise UserError(f"'{env_id}' has no setting '{short(name)}' in its config; {hint}")
