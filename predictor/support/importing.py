"""Imports what a text names: "module:function", for options that take code of a user's own."""

import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any

from predictor.support.errors import UserError, named, short


class CannotImportError(UserError):
    """A module that is named cannot be imported."""


def import_module(module: str, purpose: str) -> ModuleType:
    """Imports a module of a user's own, whose code may do anything.

    Args:
        module: name of the module.
        purpose: what it is imported for, for the message.

    Raises:
        CannotImportError: there is no such module, or it failed.
    """
    sentence = f"cannot import '{short(module)}' for {purpose}"
    try:
        return importlib.import_module(module)
    except (ImportError, ValueError) as error:
        hint = "is its package installed, or its folder on PYTHONPATH?"
        raise CannotImportError(f"{sentence}: {error}; {hint}") from error
    except (Exception, SystemExit) as error:  # whatever the module does; a script without a guard may end the process
        raise CannotImportError(f"{sentence}: {named(error)}") from error


def load_named(path: str) -> Callable[..., Any]:
    """Imports what "module:function" names: a function, a class, or another object that can be called.

    Raises:
        UserError: nothing is named, there is no such module, or it has no such function or class.
    """
    module, colon, name = path.partition(":")
    if not colon:
        raise UserError(f"'{path}' must name a function or class as module:name")
    found: Callable[..., Any] | None = getattr(import_module(module, f"'{path}'"), name, None)
    if not callable(found):
        raise UserError(f"module '{module}' has no function or class '{name}'")
    return found
