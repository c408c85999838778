"""The checkout here is a stand-in with the same methods; the real one is not part of this project."""

import sys
from pathlib import Path

import pytest

from benchmarks import reference
from benchmarks.reference import Prediction, Training, load
from benchmarks.settings import Settings
from predictor.support.errors import UserError

STAND_IN = """
import torch
from torch import nn

print("imported")

class Half(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(4, 4)
        self.fixed = nn.Parameter(torch.zeros(3), requires_grad=False)

    def forward(self, inputs):
        return self.linear(inputs), None, 0

    def single_step_forward(self, inputs, hidden):
        return self.linear(inputs), hidden + 1

    def get_initial_hidden(self, inputs):
        return 0


class DNRI(nn.Module):
    def __init__(self, params):
        super().__init__()
        print("built for", params["num_vars"])
        self.encoder, self.decoder = Half(), Half()

    def calculate_loss(self, inputs, is_train=False):
        print("loss")
        return self.encoder(inputs)[0].square().mean(), None, None

    def single_step_forward(self, inputs, hidden, logits, hard):
        assert hard and logits.shape == inputs.shape
        return inputs + logits, hidden + 1, None

    def predict_future(self, inputs, steps):
        return inputs
"""


def checkout(folder: Path, code: str) -> Path:
    (folder / "dnri" / "models").mkdir(parents=True)
    (folder / "dnri" / "models" / "dnri.py").write_text(code)
    return folder


@pytest.fixture(autouse=True)
def no_dnri(monkeypatch: pytest.MonkeyPatch):
    """Removes the modules of dNRI afterwards."""
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name.split(".")[0] == "dnri":
            del sys.modules[name]


def test_a_path_that_is_not_there_or_holds_something_else_is_one_clear_line(tmp_path: Path):
    with pytest.raises(UserError, match="--reference .*nowhere is no folder; it must be a checkout of github.com/"):
        load(tmp_path / "nowhere")
    with pytest.raises(UserError, match="is no checkout of github.com/.*dnri/models/dnri.py is not there"):
        load(tmp_path)


@pytest.mark.parametrize("code", ["import no_such_package", "class Other: pass", "def ("])
def test_a_checkout_that_cannot_be_imported_is_one_clear_line(tmp_path: Path, code: str):
    path = list(sys.path)
    with pytest.raises(UserError, match="cannot be imported") as caught:
        load(checkout(tmp_path, code))
    assert "\n" not in str(caught.value)
    assert sys.path == path


def test_the_section_times_both_in_turns_and_says_how_large_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setattr(reference, "TRAINING", Training(2, 3, 5))
    monkeypatch.setattr(reference, "PREDICTION", Prediction(2, 3, 4, 2))
    monkeypatch.setattr(reference, "ROUNDS", {"quick": 3})
    lines = reference.run(Settings(quick=True, threads=1, reference=checkout(tmp_path, STAND_IN)))
    assert lines[0].value == 2 * (16 + 4)  # what is not learned does not count
    assert (lines[1].value or 0) > 1e6
    ratios = [r for r in lines if r.unit == "×"]
    assert [r.name for r in ratios] == [
        "training step: reference / ours",
        f"training step, {reference.AS_SHIPPED}: reference / ours",
        "prediction, our history streamed: reference / ours",
        f"prediction, our history streamed, {reference.AS_SHIPPED}: reference / ours",
        "free run alone: reference / ours",
        "prediction, both encode the history: reference / ours",
    ]
    assert all(r.quartiles is not None and (r.value or 0) > 0 for r in ratios)
    assert len([r for r in lines if r.unit == "ms"]) == 12
    assert "built for" not in capsys.readouterr().out
