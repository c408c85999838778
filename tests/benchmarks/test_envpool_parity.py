"""The comparison with EnvPool: what is refused before its minutes of work."""

import sys

import pytest

from benchmarks import envpool_parity
from predictor.support.errors import UserError


def test_a_policy_that_is_not_there_is_said_before_anything_is_compared(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["envpool_parity", "--policy", "absent.zip"])
    monkeypatch.setattr(envpool_parity, "step_both", lambda *_: pytest.fail("nothing is compared yet"))
    with pytest.raises(UserError, match=r"no policy at absent.zip"):
        envpool_parity.main()
