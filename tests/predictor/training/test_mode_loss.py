"""What a model with modes minimises: the energy score in closed form, and which numbers it may move."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from predictor.data.windows import WindowBatch
from predictor.evaluation.energy_score import energy_score
from predictor.forecaster import Futures, WindowOutput
from predictor.layers.pairs import masked_mean
from predictor.training.config import TrainConfig
from predictor.training.mode_loss import REST_SHARE, energy_terms, spread_nll, unit
from predictor.training.objective import nll, window_loss
from tests.predictor.helpers import any_model

BATCH, MODES, AGENTS, HORIZON = 2, 3, 4, 3
# Under the square root of a distance is a tiny number, so that its derivative at 0 is finite.
CLOSE = {"rtol": 1e-4, "atol": 1e-4}


def drawn(features: int, seed: int = 0) -> tuple[Futures, Tensor, Tensor]:
    """Modes, truth, and a mask with an agent that is absent, one that leaves, and a scene that ends early."""
    generator = torch.Generator().manual_seed(seed)
    states = 2 * torch.randn(BATCH, MODES, AGENTS, HORIZON, features, generator=generator)
    probs = torch.softmax(torch.randn(BATCH, MODES, AGENTS, generator=generator), dim=1)
    scale = 0.5 + torch.rand(BATCH, MODES, AGENTS, HORIZON, 2, generator=generator)
    valid = torch.ones(BATCH, AGENTS, HORIZON).bool()
    valid[0, 3] = valid[0, 2, 1:] = valid[1, :, 2] = False
    return Futures(states, probs, scale), torch.randn(BATCH, AGENTS, HORIZON, features, generator=generator), valid


def standing(positions: list[list[float]], probs: list[list[float]], steps: int = 1) -> Futures:
    """Agents (inner) that stand on the x axis in each mode (outer); no other feature."""
    x = torch.tensor(positions)[None, :, :, None].expand(-1, -1, -1, steps)
    return Futures(torch.stack([x, torch.zeros_like(x)], dim=-1), torch.tensor(probs)[None], torch.ones(*x.shape, 2))


def terms(modes: Futures, truth: Tensor, valid: Tensor, scales: Tensor | None = None) -> tuple[float, float]:
    scales = torch.ones(truth.shape[-1]) if scales is None else scales
    agents, scenes = energy_terms(modes, truth, valid, scales, axes=2)
    return agents.item(), scenes.item()


# --- Values -----------------------------------------------------------------------------------------------------------


def test_with_positions_alone_and_no_scales_the_energy_of_agents_is_the_metric():
    modes, truth, valid = drawn(features=2)
    expected = masked_mean(*energy_score(modes.states, truth, valid, modes.mode_probs)).item()
    assert terms(modes, truth, valid)[0] == pytest.approx(expected, abs=1e-4)


def test_a_scene_of_one_agent_and_one_step_scores_as_the_agent():
    modes, truth, _ = drawn(features=2)
    alone = Futures(modes.states[:, :, :1, :1], modes.mode_probs[:, :, :1])
    agents, scenes = terms(alone, truth[:, :1, :1], torch.ones(BATCH, 1, 1).bool())
    assert agents == pytest.approx(scenes, abs=1e-4)


def test_features_are_divided_by_their_scales_and_those_beyond_position_count_half():
    """One mode, off by (3, 4) m at a scale of 10 m, and by 1 m/s at a scale of 5 m/s."""
    modes = Futures(torch.tensor([30.0, 40.0, 3.0, 4.0]).view(1, 1, 1, 1, 4), torch.ones(1, 1, 1))
    truth, scales = torch.tensor([0.0, 0.0, 3.0, 3.0]).view(1, 1, 1, 4), torch.tensor([10.0, 10.0, 5.0, 5.0])
    agents, scenes = terms(modes, truth, torch.ones(1, 1, 1).bool(), scales)
    assert agents == pytest.approx(5 + REST_SHARE * 0.2, abs=1e-4) and REST_SHARE == 0.5
    assert scenes == pytest.approx(5, abs=1e-4)  # positions alone


def test_energy_of_scenes_closed_form():
    """A scene's probability is the mean of its agents', its distance the root mean square of theirs."""
    modes = standing([[0.0, 0.0], [3.0, 4.0]], [[0.8, 0.4], [0.2, 0.6]])
    truth, valid = torch.tensor([[1.0, 0.0], [0.0, 0.0]])[None, :, None], torch.ones(1, 2, 1).bool()
    far, apart = math.sqrt((4 + 16) / 2), math.sqrt((9 + 16) / 2)
    expected = 0.6 * math.sqrt(1 / 2) + 0.4 * far - 0.6 * 0.4 * apart
    assert terms(modes, truth, valid)[1] == pytest.approx(expected, abs=1e-4)
    wider = standing([[0.0, 0.0, 9.0], [3.0, 4.0, -9.0]], [[0.8, 0.4, 0.1], [0.2, 0.6, 0.9]])
    there = torch.tensor([[[True], [True], [False]]])
    absent = torch.cat([truth, torch.full((1, 1, 1, 2), 50.0)], dim=1)
    assert terms(wider, absent, there)[1] == pytest.approx(expected, abs=1e-4)
    longer = standing([[0.0, 0.0], [3.0, 4.0]], [[0.8, 0.4], [0.2, 0.6]], steps=3)
    ended = torch.tensor([True, False, True]).expand(1, 2, 3)  # a step at which nobody is there does not count
    assert terms(longer, truth.expand(-1, -1, 3, -1), ended)[1] == pytest.approx(expected, abs=1e-4)


def test_modes_that_belong_together_are_told_from_modes_that_do_not():
    """Two agents that turn to the same side: each alone scores the same with its modes swapped, the scene does not."""
    probs = [[0.5, 0.5], [0.5, 0.5]]
    together, crossed = standing([[1.0, 1.0], [-1.0, -1.0]], probs), standing([[1.0, -1.0], [-1.0, 1.0]], probs)
    truth, valid = torch.tensor([[1.0, 0.0], [1.0, 0.0]])[None, :, None], torch.ones(1, 2, 1).bool()
    (of_agents, of_scene), (agents_crossed, scene_crossed) = (terms(m, truth, valid) for m in (together, crossed))
    assert of_agents == pytest.approx(agents_crossed, abs=1e-5)
    assert of_scene == pytest.approx(0.5 * 2 - 0.25 * 2, abs=1e-4)
    assert scene_crossed == pytest.approx(math.sqrt(2) - 0.25 * 2, abs=1e-4)


def test_spread_is_the_likelihood_of_all_modes_and_of_the_first_alone():
    modes, truth, valid = drawn(features=4)
    assert modes.mode_probs is not None and modes.scale is not None
    mean, std_m = (t.permute(0, 2, 3, 1, 4) for t in (modes.states[..., :2], modes.scale))
    kinds = torch.distributions.Categorical(modes.mode_probs.transpose(1, 2)[:, :, None].expand(-1, -1, HORIZON, -1))
    normal = torch.distributions.Independent(torch.distributions.Normal(mean, std_m), 1)
    mixture = torch.distributions.MixtureSameFamily(kinds, normal).log_prob(truth[..., :2])
    alone = normal.log_prob(truth[..., None, :2].expand(mean.shape))[..., 0]
    assert spread_nll(modes, truth, valid, 2).item() == pytest.approx(-(mixture + alone)[valid].mean().item(), rel=1e-5)


def test_unit_brings_distances_to_the_laplace_likelihood():
    truth, valid = torch.tensor([3.0, 0.0]).view(1, 1, 1, 2), torch.ones(1, 1, 1).bool()
    agents, _ = terms(standing([[0.0]], [[1.0]]), truth, valid)
    expected = nll(torch.zeros(1, 1, 1, 2), truth, valid, torch.ones(2), variance=5e-5, likelihood="laplace").item()
    assert unit(5e-5) * agents == pytest.approx(expected, rel=1e-4)


# --- Gradients --------------------------------------------------------------------------------------------------------


def leaves(modes: Futures) -> Futures:
    return Futures(*(t.clone().requires_grad_() for t in modes))


def gradients(loss: Tensor, modes: Futures) -> list[Tensor]:
    found = torch.autograd.grad(loss, modes, allow_unused=True)
    return [torch.zeros_like(t) if g is None else g for g, t in zip(found, modes, strict=True)]


@pytest.mark.parametrize("term", [0, 1], ids=["agents", "scenes"])
def test_the_energy_moves_all_modes_but_the_first_and_all_probabilities(term: int):
    modes, truth, valid = drawn(features=4)
    modes = leaves(modes)
    states, probs, scale = gradients(energy_terms(modes, truth, valid, torch.ones(4), 2)[term], modes)
    there = valid[:, None].expand(-1, MODES, -1, -1)
    assert not states[:, 0].any() and not scale.any()
    moved = states[:, 1:, ..., :2] if term else states[:, 1:]
    assert moved[there[:, 1:]].all()
    assert probs[valid.any(-1)[:, None].expand(-1, MODES, -1)].all()


def test_the_likelihood_of_the_spread_moves_the_scale_alone():
    modes, truth, valid = drawn(features=4)
    modes = leaves(modes)
    states, probs, scale = gradients(spread_nll(modes, truth, valid, 2), modes)
    assert not states.any() and not probs.any()
    there = valid[:, None].expand(-1, MODES, -1, -1)
    assert scale[there].all() and not scale[~there].any()


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e3])
def test_what_stands_where_nobody_is_reaches_neither_loss_nor_gradient(value: float):
    modes, truth, valid = drawn(features=4)
    absent = ~valid.any(-1)[:, None].expand(-1, MODES, -1)
    gone = ~valid[:, None].expand(-1, MODES, -1, -1)
    found = []
    for filled in (False, True):
        own, future = leaves(modes), truth.clone()
        if filled:
            own.states.data[gone], future[~valid] = value, value
            assert own.mode_probs is not None and own.scale is not None
            own.mode_probs.data[absent], own.scale.data[gone] = 0.7, 30.0
        energies = energy_terms(own, future, valid, torch.ones(4), 2)
        losses = [*energies, spread_nll(own, future, valid, 2)]
        found.append((torch.stack(losses), gradients(sum(losses), own)))
    (losses_, clean), (same_losses, same) = found
    torch.testing.assert_close(same_losses, losses_)
    for ours, expected in zip(same, clean, strict=True):
        torch.testing.assert_close(ours, expected)
        assert not ours[absent].any()


def test_equal_modes_on_the_truth_have_finite_gradients():
    """The distance of two points has no derivative where they coincide."""
    modes = leaves(standing([[0.0, 0.0], [0.0, 0.0]], [[0.5, 0.5], [0.5, 0.5]]))
    agents, scenes = energy_terms(modes, torch.zeros(1, 2, 1, 2), torch.ones(1, 2, 1).bool(), torch.ones(2), 2)
    assert all(torch.isfinite(g).all() for g in gradients(agents + scenes, modes))


def test_a_batch_in_which_nobody_has_a_future_costs_nothing():
    modes, truth, valid = drawn(features=4)
    modes = leaves(modes)
    nobody = torch.zeros_like(valid)
    loss = sum((*energy_terms(modes, truth, nobody, torch.ones(4), 2), spread_nll(modes, truth, nobody, 2)))
    assert loss.item() == 0.0
    assert not any(g.any() for g in gradients(loss, modes))


# --- In the objective -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [(5.0, 0.7), (1.5, 0.0), (0.0, 0.7)], ids=["both", "agents", "scenes"])
def test_the_objective_adds_the_weighted_terms(weights: tuple[float, float]):
    modes, truth, valid = drawn(features=4)
    windows = WindowBatch(
        torch.cat([torch.zeros(BATCH, 1, AGENTS, 4), truth.transpose(1, 2)], dim=1),
        torch.cat([torch.ones(BATCH, 1, AGENTS).bool(), valid.transpose(1, 2)], dim=1),
        torch.zeros(BATCH, dtype=torch.long),
    )
    output = WindowOutput(torch.zeros_like(windows.states), modes.states[:, 0])
    config = TrainConfig((Path(),), Path(), energy_weight=weights[0], joint_energy_weight=weights[1])
    forecaster = any_model("dgvae-plural")
    plain, without = window_loss(forecaster, windows, output, config)
    total, found = window_loss(forecaster, windows, output._replace(modes=modes), config)
    scales: Any = torch.tensor(forecaster.spec.feature_scales)
    agents, scenes = (unit(config.variance) * t for t in energy_terms(modes, truth, valid, scales, 2))
    spread = spread_nll(modes, truth, valid, 2)
    assert found.keys() - without.keys() == {"energy", "joint_energy", "nll_spread"}
    for name, expected in (("energy", agents), ("joint_energy", scenes), ("nll_spread", spread)):
        torch.testing.assert_close(found[name], expected)
    torch.testing.assert_close(total - plain, weights[0] * agents + weights[1] * scenes + spread, **CLOSE)
