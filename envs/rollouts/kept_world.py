"""World that a process keeps from one episode to the next: at most one, since some simulators allow no second."""

from collections.abc import Callable, Hashable

from envs.rollouts.world import World

_kept: dict[Hashable, World] = {}


def kept_world(key: Hashable, make: Callable[[], World]) -> World:
    """Returns the world of this key: the one that is kept, or a new one, once the kept one is closed.

    Args:
        key: all that the world depends on.
        make: makes the world.
    """
    if key not in _kept:
        close_kept_world()
        _kept[key] = make()
    return _kept[key]


def close_kept_world() -> None:
    """Closes the world that this process keeps, if there is one."""
    while _kept:
        _kept.popitem()[1].close()
