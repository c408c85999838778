"""Compares the published dNRI (Graber & Schwing, github.com/cgraber/cvpr_dNRI) with our dG-VAE at equal sizes.

No part of dNRI belongs to this project: its classes are imported from a checkout that the user names. Its
`predict_future` encodes the whole history at each call. For a fair comparison its roll-out alone is also compared with
our step and roll-out, and its whole prediction with ours when we encode the whole history, too.
"""

import contextlib
import importlib
import io
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

from benchmarks.models import TrainingStep, box, forecaster, inference
from benchmarks.results import Line
from benchmarks.settings import Settings
from benchmarks.timing import Meter, Timing, ratio_line, timed_line
from predictor.dgvae.config import DGVAEConfig
from predictor.support.errors import UserError
from predictor.support.runtime import float32_products

EQUAL = DGVAEConfig(
    hidden_dim=256, rnn_dim=64, head_dim=128, message_dim=256, decoder_dim=256, edge_feature_dim=32, zero_start=True
)
"""Our config with the reference's widths; the reference has no edge features."""
REFERENCE: dict[str, Any] = {
    "input_size": 4, "gpu": False, "num_edge_types": 2, "encoder_hidden": 256, "encoder_mlp_num_layers": 3,
    "encoder_mlp_hidden": 128, "encoder_rnn_hidden": 64, "rnn_hidden": 64, "encoder_rnn_type": "lstm",
    "encoder_dropout": 0.0, "decoder_hidden": 256, "decoder_dropout": 0.0, "skip_first": True,
    "use_learned_prior": True, "prior_num_layers": 3, "prior_hidden_size": 128, "gumbel_temp": 0.5,
    "train_hard_sample": False, "teacher_forcing_steps": -1, "normalize_kl": True, "normalize_nll": True,
    "nll_loss_type": "gaussian", "prior_variance": 5e-5, "no_encoder_bn": True, "encoder_no_bn": True,
    "graph_type": "dynamic", "encoder_save_eval_memory": False, "rnn_type": "lstm",
}  # fmt: skip
"""Settings of the reference, as its own scripts set them for a dynamic graph."""

AS_SHIPPED = "the reference with torch's own choice of library"
"""Name of the lines measured without `predictor.support.runtime.tune`, which sets the library for the whole process."""


class Training(NamedTuple):
    """Shape of a training step."""

    batch: int = 128
    agents: int = 5
    steps: int = 50


class Prediction(NamedTuple):
    """Shape of a prediction."""

    batch: int = 8
    agents: int = 10
    history: int = 30
    future: int = 20


TRAINING, PREDICTION = Training(), Prediction()
ROUNDS = {"quick": 5, "full": 11}


def load(path: Path) -> Any:
    """Imports the reference's model class.

    Raises:
        UserError: the folder is missing or holds another repository.
    """
    where = f"--reference {path}"
    if not path.is_dir():
        raise UserError(f"{where} is no folder; it must be a checkout of github.com/cgraber/cvpr_dNRI")
    if not (path / "dnri" / "models" / "dnri.py").is_file():
        raise UserError(f"{where} is no checkout of github.com/cgraber/cvpr_dNRI: dnri/models/dnri.py is not there")
    sys.path.insert(0, str(path))
    try:
        return importlib.import_module("dnri.models.dnri").DNRI
    except (ImportError, AttributeError, SyntaxError) as error:
        raise UserError(f"{where} cannot be imported ({error}); is it github.com/cgraber/cvpr_dNRI?") from error
    finally:
        sys.path.remove(str(path))


def build(model_class: Any, agents: int) -> Any:
    """Makes the reference's model for a number of agents; what it prints meanwhile is dropped."""
    torch.manual_seed(0)
    with contextlib.redirect_stdout(io.StringIO()):
        return model_class(REFERENCE | {"num_vars": agents})


def parameters(model: torch.nn.Module) -> int:
    """Returns the number of learned parameters."""
    return sum(p.numel() for p in model.parameters() if p.requires_grad)


def run(settings: Settings) -> list[Line]:
    """Measures training and prediction (three comparisons), and both models' sizes."""
    assert settings.reference is not None  # `Settings.sections`
    model_class = load(settings.reference)
    meter = Meter(ROUNDS[settings.mode], block_s=0.05, budget_s=120.0)
    with contextlib.redirect_stdout(io.StringIO()):
        return _training(model_class, meter) + _prediction(model_class, meter)


