"""Motion of all agents as it was in another branch, to which some are held: what reaches an agent directly.

A branch that shall show the direct effect of one agent on another lets these two move freely and holds all others to
the motion that they had without the intervention, frame by frame. Agents are found in a copy by their place in the
simulator's list at the moment of the branching, which copies keep.
"""

from collections.abc import Sequence
from typing import Any

State = dict[str, Any]
"""Attributes of one agent in one simulated frame."""


class MotionLog:
    """Motion of the agents of one branch, frame by frame.

    Args:
        bodies: the simulator's own objects.
        names: attributes that make up an agent's motion, where it has them.
    """

    def __init__(self, bodies: Sequence[Any], names: Sequence[str]) -> None:
        """Starts empty."""
        self.names = tuple(names)
        self._bodies = list(bodies)
        self.frames: list[dict[int, State]] = []

    def note(self, present: Sequence[Any]) -> None:
        """Keeps the motion of the agents that are present in this frame."""
        there = {id(body) for body in present}
        self.frames.append(
            {
                i: {name: _copied(getattr(body, name)) for name in self.names if hasattr(body, name)}
                for i, body in enumerate(self._bodies)
                if id(body) in there
            }
        )


class HeldAgents:
    """Holds agents to a log.

    Args:
        bodies: the simulator's own objects, as many as in the log and in its order.
        log: motion to hold them to.
        free: those that are not held.
    """

    def __init__(self, bodies: Sequence[Any], log: MotionLog, free: Sequence[Any]) -> None:
        """Starts at the log's first frame."""
        self._frames, self._next = log.frames, 0
        loose = {id(body) for body in free}
        self._held = {i: body for i, body in enumerate(bodies) if id(body) not in loose}

    def __contains__(self, body: Any) -> bool:
        """Returns whether an agent is held."""
        return any(held is body for held in self._held.values())

    def place(self) -> None:
        """Puts all held agents where they were in the next frame of the log."""
        frame = self._frames[self._next] if self._next < len(self._frames) else {}
        self._next += 1
        for i, state in frame.items():
            if i in self._held:
                for name, value in state.items():
                    setattr(self._held[i], name, _copied(value))


def _copied(value: Any) -> Any:
    return value.copy() if hasattr(value, "copy") else value
