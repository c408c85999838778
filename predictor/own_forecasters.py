"""Forecasters of a user's own, by name: "own:module:function", or "own:NAME" of an installed package's entry point.

Wrappers, every option of `envs` and `agents` that takes a checkpoint, and `predictor.evaluate` take such a name, too.
What it names is a forecaster, or a class or function that makes one of a `SceneSpec`. Its module is imported, so such
a name is code: a run's config alone must not bring one.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from predictor.forecaster import Belief, Forecaster, Futures, Memory, has_scale
from predictor.forecaster_checks import check_empty, check_futures, check_observed, check_scale, require_forecaster
from predictor.noise import Noise
from predictor.scene import SceneSpec
from predictor.support.errors import UserError, named, reason_of, short
from predictor.support.importing import import_module

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
    found = getattr(import_module(module, f"forecaster '{short(name)}'"), attribute, None)
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


class WatchedForecaster:
    """A forecaster of a user's own whose results are checked, and whose errors are one sentence.

    Args:
        forecaster: the forecaster; wrappers check its results themselves (`predictor.online`).
        name: its name, for messages.
    """

    def __init__(self, forecaster: Forecaster, name: str) -> None:
        """Takes over what the forecaster says of itself."""
        self._forecaster, self._name = forecaster, name
        self.spec, self.horizon_steps = forecaster.spec, forecaster.horizon_steps
        self.num_edge_types, self.edge_feature_dim = forecaster.num_edge_types, forecaster.edge_feature_dim
        self.has_scale = has_scale(forecaster)

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Returns the memory before the first step.

        Raises:
            UserError: the forecaster failed, or its result does not fit.
        """
        with self._named():
            memory = self._forecaster.empty_memory(batch, agents)
        check_empty(memory, batch, agents)
        return memory

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Observes one instant.

        Raises:
            UserError: as `empty_memory`.
        """
        with self._named():
            found = self._forecaster.observe(memory, states, valid)
        check_observed(found, states, self._forecaster)
        return found

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Forecasts.

        Raises:
            UserError: as `empty_memory`.
        """
        with self._named():
            futures = self._forecaster.rollout(belief, horizon_steps, num_samples, generator)
        check_futures(futures, horizon_steps, num_samples, belief.states, self.spec.position_dim)
        check_scale(futures, self._forecaster)
        return futures

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            raise UserError(f"forecaster '{self._name}' failed: {reason_of(error)}") from error


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
