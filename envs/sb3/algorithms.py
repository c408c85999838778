"""Learning algorithms of Stable-Baselines3 and sb3-contrib by name: their classes, and which of them saved a zip.

sb3-contrib is an optional package (extra "contrib"), imported only where one of its algorithms is used.
"""

import importlib
import importlib.util
from collections.abc import Mapping
from typing import Any, Literal, get_args

from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from predictor.support.errors import UserError

Algorithm = Literal["ppo", "dqn", "a2c", "sac", "qrdqn", "recurrent-ppo", "tqc"]

_STABLE: dict[Algorithm, type[BaseAlgorithm]] = {"ppo": PPO, "dqn": DQN, "a2c": A2C, "sac": SAC}
CONTRIB: dict[Algorithm, str] = {"qrdqn": "QRDQN", "recurrent-ppo": "RecurrentPPO", "tqc": "TQC"}
"""Algorithms of sb3-contrib → names of their classes there."""
_MARKS: dict[str, Algorithm] = {
    "top_quantiles_to_drop_per_net": "tqc",
    "n_quantiles": "qrdqn",
    "target_entropy": "sac",
    "exploration_rate": "dqn",
    "clip_range": "ppo",
    "gae_lambda": "a2c",
}
"""Parameter in SB3's JSON → the algorithm that has it and none of the parameters above it."""
_FOREIGN = frozenset({"policy_delay", "cg_max_steps", "n_delta"})
"""Parameters of TD3, DDPG and CrossQ, of TRPO, and of ARS, which are not known here."""


def require_algorithm(name: Algorithm) -> None:
    """Checks that an algorithm's package is installed.

    Raises:
        UserError: it is not.
    """
    if name in CONTRIB and importlib.util.find_spec("sb3_contrib") is None:
        raise UserError(f"algorithm {name} needs the sb3-contrib package; pip install 'dgvae-rl[contrib]'")


def algorithm_class(name: Algorithm) -> type[BaseAlgorithm]:
    """Returns the class of an algorithm.

    Raises:
        UserError: its package is not installed.
    """
    if name in _STABLE:
        return _STABLE[name]
    require_algorithm(name)
    found: type[BaseAlgorithm] = getattr(importlib.import_module("sb3_contrib"), CONTRIB[name])
    return found


def algorithm_named(name: Any) -> Algorithm | None:
    """Returns the algorithm of this name; None if none has it."""
    return next((known for known in get_args(Algorithm) if known == name), None)


def algorithm_of_model(model: BaseAlgorithm) -> Algorithm | None:
    """Returns the name of a model's algorithm; None for one that is not known here."""
    names: dict[str, Algorithm] = {kind.__name__: name for name, kind in _STABLE.items()}
    names |= {kind: name for name, kind in CONTRIB.items()}
    return next((names[kind.__name__] for kind in type(model).__mro__ if kind.__name__ in names), None)


def algorithm_of_parameters(parameters: Mapping[str, Any]) -> Algorithm | None:
    """Returns the algorithm that saved these parameters (the entry "data" of SB3's zip); None if it is not known."""
    if _FOREIGN & parameters.keys():
        return None
    found = next((name for mark, name in _MARKS.items() if mark in parameters), None)
    module = str(_policy_module(parameters))
    if found == "ppo" and (".maskable." in module or ".ppo_mask." in module):
        return None
    if found == "ppo" and ".recurrent." in module:
        return "recurrent-ppo"
    return found


def _policy_module(parameters: Mapping[str, Any]) -> Any:
    """Returns the module of the policy's class, as SB3 notes it."""
    policy = parameters.get("policy_class")
    return policy.get("__module__") if isinstance(policy, Mapping) else None
