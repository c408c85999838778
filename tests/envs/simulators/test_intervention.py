from typing import Any

import pytest

from envs.simulators.intervention import KINDS, Intervention
from predictor.support.errors import UserError


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_needs_only_an_agent_and_a_duration(kind: Any):
    assert Intervention(3, kind, 1).sign == {"brake": -1, "accelerate": 1}.get(kind, 0)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "agent": ({"agent": -1}, "agent must not be negative, got -1"),
    "steps": ({"steps": -1}, "steps must not be negative, got -1"),
    "no-steps": ({"steps": 0}, "brake needs at least 1 step, got 0; with at_once=True, 0 steps are possible"),
    "change": ({"change_mps": 0.0}, "change_mps must be positive, got 0.0"),
    "rate": ({"rate_mps2": -6.0}, "rate_mps2 must be positive, got -6.0"),
    "speed-of-removal": ({"kind": "remove", "change_mps": 1.0}, "change_mps, rate_mps2 and at_once are for brake"),
    "removal-at-once": ({"kind": "remove", "at_once": True}, "change_mps, rate_mps2 and at_once are for brake"),
    "rate-at-once": ({"at_once": True, "rate_mps2": 6.0}, "a change of speed at once has no rate_mps2"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_together_is_named(case: str):
    changes, message = REFUSED[case]
    with pytest.raises(UserError, match=f"^{message}"):
        Intervention(**{"agent": 1, "kind": "brake", "steps": 2, **changes})


def test_a_change_at_once_may_leave_the_driver_free():
    assert Intervention(1, "brake", 0, change_mps=3.0, at_once=True).steps == 0
