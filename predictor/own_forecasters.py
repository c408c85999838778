"""Forecasters of a user's own, by name: "own:module:function", or "own:NAME" of an installed package's entry point.

Wrappers and every option of `envs` and `agents` that takes a checkpoint take such a name, too. What it names is a
forecaster, or a class or function that makes one of a `SceneSpec`. Its module is imported, so such a name is code: a
run's config alone must not bring one.
"""

import importlib
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from predictor.forecaster import Forecaster, require_forecaster
from predictor.scene import SceneSpec
from predictor.support.errors import UserError, named, short

PREFIX = "own:"
"""Beginning of the name of a forecaster of a user's own, where a checkpoint's name is expected."""
GROUP = "dgvae_rl.forecasters"
"""Group of entry points under which installed packages register forecasters."""


def is_own(name: object) -> bool:
    """Returns whether a checkpoint's name is that of a forecaster of a user's own."""
    return isinstance(name, str) and name.startswith(PREFIX)


def find_own(name: str) -> Any:
    """Imports what a name stands for: a forecaster, or what makes one.

    Raises:
        UserError: there is no such module, function or entry point.
    """
    what = name.removeprefix(PREFIX)
    if ":" not in what:
        return _registered(what)
    module, _, attribute = what.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except (ImportError, ValueError) as error:
        raise UserError(f"cannot import '{short(module)}' for forecaster '{short(name)}': {error}") from error
    except (Exception, SystemExit) as error:  # whatever the module does
        raise UserError(f"cannot import '{short(module)}' for forecaster '{short(name)}': {named(error)}") from error
    if found is None:
        raise UserError(f"module '{short(module)}' has no '{short(attribute)}' for forecaster '{short(name)}'")
    return found


def module_of(name: str) -> str:
    """Returns the module that a name stands for.

    Raises:
        UserError: there is no such entry point.
    """
    module, colon, _ = name.removeprefix(PREFIX).partition(":")
    return module if colon else _point(module).module


def make_own(name: str, scene_spec: SceneSpec, source: str) -> Forecaster:
    """Makes the forecaster that a name stands for, for scenes of `scene_spec`.

    Args:
        name: name that begins with `PREFIX`.
        scene_spec: layout of the scenes, with which a class or function is called.
        source: origin of the scenes, for messages.

    Raises:
        UserError: see `find_own`; it gives no forecaster, or one of another spec (features, dt).
    """
    found = find_own(name)
    if isinstance(found, type) or (callable(found) and not hasattr(found, "rollout")):
        try:
            found = found(scene_spec)
        except UserError:
            raise
        except (Exception, SystemExit) as error:
            raise UserError(
                f"forecaster '{name}': calling it with a SceneSpec failed with {type(error).__name__}: {error}"
            ) from error
    forecaster = require_forecaster(found)
    forecaster.spec.check_compatible(scene_spec, f"forecaster '{name}'", source)
    return forecaster


def _point(name: str) -> EntryPoint:
    known = {point.name: point for point in entry_points(group=GROUP)}
    if name not in known:
        raise UserError(
            f"no forecaster '{short(name)}' is registered; installed packages have {', '.join(known) or 'none'} (entry "
            f"points of the group {GROUP}); a function of a module is {PREFIX}module:function"
        )
    return known[name]


def _registered(name: str) -> Any:
    point = _point(name)
    try:
        return point.load()
    except (Exception, SystemExit) as error:
        raise UserError(f"forecaster '{name}' cannot be imported from {point.value}: {named(error)}") from error
