"""Copies and pickles of running environments that continue where the original is.

mpe2 and PettingZoo's pursuit derive from Gymnasium's `EzPickle`: by themselves they copy and pickle as the arguments of
their constructor, and the copy is a new environment that was never reset. A wrapper that derives from `RunningCopy`
carries the simulator's state along. Simulators in C++ that cannot give their state refuse, with Python's own error or,
for EnvPool, one of ours.
"""

from typing import Any

from gymnasium.utils import EzPickle


class RunningCopy:
    """Makes `copy.deepcopy` and `pickle` of a wrapper continue exactly, whatever its simulator pickles by itself.

    Derive a Gymnasium or PettingZoo wrapper from it, first. Identities, histories and generators that the wrapper
    holds are copied in the same go, so that they keep pointing to the simulator's (copied) objects.
    """

    def __getstate__(self) -> dict[str, Any]:
        """Returns the wrapper's attributes and the state of a simulator that would not pickle its own."""
        return {"wrapper": self.__dict__.copy(), "simulator": _simulator_state(self.unwrapped)}  # type: ignore[attr-defined]

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Takes both back; the simulator has been constructed anew by then."""
        self.__dict__.update(state["wrapper"])
        self.unwrapped.__dict__.update(state["simulator"])  # type: ignore[attr-defined]


def _simulator_state(simulator: Any) -> dict[str, Any]:
    """Returns what a constructor's arguments do not tell; empty for a simulator that pickles its own state.

    Surfaces and fonts of pygame, which cannot be copied, are left to the constructor.
    """
    if not isinstance(simulator, EzPickle):
        return {}
    return {name: value for name, value in vars(simulator).items() if not _drawn(value)}


def _drawn(value: Any) -> bool:
    return type(value).__module__.partition(".")[0] == "pygame"
