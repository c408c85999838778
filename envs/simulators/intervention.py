"""Settings of an intervention: what is done to one agent of a running simulator, whatever the family."""

from dataclasses import dataclass
from typing import Literal, get_args

from predictor.support.config_checks import check_at_least, check_choices, check_positive
from predictor.support.errors import UserError

Kind = Literal["brake", "accelerate", "left", "right", "remove"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""Kinds of interventions."""


class NotAllowedError(UserError):
    """Raised when an agent does not allow an intervention: try another kind, or another agent."""


@dataclass(frozen=True)
class Intervention:
    """What is done to one agent."""

    agent: int
    """Id of the agent, as readers report it (`Scene.ids`)."""
    kind: Kind
    """brake or accelerate: changes the speed and holds it; left or right: changes lane; remove: takes the agent out."""
    steps: int
    """Duration [policy steps]; 0 is for a change of speed at once, after which the driver is free."""
    change_mps: float | None = None
    """Change of speed, positive also for brake [m/s]; a vehicle brakes to rest at most. None takes the family's."""
    rate_mps2: float | None = None
    """Largest acceleration or deceleration on the way, positive [m/s²]; None takes the family's."""
    at_once: bool = False
    """Whether the speed changes now, instead of over time; then the steps only hold it."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range, or one that does not go with the kind.
        """
        check_choices(self)
        check_at_least(self, 0, "agent", "steps")
        check_positive(self, "change_mps", "rate_mps2")
        if self.steps == 0 and not self.at_once:
            raise UserError(f"{self.kind} needs at least 1 step, got 0; with at_once=True, 0 steps are possible")
        speeds = self.at_once, self.change_mps is not None, self.rate_mps2 is not None
        if any(speeds) and self.kind not in ("brake", "accelerate"):
            raise UserError(f"change_mps, rate_mps2 and at_once are for brake and accelerate, got {self.kind}")
        if self.at_once and self.rate_mps2 is not None:
            raise UserError("a change of speed at once has no rate_mps2; leave one of them out")

    @property
    def sign(self) -> int:
        """Sign of the change of speed: -1 for brake, 1 for accelerate, 0 otherwise."""
        return {"brake": -1, "accelerate": 1}.get(self.kind, 0)