def _training(model_class: Any, meter: Meter) -> list[Line]:
    shape = TRAINING
    theirs = build(model_class, shape.agents).train()
    optimizer = torch.optim.Adam([p for p in theirs.parameters() if p.requires_grad], lr=5e-4)
    states = 0.3 * torch.randn(shape.batch, shape.steps, shape.agents, 4)

    def step() -> None:
        loss = theirs.calculate_loss(states, is_train=True)[0]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

    ours = TrainingStep(EQUAL, shape.agents, shape.steps, shape.batch)
    timings = meter.measure({"reference": step, AS_SHIPPED: as_shipped(step), "ours": ours})
    what = shape._asdict()
    sizes = [
        Line("reference", f"parameters, {name}", {}, float(parameters(model)), "")
        for name, model in (("reference", theirs), ("ours at equal sizes", ours.model))
    ]
    return [
        *sizes,
        *_pair("training step", what, timings["reference"], timings["ours"]),
        *_pair(f"training step, {AS_SHIPPED}", what, timings[AS_SHIPPED], timings["ours"]),
    ]


def _pair(name: str, what: dict[str, Any], theirs: Timing, ours: Timing) -> list[Line]:
    line = ratio_line(
        "reference", f"{name}: reference / ours", what, theirs.seconds / ours.seconds, "ours", better="higher"
    )
    return [
        timed_line("reference", f"{name}, reference", what, theirs),
        timed_line("reference", f"{name}, ours", what, ours),
        line,
    ]


def _prediction(model_class: Any, meter: Meter) -> list[Line]:
    shape = PREDICTION
    states = 0.3 * torch.randn(shape.batch, shape.history, shape.agents, 4)
    theirs = build(model_class, shape.agents).eval()
    whole = inference(lambda: theirs.predict_future(states, shape.future))
    streamed, anew = _our_predictions(states, shape.future)
    timings = meter.time_blocks(
        {
            "reference": lambda: _seconds(whole),
            AS_SHIPPED: lambda: _seconds(as_shipped(whole)),
            "reference, free run": inference(lambda: free_run_seconds(theirs, states, shape.future)),
            "streamed": lambda: _seconds(streamed),
            "anew": lambda: _seconds(anew),
        }
    )
    what, free = shape._asdict(), {"batch": shape.batch, "agents": shape.agents, "future": shape.future}
    return [
        *_pair("prediction, our history streamed", what, timings["reference"], timings["streamed"]),
        *_pair(f"prediction, our history streamed, {AS_SHIPPED}", what, timings[AS_SHIPPED], timings["streamed"]),
        *_pair("free run alone", free, timings["reference, free run"], timings["streamed"]),
        *_pair("prediction, both encode the history", what, timings["reference"], timings["anew"]),
    ]


def _our_predictions(states: torch.Tensor, future: int) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """Returns our prediction after a streamed history (last scene and roll-out), and with the history encoded anew."""
    batch, history, agents, _ = states.shape
    model = forecaster(EQUAL, box(agents), future)
    valid = torch.ones(batch, agents, dtype=torch.bool)

    def stream(memory: Any, scenes: torch.Tensor) -> Any:
        belief = None
        for now in scenes.unbind(1):
            memory, belief = model.observe(memory, now, valid)
        return memory, belief

    empty = model.empty_memory(batch, agents)
    with torch.inference_mode():
        before, _ = stream(empty, states[:, : history - 1])
    streamed = inference(lambda: model.rollout(stream(before, states[:, history - 1 :])[1], future).states)
    anew = inference(lambda: model.rollout(stream(empty, states)[1], future).states)
    for call in (streamed, anew):
        call()
    return streamed, anew


def free_run_seconds(model: Any, states: torch.Tensor, future: int) -> float:
    """Measures the seconds of the reference's single steps; its encoding of the history before is not timed."""
    prior_logits, _, prior_hidden = model.encoder(states[:, :-1])
    hidden = model.decoder.get_initial_hidden(states)
    for step in range(states.shape[1] - 1):
        _, hidden, _ = model.single_step_forward(states[:, step], hidden, prior_logits[:, step], True)
    predicted = states[:, -1]
    began = time.perf_counter()
    for _ in range(future):
        logits, prior_hidden = model.encoder.single_step_forward(predicted, prior_hidden)
        predicted, hidden, _ = model.single_step_forward(predicted, hidden, logits, True)
    return time.perf_counter() - began


def as_shipped(call: Callable[[], Any]) -> Callable[[], Any]:
    """Returns a function that makes the call with torch's default precision of matrix products."""

    def untuned() -> Any:
        with float32_products("highest"):
            return call()

    return untuned


def _seconds(call: Callable[[], Any]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began
