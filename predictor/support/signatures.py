"""Whether a function that a user gave can be called as it will be."""

import inspect
from collections.abc import Callable
from typing import Any


def takes(function: Callable[..., Any], *arguments: Any) -> bool:
    """Returns whether a function takes so many arguments; True where nothing says so, as of functions in C."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return True
    try:
        signature.bind(*arguments)
    except TypeError:
        return False
    return True
