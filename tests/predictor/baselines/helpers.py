"""Tiny baselines, and the few ways in which their tests run them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import pytest
import torch
from hypothesis import strategies as st
from torch import Tensor

from predictor.baselines import dnri
from predictor.baselines.base import UnrolledForecaster
from predictor.baselines.dnri import DNRI, DNRIConfig
from predictor.baselines.imma import IMMA, IMMAConfig
from predictor.baselines.lstm import LSTM, LSTMConfig
from predictor.baselines.mlp import MLP, MLPConfig
from predictor.forecaster import Belief, Memory
from predictor.scene import SceneSpec
from tests.predictor.helpers import spec

BATCH, TIME, AGENTS, HORIZON = 2, 6, 4, 3
TOLERANCE = {"rtol": 0.0, "atol": 1e-5}
COLUMNS = AGENTS + 3  # of the joint LSTM: room for the padding that tests add

# Every width differs from every other, so that an axis in the wrong place cannot fit by chance.
DNRI_SIZES = {"hidden_dim": 9, "rnn_dim": 5, "head_dim": 8, "decoder_dim": 13, "message_dim": 11}
IMMA_SIZES = {"hidden_dim": 9, "rnn_dim": 5, "decoder_dim": 13, "message_dim": 11}
MAKERS: dict[str, Callable[[SceneSpec], UnrolledForecaster]] = {
    "mlp": lambda s: MLP(s, MLPConfig(9), HORIZON),
    "lstm": lambda s: LSTM(s, LSTMConfig(embed_dim=9, rnn_dim=5, residual="constant_velocity"), HORIZON),
    "lstm-joint": lambda s: LSTM(s, LSTMConfig(True, COLUMNS, embed_dim=9, rnn_dim=5), HORIZON),
    "dnri": lambda s: DNRI(s, DNRIConfig(**DNRI_SIZES), HORIZON),
    "dnri-3types": lambda s: DNRI(s, DNRIConfig(**DNRI_SIZES, num_edge_types=3, residual="trapezoid"), HORIZON),
    "imma": lambda s: IMMA(s, IMMAConfig(**IMMA_SIZES), HORIZON),
    "imma-dynamic": lambda s: IMMA(s, IMMAConfig(**IMMA_SIZES, num_layers=3, dynamic_graph=True), HORIZON),
}
KINDS = tuple(MAKERS)
every_kind = pytest.mark.parametrize("kind", KINDS)
seeds = st.integers(0, 2**16)


def fresh(kind: str, layout: SceneSpec | None = None) -> Any:
    """A model with its initial weights, ready to learn."""
    torch.manual_seed(7)
    return MAKERS[kind](layout or spec())


@cache
def tiny(kind: str, **layout: Any) -> Any:
    """An untrained model in evaluation mode, with weights large enough for every path to leave a trace."""
    made = fresh(kind, spec(**layout))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(1.7)
    return made.eval().requires_grad_(False)


@st.composite
def presence(draw: st.DrawFn, ego: bool = True) -> Tensor:
    """Who is present at each step; every pattern of entering and leaving can occur."""
    cells = BATCH * TIME * AGENTS
    bits = draw(st.integers(0, 2**cells - 1))
    valid = torch.tensor([bool(bits >> i & 1) for i in range(cells)]).view(BATCH, TIME, AGENTS)
    if ego:
        valid[..., 0] = True
    return valid


def stream(forecaster: UnrolledForecaster, states: Tensor, valid: Tensor) -> Iterator[tuple[Memory, Belief]]:
    """Memory and belief after each step."""
    memory = forecaster.empty_memory(states.shape[0], states.shape[2])
    for now, present in zip(states.unbind(1), valid.unbind(1), strict=True):
        memory, belief = forecaster.observe(memory, now, present)
        yield memory, belief


def last(forecaster: UnrolledForecaster, states: Tensor, valid: Tensor) -> Belief:
    """Belief after the whole history."""
    return list(stream(forecaster, states, valid))[-1][1]


@contextmanager
def no_noise() -> Iterator[None]:
    """Every drawn graph is the expected one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dnri, "concrete_sample", lambda logits, *_: torch.softmax(logits, dim=-1))
        yield
