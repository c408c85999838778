"""A process keeps one world, and closes it before it makes another."""

from collections.abc import Iterator
from typing import Any

import pytest

from envs.rollouts.kept_world import close_kept_world, kept_world
from tests.envs.evaluation import forget


class Noted:
    """World that notes when it is made and closed."""

    def __init__(self, name: str, log: list[str]) -> None:
        self.name, self.log = name, log
        log.append(f"made {name}")

    def close(self) -> None:
        self.log.append(f"closed {self.name}")


@pytest.fixture(autouse=True)
def alone() -> Iterator[None]:
    forget()
    yield
    forget()


def test_one_world_is_kept_and_closed_before_the_next_is_made():
    log: list[str] = []

    def of(name: str) -> Any:
        return kept_world(name, lambda: Noted(name, log))  # type: ignore[arg-type, return-value]

    first = of("a")
    assert of("a") is first and of("b").name == "b" and of("a") is not first
    close_kept_world()
    close_kept_world()
    assert log == ["made a", "closed a", "made b", "closed b", "made a", "closed a"]


def test_a_world_that_cannot_be_made_leaves_none():
    log: list[str] = []
    kept_world("a", lambda: Noted("a", log))  # type: ignore[arg-type, return-value]
    with pytest.raises(ZeroDivisionError):
        kept_world("b", lambda: 1 / 0)  # type: ignore[arg-type, return-value]
    kept_world("a", lambda: Noted("a", log))  # type: ignore[arg-type, return-value]
    assert log == ["made a", "closed a", "made a"]
