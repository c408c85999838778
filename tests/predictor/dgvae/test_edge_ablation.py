"""Edges averaged over senders make it no difference whose edge it is; without edges no message is sent."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig
from predictor.dgvae.edge_ablation import Ablation, EdgeAblation
from predictor.forecaster import Belief, Futures
from tests.predictor.helpers import FAST_LIKE, PLURAL, random_states, spec

AGENTS, HORIZON = 4, 3
VARIANTS: dict[str, DGVAEConfig] = {
    "plain": FAST_LIKE,
    "plural": PLURAL,
    "neighbours": replace(PLURAL, num_neighbours=2, num_edge_types=3),
}
every_variant = pytest.mark.parametrize("variant", VARIANTS)


def made(variant: str) -> DGVAE:
    torch.manual_seed(7)
    model = DGVAE(spec(), VARIANTS[variant], HORIZON)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(3.0)
    return model.eval()


def forecast(model: DGVAE, states: Tensor, samples: int = 1) -> tuple[Belief, Futures]:
    """Belief after three steps of four agents, of which the last one is absent, and a roll-out."""
    valid = torch.ones(1, AGENTS, dtype=torch.bool)
    valid[0, -1] = False
    memory = model.empty_memory(1, AGENTS)
    with torch.inference_mode():
        for step in range(states.shape[1]):
            memory, belief = model.observe(memory, states[:, step], valid)
        return belief, model.rollout(belief, HORIZON, samples)


def states() -> Tensor:
    return random_states(1, 1, 3, AGENTS, 4)


@every_variant
def test_averaged_edges_are_the_mean_over_senders(variant: str):
    model = made(variant)
    before, after = (forecast(m, states()) for m in (model, EdgeAblation(model, "averaged")))
    probs, averaged = before[0].dense().edge_probs[0], after[0].dense().edge_probs[0]
    near = VARIANTS[variant].num_neighbours or AGENTS
    for receiver in range(3):
        senders = [s for s in range(3) if s != receiver][:near]
        torch.testing.assert_close(
            averaged[receiver, senders], averaged[receiver, senders[:1]].expand(len(senders), -1)
        )
        torch.testing.assert_close(averaged[receiver, senders].sum(-1), torch.ones(len(senders)))
    first = states()[:, :1]
    before_first, after_first = (forecast(m, first)[0].dense() for m in (model, EdgeAblation(model, "averaged")))
    for receiver in range(3):
        present = before_first.edge_probs[0, receiver, :, 0] < 1
        for name in ("edge_probs", "edge_features"):
            found, whole = (getattr(belief, name)[0, receiver] for belief in (after_first, before_first))
            torch.testing.assert_close(found[present], whole[present].mean(0).expand_as(found[present]))
    # the first step's edges come from equal memories, so their mean is kept; senders differed
    assert probs[0, 1:3].std(0).max() > 1e-3
    assert (before[1].states - after[1].states).abs().max() > 1e-4


@every_variant
@pytest.mark.parametrize("kind", ["averaged", "cut"])
def test_samples_begin_with_the_single_forecast(variant: str, kind: Ablation):
    model = EdgeAblation(made(variant), kind)
    single, several = (forecast(model, states(), samples)[1].states for samples in (1, 3))
    torch.testing.assert_close(single[:, 0], several[:, 0], rtol=1e-4, atol=1e-4)


def test_without_edges_nobody_acts_on_anybody():
    """With edges, another agent's state changes the first one's forecast."""
    model = made("plain")
    moved = states()
    moved[:, :, 1] += 3.0
    moved[:, :, 1, 2:] *= -1.0
    cut, whole = (
        [forecast(m, s)[1].states[0, 0, 0] for s in (states(), moved)] for m in (EdgeAblation(model, "cut"), model)
    )
    assert (whole[0] - whole[1]).abs().max() > 1e-3
    assert (cut[0] - cut[1]).abs().max() < 1e-6


@every_variant
def test_cut_edges_have_no_probability(variant: str):
    belief = forecast(EdgeAblation(made(variant), "cut"), states())[0].dense()
    assert belief.edge_probs[..., 1:].max() < 1e-6


def test_the_model_itself_is_not_changed():
    model = made("plural")
    before = forecast(model, states())[1].states
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    EdgeAblation(model, "cut")
    torch.testing.assert_close(forecast(model, states())[1].states, before)
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())
