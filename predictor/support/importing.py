"""Imports what a text names: "module:function", for options that take code of a user's own."""

import importlib
from collections.abc import Callable
from typing import Any

from predictor.support.errors import UserError, named


class CannotImportError(UserError):
    """A module that is named cannot be imported."""


def load_named(path: str) -> Callable[..., Any]:
    """Imports what "module:function" names: a function, a class, or another object that can be called.

    Raises:
        UserError: nothing is named, there is no such module, or it has no such function or class.
    """
    module, colon, name = path.partition(":")
    if not colon:
        raise UserError(f"'{path}' must name a function or class as module:name")
    try:
        found: Callable[..., Any] | None = getattr(importlib.import_module(module), name, None)
    except (ImportError, ValueError) as error:
        hint = "is its package installed, or its folder on PYTHONPATH?"
        raise CannotImportError(f"cannot import '{module}' for '{path}': {error}; {hint}") from error
    except (Exception, SystemExit) as error:  # whatever the module does; a script without a guard may end the process
        raise CannotImportError(f"cannot import '{module}' for '{path}': {named(error)}") from error
    if not callable(found):
        raise UserError(f"module '{module}' has no function or class '{name}'")
    return found
