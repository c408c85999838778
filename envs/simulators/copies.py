"""Copies and pickles of running environments that continue exactly as the original would.

mpe2 and PettingZoo's pursuit derive from Gymnasium's `EzPickle`: by themselves they copy and pickle as the arguments of
their constructor, so that the copy is a new environment that was never reset. A wrapper that derives from `RunningCopy`
carries the simulator's state along. Simulators in C++ whose state cannot be read raise an error: Python's own,
or for EnvPool a `UserError`.
"""

import copy
from typing import Any, TypeVar

from gymnasium.utils import EzPickle
from highway_env.envs.common.abstract import AbstractEnv

Owner = TypeVar("Owner")


class RunningCopy:
    """Makes `copy.deepcopy` and `pickle` of a wrapper continue exactly, whatever its simulator pickles by itself.

    Derive a Gymnasium or PettingZoo wrapper from it, first. Identities, histories and generators of the wrapper
    are copied together with the simulator, so that they refer to its copied objects.
    """

    def __getstate__(self) -> dict[str, Any]:
        """Returns the wrapper's attributes and the state of a simulator that does not pickle its own."""
        return {"wrapper": self.__dict__.copy(), "simulator": _simulator_state(self.unwrapped)}  # type: ignore[attr-defined]

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores both; the simulator has been constructed anew before."""
        self.__dict__.update(state["wrapper"])
        self.unwrapped.__dict__.update(state["simulator"])  # type: ignore[attr-defined]


def _simulator_state(simulator: Any) -> dict[str, Any]:
    """Returns the attributes of a simulator that pickles its constructor's arguments only; empty for all others.

    Surfaces and fonts of pygame, which cannot be copied, are made by the constructor.
    """
    if not isinstance(simulator, EzPickle):
        return {}
    return {name: value for name, value in vars(simulator).items() if not _drawn(value)}


def _drawn(value: Any) -> bool:
    return type(value).__module__.partition(".")[0] == "pygame"


def running_copy(owner: Owner, simulator: Any) -> Owner:
    """Returns a copy of whatever holds a simulator, which continues exactly.

    Args:
        owner: object to copy, with everything that it refers to.
        simulator: its simulator; of highway-env the road network is shared, as no step changes it.

    Raises:
        UserError: the simulator cannot be copied (EnvPool).
    """
    memo: dict[int, Any] = {}
    if isinstance(simulator, AbstractEnv) and simulator.road is not None:
        memo[id(simulator.road.network)] = simulator.road.network
    return copy.deepcopy(owner, memo)
