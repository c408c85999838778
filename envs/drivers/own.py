"""Drivers of a user's own, by name: "own:module:function", wherever collection and evaluation take a driver.

What the name stands for is called once in each episode, after the reset, as `function(env, rng)`, and returns the
driver: a function from observations to actions. With one ego these are the environment's own observation and its
action; in a PettingZoo environment the observations of all agents and an action for each that lives, by name. Its
module is imported, so such a name is code.
"""

import copy
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import CellType, FunctionType
from typing import Any

import numpy as np

from predictor.own_forecasters import PREFIX
from predictor.support.errors import UserError, reason_of
from predictor.support.importing import load_named


class OwnDriver:
    """Drives one episode as the user's function says.

    Args:
        name: "own:module:function".
        env: environment that is driven.
        rng: source of all randomness of this episode.

    Raises:
        UserError: there is no such function.
    """

    def __init__(self, name: str, env: Any, rng: np.random.Generator) -> None:
        """Imports the function; it is called at the first step, when the environment has been reset."""
        if ":" not in name.removeprefix(PREFIX):
            raise UserError(f"a driver of your own is {PREFIX}module:function, got '{name}'")
        self._name, self._make, self._env, self._rng = name, load_named(name.removeprefix(PREFIX)), env, rng
        self._act: Any = None

    def __call__(self, observation: Any) -> Any:
        """Returns the action of an observation, or the actions of all agents.

        Raises:
            UserError: the user's function raised, or returned something that is no driver.
        """
        if self._act is None:
            with self._named("is called as function(env, rng)"):
                self._act = self._make(self._env, self._rng)
            if not callable(self._act):
                raise UserError(
                    f"driver '{self._name}' must give a function from observations to actions, got "
                    f"{type(self._act).__name__}"
                )
        with self._named("gives a function that is called with an observation"):
            return self._act(observation)

    @contextmanager
    def _named(self, how: str) -> Iterator[None]:
        """Says whose code it was that raised; of a function that does not take its arguments, how it is called."""
        try:
            yield
        except Exception as error:
            raised_in = traceback.extract_tb(error.__traceback__)[-1].filename
            if isinstance(error, TypeError) and raised_in == __file__:
                raise UserError(f"driver '{self._name}' {how}: {error}") from error
            raise UserError(f"driver '{self._name}' failed: {reason_of(error)}") from error

    def __deepcopy__(self, memo: dict[int, Any]) -> "OwnDriver":
        """Returns a driver with a state of its own, for a copy of the running environment."""
        copied = object.__new__(OwnDriver)
        memo[id(self)] = copied
        vars(copied).update({name: _copied(value, memo) for name, value in vars(self).items()})
        return copied


def _copied(value: Any, memo: dict[int, Any]) -> Any:
    """Returns a deep copy; that of a function has copies of what it keeps, which `copy.deepcopy` shares.

    A function keeps values in what it closes over, in its defaults and in attributes. Functions inside of containers
    and partials are shared with all that they keep.

    Raises:
        UserError: a function of a module keeps attributes, which it finds by its name; or as `_copied_or_shared`.
    """
    if not isinstance(value, FunctionType):
        return copy.deepcopy(value, memo)
    if id(value) in memo:
        return memo[id(value)]
    name = value.__name__
    if vars(value) and name in value.__code__.co_names and value.__globals__.get(name) is value:
        raise UserError(
            f"a driver of your own whose function {name} keeps attributes of itself cannot be copied with its "
            "environment; keep them in variables of the function that makes it, or in an object"
        )
    closure = value.__closure__ or ()
    known = [id(cell) in memo for cell in closure]  # functions may share a variable
    cells = tuple(memo.setdefault(id(cell), CellType()) for cell in closure)
    made = FunctionType(value.__code__, value.__globals__, name, None, cells)
    memo[id(value)] = made
    made.__defaults__ = _copied_or_shared(value.__defaults__, memo)
    made.__kwdefaults__ = _copied_or_shared(value.__kwdefaults__, memo)
    vars(made).update(_copied_or_shared(vars(value), memo))
    for cell, own, filled in zip(cells, closure, known, strict=True):
        if filled:
            continue
        try:
            content = own.cell_contents
        except ValueError:
            continue  # a variable without a value yet
        cell.cell_contents = _copied_or_shared(content, memo)
    return made


def _copied_or_shared(content: Any, memo: dict[int, Any]) -> Any:
    """Returns a copy of what a function keeps; modules, locks, networks in training and such are shared.

    Raises:
        UserError: it has a place in a sequence, which a copy would move on.
    """
    try:
        return _copied(content, memo)
    except UserError:
        raise
    except Exception as error:
        if isinstance(content, Iterator):
            raise UserError(
                f"a driver of your own that keeps a {type(content).__name__} cannot be copied with its environment; "
                "keep numbers instead, or an object that can be copied"
            ) from error
        return content
