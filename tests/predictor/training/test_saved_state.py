from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from predictor.support.errors import UserError
from predictor.training.saved_state import read_state


def saved(path: Path) -> tuple[nn.Module, dict[str, Any]]:
    """Returns a model and its training state after a step, which is not written yet."""
    model = nn.Linear(2, 1)
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    progress = {"step": 1, "best": 1.0, "stale": 0, "validated": 1}
    return model, {"model": model.state_dict(), "optimizer": optimizer.state_dict()} | progress


def test_a_state_is_read_as_it_was_written(tmp_path: Path):
    model, state = saved(tmp_path)
    torch.save(state, tmp_path / "state.pt")
    assert read_state(tmp_path / "state.pt", model, torch.device("cpu"))["step"] == 1


@pytest.mark.parametrize(
    ("place", "name", "value", "message"),
    [
        (0, "exp_avg", torch.full((1, 2), torch.nan), "moment exp_avg that is not finite"),
        (1, "exp_avg_sq", torch.full((1,), torch.inf), "moment exp_avg_sq that is not finite"),
        (0, "exp_avg", torch.zeros(3), "moment exp_avg of another shape than its weight"),
        (0, "exp_avg", torch.zeros(1, 2, dtype=torch.long), "moment exp_avg that is not finite"),
        (1, "exp_avg_sq", torch.full((1,), -1.0), "mean square exp_avg_sq below 0"),
        (1, "step", torch.tensor(-1.0), "must hold step as a number of at least 0"),
        (1, "step", torch.tensor(torch.nan), "must hold step as a number of at least 0"),
        (1, "step", torch.ones(3), "must hold step as a number of at least 0"),
        (1, "step", "one", "must hold step as a number of at least 0"),
        ("weight", "exp_avg", torch.zeros(1, 2), "must hold step, exp_avg"),
        (2, "exp_avg", torch.zeros(1, 2), "must hold step, exp_avg"),
    ],
)
def test_damaged_moments_are_one_sentence(tmp_path: Path, place: Any, name: str, value: Any, message: str):
    model, state = saved(tmp_path)
    moments = state["optimizer"]["state"]
    moments[place] = dict(moments.get(place, moments[0])) | {name: value}
    torch.save(state, tmp_path / "state.pt")
    with pytest.raises(UserError, match=f"state.pt cannot be read .*{message}.*; train anew into another --out"):
        read_state(tmp_path / "state.pt", model, torch.device("cpu"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"state": {}}, "no moments, which each step leaves"),
        ({"param_groups": [{"params": [1, 0]}]}, "one group, of all weights in their order"),
        ({"param_groups": [{"params": [1000, 1001]}]}, "one group, of all weights in their order"),
        ({"param_groups": []}, "one group, of all weights in their order"),
    ],
)
def test_moments_of_nothing_or_of_others_are_refused(tmp_path: Path, change: dict[str, Any], message: str):
    """Adam would begin anew, or take the moments of another weight, and the run would be another one."""
    model, state = saved(tmp_path)
    state["optimizer"] |= change
    torch.save(state, tmp_path / "state.pt")
    with pytest.raises(UserError, match=f"state.pt cannot be read .*{message}"):
        read_state(tmp_path / "state.pt", model, torch.device("cpu"))
    if not state["optimizer"]["state"]:
        torch.save(state | {"step": 0}, tmp_path / "state.pt")
        assert read_state(tmp_path / "state.pt", model, torch.device("cpu"))["step"] == 0
