"""Candidate plans of many environments, and their way to a vector wrapper: through the info of each environment.

An environment makes its plans where it runs, possibly in another process, before a vector environment resets it. So the
plans that belong to an episode's last observation are those of its last state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from envs.plans.base import PlanModel, Plans
from predictor.support.errors import UserError

PLANS_INFO = "ego_plans"
"""Key of an info that carries the plans of its environment."""


@dataclass(frozen=True)
class PlanBatch:
    """Candidate plans of the ego of each of many scenes."""

    states: Float[np.ndarray, "batch plans horizon state"]
    """State of the ego at each step, in the world frame and the units of its scenes."""
    size_m: Float[np.ndarray, "batch 2"]
    """Length and width of every agent of a scene [m]."""

    @classmethod
    def stack(cls, plans: Sequence[Plans]) -> "PlanBatch":
        """Returns the plans of several scenes as a batch."""
        return cls(np.stack([each.states for each in plans]), np.array([each.size_m for each in plans], np.float64))

    @classmethod
    def from_infos(cls, infos: Sequence[Mapping[str, Any]]) -> "PlanBatch":
        """Returns the plans that the infos of several environments carry.

        Raises:
            UserError: an info carries none.
        """
        carried = [_carried(info) for info in infos]
        return cls(np.stack([c["states"] for c in carried]), np.stack([c["size_m"] for c in carried]))

    @classmethod
    def from_vector_info(cls, infos: Mapping[str, Any]) -> "PlanBatch":
        """Returns the plans that the info of a gymnasium vector environment carries; zeros where one has none.

        Raises:
            UserError: it carries none.
        """
        carried = _carried(infos)
        return cls(carried["states"], carried["size_m"])

    def __getitem__(self, scenes: Int[np.ndarray, " some"]) -> "PlanBatch":
        """Returns the plans of some scenes."""
        return PlanBatch(self.states[scenes], self.size_m[scenes])

    def replaced(self, scenes: Int[np.ndarray, " some"], others: "PlanBatch") -> "PlanBatch":
        """Returns these plans with those of some scenes replaced."""
        states, size_m = self.states.copy(), self.size_m.copy()
        states[scenes], size_m[scenes] = others.states, others.size_m
        return PlanBatch(states, size_m)

    def followed_by(self, others: "PlanBatch") -> "PlanBatch":
        """Returns these plans and then the others."""
        return PlanBatch(np.concatenate([self.states, others.states]), np.concatenate([self.size_m, others.size_m]))


def plans_info(plans: Plans) -> dict[str, Any]:
    """Returns the entry of an info that carries these plans."""
    return {PLANS_INFO: {"states": plans.states, "size_m": np.array(plans.size_m, np.float64)}}


def ask_for_plans(
    call: Callable[..., Sequence[Any]], what_if: bool | PlanModel, horizon_steps: int, wrapper: str, source: Any
) -> tuple[str, ...]:
    """Has each environment of a vector environment put its plans into its infos from now on.

    Args:
        call: method of the vector environment that calls a method of each environment.
        what_if: True for the environments' own plan model; or a `PlanModel`; False asks for nothing.
        horizon_steps: number of steps of a plan.
        wrapper: name of the vector wrapper, for messages.
        source: the vector environment.

    Returns:
        Names of the plans; none with False.

    Raises:
        UserError: the environments make no plans, have no plan model, or differ in their plans.
    """
    if what_if is False:
        return ()
    try:
        answers = list(call("propose_plans", what_if, horizon_steps))
    except AttributeError as error:
        raise UserError(
            f"{wrapper} with what_if needs environments that make plans of their own state, in SceneObservation; "
            f"{type(source).__name__} has none (EnvPool has no plan model): leave what_if out"
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
