"""The comparison with EnvPool: what is refused before its minutes of work."""

import sys
from pathlib import Path

import pytest

from benchmarks import envpool_parity
from predictor.support.errors import UserError

SHIPPED = Path(envpool_parity.__file__).parents[1] / "agents" / "pretrained" / "highway-fast.zip"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--driver", "nonsense"], "driver must be one of "),
        (["--checkpoint", "merge"], "checkpoint is what a policy sees; give --policy"),
        (["--policy", "absent.zip", "--episodes", "0"], "policy has no effect without episodes"),
        (["--policy", "absent"], "no policy at absent"),
        (["--policy", str(SHIPPED)], f"{SHIPPED} sees other observations than envpool/HighwayFast-v0 gives here"),
    ],
)
def test_what_cannot_drive_is_said_before_anything_is_compared(
    words: list[str], message: str, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("envpool")
    monkeypatch.setattr(sys, "argv", ["envpool_parity", "--task-ids", "HighwayFast-v0", *words])
    monkeypatch.setattr(envpool_parity, "step_both", lambda *_: pytest.fail("nothing is compared yet"))
    with pytest.raises(UserError, match=message):
        envpool_parity.main()


def test_numbers_that_one_episode_does_not_have_are_dashes():
    seen = envpool_parity.Episodes([7.5], [3.0], [0.0], [0.0], [0.0], [], [], 1)
    table = envpool_parity.episodes_table("HighwayFast-v0", "idle", [("envpool", seen)])
    cells = [list(column.cells)[0] for column in table.columns]
    assert cells == [
        "envpool",
        "7.50 ± –",
        "0.00 ± –",
        "3.00 ± 0.00",
        "0.00 ± 0.00",
        "0.00 ± 0.00",
        "– ± –",
        "– ± –",
        "1",
    ]


def test_a_policy_that_is_not_there_is_said_before_anything_is_compared(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["envpool_parity", "--policy", "absent.zip"])
    monkeypatch.setattr(envpool_parity, "step_both", lambda *_: pytest.fail("nothing is compared yet"))
    with pytest.raises(UserError, match=r"no policy at absent.zip"):
        envpool_parity.main()
