"""Candidate plans of many environments, and their way to a vector wrapper: through the info of each environment.

An environment makes its plans where it runs, possibly in another process, before a vector environment resets it. So the
plans that belong to an episode's last observation are those of its last state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from envs.plans.base import PlanModel, Plans, checked_model
from predictor.support.errors import UserError, short

PLANS_INFO = "ego_plans"
"""Key of an info that carries the plans of its environment."""


@dataclass(frozen=True)
class PlanBatch:
    """Candidate plans of the ego of each of many scenes."""

    states: Float[np.ndarray, "batch plans horizon state"]
    """State of the ego at each step, in the world frame and the units of its scenes."""
    size_m: Float[np.ndarray, "batch 2"]
    """Length and width of every agent of a scene [m]."""
    true_xy: Float[np.ndarray, "batch played agents horizon 2"] | None = None
    """Positions of all agents of a scene if a plan is played [m], world frame, for the first plans or all of them; None
    where none was played."""

    @classmethod
    def stack(cls, plans: Sequence[Plans]) -> "PlanBatch":
        """Returns the plans of several scenes as a batch."""
        return cls._of([_parts(each) for each in plans])

    @classmethod
    def from_infos(cls, infos: Sequence[Mapping[str, Any]]) -> "PlanBatch":
        """Returns the plans that the infos of several environments carry.

        Raises:
            UserError: an info carries none.
        """
        return cls._of([_carried(info) for info in infos])

    @classmethod
    def from_vector_info(cls, infos: Mapping[str, Any]) -> "PlanBatch":
        """Returns the plans that the info of a gymnasium vector environment carries; zeros where one has none.

        Raises:
            UserError: it carries none.
        """
        carried = _carried(infos)
        return cls(carried["states"], carried["size_m"], carried.get("true_xy"))

    @classmethod
    def _of(cls, parts: Sequence[Mapping[str, Any]]) -> "PlanBatch":
        return cls(**{key: np.stack([each[key] for each in parts]) for key in parts[0]})

    def __getitem__(self, scenes: Int[np.ndarray, " some"]) -> "PlanBatch":
        """Returns the plans of some scenes."""
        return self._map(lambda own: own[scenes])

    def replaced(self, scenes: Int[np.ndarray, " some"], others: "PlanBatch") -> "PlanBatch":
        """Returns these plans with those of some scenes replaced."""

        def replace(own: Any, other: Any) -> Any:
            changed = own.copy()
            changed[scenes] = other
            return changed

        return self._map(replace, others)

    def followed_by(self, others: "PlanBatch") -> "PlanBatch":
        """Returns these plans and then the others."""
        return self._map(lambda own, other: np.concatenate([own, other]), others)

    def _map(self, change: Callable[..., Any], *others: "PlanBatch") -> "PlanBatch":
        """Applies `change` to every array, together with the corresponding arrays of other batches."""
        changed: dict[str, Any] = {}
        for field in fields(PlanBatch):
            arrays = [getattr(batch, field.name) for batch in (self, *others)]
            changed[field.name] = None if arrays[0] is None else change(*arrays)
        return PlanBatch(**changed)


def plans_info(plans: Plans) -> dict[str, Any]:
    """Returns the entry of an info that carries these plans."""
    return {PLANS_INFO: _parts(plans)}


def _parts(plans: Plans) -> dict[str, Any]:
    parts = {"states": plans.states, "size_m": np.array(plans.size_m, np.float64)}
    return parts if plans.true_xy is None else parts | {"true_xy": plans.true_xy}


def ask_for_plans(
    call: Callable[..., Sequence[Any]],
    what_if: bool | PlanModel,
    horizon_steps: int,
    wrapper: str,
    source: Any,
    played: int | None = 0,
) -> tuple[str, ...]:
    """Has each environment of a vector environment put its plans into its infos from now on.

    Args:
        call: method of the vector environment that calls a method of each environment.
        what_if: True for the environments' own plan model; or a `PlanModel`; False asks for nothing.
        horizon_steps: number of steps of a plan.
        wrapper: name of the vector wrapper, for messages.
        source: the vector environment.
        played: number of plans that are played in a copy of the simulator, the first ones; None plays all.

    Returns:
        Names of the plans; none with False, unless plans are played.

    Raises:
        UserError: the environments make no plans, have no plan model, or differ in their plans.
    """
    if what_if is False and played == 0:
        return ()
    if not isinstance(what_if, bool):
        checked_model(what_if)
    try:
        answers = list(call("propose_plans", what_if or True, horizon_steps, played))
    except AttributeError as error:
        raise UserError(
            f"{wrapper} with what_if or an oracle needs environments that make plans, in SceneObservation; "
            f"{type(source).__name__} has none (EnvPool has no plan model): leave what_if out ({short(error)})"
        ) from error
    for answer in answers:
        if isinstance(answer, UserError):
            raise answer
        if answer != answers[0]:
            raise UserError(f"all environments must have the same plans, got {answers[0]} and {answer}")
    names: tuple[str, ...] = answers[0]
    return names


def _carried(info: Mapping[str, Any]) -> Any:
    if PLANS_INFO not in info:
        raise UserError(
            f"an environment reported no plans: its info has no '{PLANS_INFO}', which SceneObservation puts there; a "
            "wrapper around it must pass the info of reset() and step() on"
        )
    return info[PLANS_INFO]
