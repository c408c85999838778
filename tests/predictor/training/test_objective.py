"""Each term of the training objective in closed form, and what it is a mean over."""

import inspect
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.data.causal_edges import CAUSAL_ATTRIBUTES, STRENGTH
from predictor.data.windows import WindowBatch
from predictor.forecaster import WindowOutput
from predictor.support.errors import UserError
from predictor.training.config import TrainConfig
from predictor.training.objective import nll, reaction_weights, window_loss
from tests.predictor.helpers import any_model, model, random_states

# Agent 1 is absent at the last of three steps, so there are 2 · 2 ordered pairs, at the first two steps.
VALID = torch.tensor([[[True, True], [True, True], [True, False]]])
CONFIG = TrainConfig((Path(),), Path(), variance=0.5, likelihood="gaussian", one_step_weight=1.0)
SILENT = replace(CONFIG, kl_weight=0.0)


def batch(types: Any = None, attributes: Tensor | None = None, last_observed: int = 0) -> WindowBatch:
    """True states are zero."""
    edge_types = None if types is None else torch.tensor(types, dtype=torch.int8)
    return WindowBatch(torch.zeros(1, 3, 2, 4), VALID, torch.tensor([last_observed]), edge_types, attributes)


def per_pair(first: list[list[float]], second: list[list[float]]) -> Tensor:
    """Values of the pairs (0, 1) and (1, 0) at the first two steps; everything else is what must not matter."""
    values = torch.full((1, 3, 2, 2, len(first[0])), 77.0)
    values[0, :2, 0, 1], values[0, :2, 1, 0] = torch.tensor(first), torch.tensor(second)
    return values


def logits(first: list[float], second: list[float]) -> Tensor:
    """Two types; probability of an edge for each pair and step."""
    return per_pair(*([[math.log(1 - p), math.log(p)] for p in pair] for pair in (first, second)))


EVEN = logits([0.5, 0.5], [0.5, 0.5])


def output(
    prior: Tensor | None = EVEN,
    posterior: Tensor | None = EVEN,
    features: Tensor | None = None,
    rollout: Tensor | None = None,
    one_step: Tensor | None = None,
) -> WindowOutput:
    """Perfect predictions unless given; two steps of rollout."""
    one_step = torch.zeros(1, 3, 2, 4) if one_step is None else one_step
    return WindowOutput(one_step, torch.zeros(1, 2, 2, 4) if rollout is None else rollout, prior, posterior, features)


def terms(config: TrainConfig, windows: WindowBatch, out: WindowOutput, kl_scale: float = 1.0) -> dict[str, float]:
    """The terms, and the objective as "total"."""
    total, parts = window_loss(model(horizon_steps=2), windows, out, config, kl_scale)
    return {"total": total.item(), **{name: value.item() for name, value in parts.items()}}


def binary_kl(posterior: float, prior: float) -> float:
    return posterior * math.log(posterior / prior) + (1 - posterior) * math.log((1 - posterior) / (1 - prior))


# --- Likelihoods ------------------------------------------------------------------------------------------------------


def test_perfect_predictions_without_information_cost_nothing():
    assert terms(CONFIG, batch(), output())["total"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("likelihood", "variance", "expected"),
    # errors of 10 m and 5 m/s are 1 in scaled units; 3 future states count
    [("gaussian", 0.5, (1 + 1) / 3), ("gaussian", 0.25, (2 + 2) / 3), ("laplace", 0.5, (2 + 2) / 3)],
)
def test_rollout_likelihood(likelihood: Any, variance: float, expected: float):
    rollout = torch.zeros(1, 2, 2, 4)
    rollout[0, 0, 0, 0], rollout[0, 1, 0, 3] = 10.0, -5.0
    rollout[0, 1, 1] = 1e6  # agent 1 is gone by then
    config = replace(SILENT, likelihood=likelihood, variance=variance, rollout_weight=3.0)
    ours = terms(config, batch(), output(rollout=rollout))
    assert ours["nll_rollout"] == pytest.approx(expected)
    assert ours["total"] == pytest.approx(3.0 * expected)


def test_rollout_is_compared_with_what_followed_its_own_last_observation():
    """Windows are aligned by `last_observed`, not by the beginning of the window."""
    states = random_states(0, 2, 5, 2, 4)
    windows = WindowBatch(states, torch.ones(2, 5, 2).bool(), torch.tensor([0, 2]))
    truth = torch.stack([states[0, 1:3], states[1, 3:5]]).transpose(1, 2)
    late = torch.stack([states[0, 2:4], states[1, 3:5]]).transpose(1, 2)
    one_step = torch.cat([states[:, 1:], states[:, :1]], dim=1)  # what it says about after the end does not count
    forecaster = any_model("mlp")
    for rollout, right in ((truth, True), (late, False)):
        total, parts = window_loss(forecaster, windows, WindowOutput(one_step, rollout), SILENT)
        assert parts["nll_one_step"].item() == 0.0
        assert (total.item() == 0.0) == right


def test_no_rollout_no_term():
    ours = terms(SILENT, batch(), output(rollout=torch.zeros(1, 2, 0, 4)))
    assert "nll_rollout" not in ours and ours["total"] == 0.0


def test_one_step_counts_transitions_of_who_stays():
    """3 transitions: agent 0 twice, agent 1 once."""
    one_step = torch.zeros(1, 3, 2, 4)
    one_step[0, 1, 0, 0] = 10.0
    one_step[0, 1, 1] = one_step[0, 2] = 1e6
    ours = terms(replace(SILENT, one_step_weight=0.25), batch(), output(one_step=one_step))
    assert ours["nll_one_step"] == pytest.approx(1 / 3)
    assert ours["total"] == pytest.approx(0.25 / 3)


# --- KL ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kl_scale", [0.0, 0.25, 1.0])
def test_kl_and_its_warm_up(kl_scale: float):
    out = output(prior=logits([0.5, 0.2], [0.5, 0.5]), posterior=logits([0.5, 0.8], [0.9, 0.5]))
    expected = (binary_kl(0.8, 0.2) + binary_kl(0.9, 0.5)) / 4
    ours = terms(replace(CONFIG, kl_weight=2.0), batch(), out, kl_scale)
    assert ours["kl"] == pytest.approx(expected, rel=1e-5)  # reported in full, whatever it weighs
    assert ours["total"] == pytest.approx(2.0 * kl_scale * expected, rel=1e-5, abs=1e-6)


def test_what_the_prior_believes_is_reported():
    ours = terms(CONFIG, batch(), output(prior=logits([0.1, 0.2], [0.3, 0.8]), posterior=EVEN))
    entropy = [-p * math.log(p) - (1 - p) * math.log(1 - p) for p in (0.1, 0.2, 0.3, 0.8)]
    assert ours["prior_edge_share"] == pytest.approx(0.35)
    assert ours["prior_entropy"] == pytest.approx(np.mean(entropy), rel=1e-5)
    assert "graph_accuracy" not in ours and "label" not in ours and "type_label" not in ours


# --- Price of edges ---------------------------------------------------------------------------------------------------


def test_edges_have_a_price():
    out = output(prior=logits([0.1, 0.2], [0.3, 0.8]), posterior=logits([0.4, 0.4], [0.4, 0.8]))
    ours = terms(replace(SILENT, edge_cost=3.0), batch(), out)
    assert ours["total"] == pytest.approx(3.0 * (0.35 + 0.5), rel=1e-5)
    assert terms(SILENT, batch(), out)["total"] == pytest.approx(0.0, abs=1e-6)


def test_every_type_but_the_first_costs():
    prior = per_pair([[0.0, 0.0, 0.0]] * 2, [[100.0, 0.0, 0.0]] * 2)
    ours = terms(replace(SILENT, edge_cost=1.0), batch(), output(prior, prior))
    assert ours["total"] == pytest.approx(2 * (2 / 3 + 0) / 2, rel=1e-5)


# --- Labels -----------------------------------------------------------------------------------------------------------

UNKNOWN = [[-1, -1], [-1, -1]]
# Step 0: (0, 1) is an edge, (1, 0) is none. Step 1: (0, 1) is unknown, (1, 0) an edge. Step 2: labels of who is gone.
TYPES = [[[[-1, 1], [0, -1]], [[-1, -1], [1, -1]], [[1, 1], [1, 1]]]]


def test_type_labels_count_where_they_are_known():
    prior, posterior = logits([0.2, 0.9], [0.3, 0.4]), logits([0.6, 0.9], [0.3, 0.4])
    config = replace(SILENT, type_label_weight=2.0)
    ours = terms(config, batch(TYPES), output(prior, posterior))
    expected = (
        -(math.log(0.2) + math.log(0.7) + math.log(0.4)) / 3 - (math.log(0.6) + math.log(0.7) + math.log(0.4)) / 3
    )
    assert ours["type_label"] == pytest.approx(expected, rel=1e-5)
    assert ours["total"] == pytest.approx(2.0 * expected, rel=1e-5)
    assert ours["graph_accuracy"] == pytest.approx(1 / 3)
    without = terms(SILENT, batch(TYPES), output(prior, posterior))
    assert "type_label" not in without and without["total"] == pytest.approx(0.0, abs=1e-6)


def test_pairs_whose_edges_are_not_inferred_say_nothing():
    """A network of the nearest agents holds a constant for all other pairs."""
    types, config = [[[[0, 1], [1, 0]]] * 3], replace(SILENT, type_label_weight=1.0, edge_cost=3.0)
    prior = logits([0.8, 0.8], [0.5, 0.5])
    prior[0, :2, 1, 0] = torch.tensor([1e4, -1e4])
    inferred = torch.zeros(1, 3, 2, 2, dtype=torch.bool)
    inferred[0, :2, 0, 1] = True
    found = terms(config, batch(types), output(prior, prior)._replace(pairs=inferred))
    assert found["type_label"] == pytest.approx(-2 * math.log(0.8))
    assert found["graph_accuracy"] == 1.0 and found["prior_edge_share"] == pytest.approx(0.8)
    assert found["total"] == pytest.approx(found["type_label"] + 3.0 * 2 * 0.8)


@pytest.mark.parametrize(
    ("model", "weights", "message"),
    [
        (
            "lstm",
            {"edge_cost": 5.0, "label_weight": 1.0},
            "model lstm has no edges: set edge_cost and label_weight to 0",
        ),
        ("mlp", {"type_label_weight": 5.0}, "model mlp has no edges: set type_label_weight to 0"),
        ("dnri", {"label_weight": 5.0}, "model dnri has no edge features: set label_weight to 0"),
    ],
)
def test_weights_of_edges_need_a_model_that_infers_them(model: Any, weights: dict[str, float], message: str):
    with pytest.raises(UserError, match=message):
        replace(CONFIG, model=model, preset="fast", **weights)
    assert replace(CONFIG, model="dnri", edge_cost=1.0, type_label_weight=1.0).edge_cost == 1.0


def test_unknown_types_say_nothing():
    prior = logits([0.2, 0.9], [0.3, 0.4]).requires_grad_()
    windows = batch([[UNKNOWN] * 3])
    total, parts = window_loss(model(), windows, output(prior, EVEN), replace(SILENT, type_label_weight=1.0))
    assert (parts["type_label"].item(), parts["graph_accuracy"].item()) == (0.0, 0.0)
    total.backward()
    assert prior.grad is not None and not prior.grad.any()


def test_more_types_than_the_model_has_are_edges():
    types = [[[[-1, 2], [0, -1]], [[-1, 1], [2, -1]], UNKNOWN]]
    ours = terms(SILENT, batch(types), output(prior=logits([0.9, 0.9], [0.1, 0.9])))
    assert ours["graph_accuracy"] == 1.0


def test_attributes_count_where_there_is_an_edge():
    """Feature 0 is regressed on the attribute of pairs whose type is an edge: errors 1 and 3; feature 1 is free."""
    features = per_pair([[2.0, 50.0], [9.0, 50.0]], [[9.0, 50.0], [5.0, 50.0]])
    attributes = per_pair([[1.0], [5.0]], [[0.0], [2.0]])
    config = replace(SILENT, label_weight=0.5)
    ours = terms(config, batch(TYPES, attributes), output(features=features))
    assert ours["label"] == pytest.approx((1 + 9) / 2)
    assert ours["total"] == pytest.approx(0.5 * 5.0, rel=1e-5)
    assert "label" not in terms(SILENT, batch(TYPES, attributes), output(features=features))


def test_attributes_without_types_count_for_every_pair():
    features, attributes = per_pair([[1.0], [1.0]], [[1.0], [3.0]]), per_pair([[1.0], [1.0]], [[1.0], [1.0]])
    ours = terms(replace(SILENT, label_weight=1.0), batch(None, attributes), output(features=features))
    assert ours["label"] == pytest.approx(4 / 4)


def test_causal_attributes_count_wherever_they_are_known():
    """Also without an edge. An attribute counts by its own pairs: errors 3 (two pairs), 1 (one), none, 2 (two)."""
    features = per_pair([[0.0] * 4] * 2, [[0.0] * 4] * 2)
    unknown = math.nan
    first = [[3.0, 1.0, unknown, unknown], [unknown, unknown, unknown, 2.0]]
    attributes = per_pair(first, [[3.0, unknown, unknown, 2.0], [unknown] * 4])
    config = replace(SILENT, label_weight=0.5, causal_edges=True)
    ours = terms(config, batch(TYPES, attributes), output(features=features))
    assert ours["label"] == pytest.approx((9 + 1 + 0 + 4) / 4)
    nothing = terms(config, batch(TYPES, torch.full_like(attributes, unknown)), output(features=features))
    assert nothing["label"] == 0.0


def test_dimensions_learn_attributes_less_their_mean_over_their_spread():
    network = model(horizon_steps=2)
    labels = {"feature_labels": ("time_gap_s", "leader"), "label_means": (3.0, 0.5), "label_scales": (2.0, 0.25)}
    network.config = replace(network.config, edge_feature_dim=2, **labels)
    features, attributes = per_pair([[0.0, 0.0]] * 2, [[0.0, 0.0]] * 2), per_pair([[7.0, 1.0]] * 2, [[3.0, 0.5]] * 2)
    config = replace(SILENT, label_weight=1.0, causal_edges=True)
    _, parts = window_loss(network, batch(TYPES, attributes), output(features=features), config)
    assert parts["label"].item() == pytest.approx((4 / 2 + 4 / 2) / 2)


def test_labels_of_a_model_without_features_have_no_term():
    attributes = per_pair([[1.0], [1.0]], [[1.0], [1.0]])
    assert "label" not in terms(replace(SILENT, label_weight=1.0), batch(TYPES, attributes), output(features=None))


def test_agents_that_react_weigh_more():
    """Agent 1 has a causal edge of strength 2 from agent 0 at step 1; the other way is known to have none."""
    types = torch.full((1, 3, 2, 2), -1, dtype=torch.int8)
    types[0, 1, 1, 0], types[0, 1, 0, 1] = 1, 0
    attributes = torch.full((1, 3, 2, 2, len(CAUSAL_ATTRIBUTES)), math.nan)  # unknown, as are all but the strengths
    attributes[0, 1, 1, 0, STRENGTH], attributes[0, 1, 0, 1, STRENGTH] = 2.0, 0.5
    rollout = torch.zeros(1, 2, 1, 4)
    rollout[0, 0, 0, 0] = 10.0  # agent 0 is 1 wrong in scaled units, agent 1 is 2 wrong
    rollout[0, 1, 0, 0] = 20.0
    for now, weights in ((1, (1 / 4, 7 / 4)), (0, (1.0, 1.0))):  # 1 and 1 + 3 · 2, over their mean; not yet labelled
        windows = replace(batch(types.tolist(), attributes, now), valid=torch.ones(1, 3, 2).bool())
        out = output()._replace(rollout=rollout)
        config = replace(SILENT, likelihood="laplace", causal_edges=True, reaction_weight=3.0)
        assert terms(config, windows, out)["nll_rollout"] == pytest.approx((weights[0] * 2 + weights[1] * 4) / 2)
        plain = terms(replace(config, reaction_weight=0.0), windows, out)
        assert plain["nll_rollout"] == pytest.approx((2 + 4) / 2)


@pytest.mark.parametrize(("gone_at", "weights"), [(1, (1 / 4, 7 / 4)), (2, (1.0, 1.0))])
def test_agents_that_react_to_one_that_is_gone_weigh_more(gone_at: int, weights: tuple[float, float]):
    """Agent 2 has an edge of strength 2 to agent 1 at step 0, and is not there from a step on; step 1 is the last."""
    types = torch.full((1, 3, 3, 3), -1, dtype=torch.int8)
    attributes = torch.full((1, 3, 3, 3, len(CAUSAL_ATTRIBUTES)), math.nan)
    types[0, 0, 1, 2], attributes[0, 0, 1, 2, STRENGTH] = 1, 2.0
    valid = torch.ones(1, 3, 3).bool()
    valid[0, gone_at:, 2] = False
    windows = WindowBatch(torch.zeros(1, 3, 3, 4), valid, torch.tensor([1]), types, attributes)
    assert reaction_weights(windows, 3.0, has_ego=False)[0, :2].tolist() == pytest.approx(weights)


@pytest.mark.parametrize(("has_ego", "weights"), [(False, (7 / 4, 1 / 4)), (True, (1.0, 1.0))])
def test_edges_to_an_ego_give_it_no_weight(has_ego: bool, weights: tuple[float, float]):
    """Agent 0 has an edge of strength 2 from agent 1: if it is an ego, that is an edge of a driver in its place."""
    types = torch.full((1, 3, 2, 2), -1, dtype=torch.int8)
    attributes = torch.full((1, 3, 2, 2, len(CAUSAL_ATTRIBUTES)), math.nan)
    types[0, 1, 0, 1], attributes[0, 1, 0, 1, STRENGTH] = 1, 2.0
    windows = WindowBatch(torch.zeros(1, 3, 2, 4), torch.ones(1, 3, 2).bool(), torch.tensor([1]), types, attributes)
    assert reaction_weights(windows, 3.0, has_ego)[0].tolist() == pytest.approx(weights)
    rollout = torch.zeros(1, 2, 1, 4)
    rollout[0, 0, 0, 0], rollout[0, 1, 0, 0] = 10.0, 20.0  # in scaled units 1 and 2 wrong, which cost 2 and 4
    config = replace(SILENT, likelihood="laplace", causal_edges=True, reaction_weight=3.0)
    _, parts = window_loss(model(has_ego=has_ego), windows, output()._replace(rollout=rollout), config)
    assert float(parts["nll_rollout"]) == pytest.approx((weights[0] * 2 + weights[1] * 4) / 2)


def test_the_weight_of_reactions_needs_causal_labels():
    with pytest.raises(UserError, match="reaction_weight needs the causal labels of branches; pass --causal-edges"):
        replace(SILENT, reaction_weight=1.0)


# --- Models without a graph -------------------------------------------------------------------------------------------


def test_without_a_graph_only_the_likelihoods_count():
    rollout = torch.zeros(1, 2, 2, 4)
    rollout[0, 0, 0, 0] = 10.0
    config = replace(CONFIG, kl_weight=5.0, edge_cost=5.0, label_weight=5.0, type_label_weight=5.0)
    windows = batch(TYPES, per_pair([[1.0], [1.0]], [[1.0], [1.0]]))
    ours = terms(config, windows, output(prior=None, posterior=None, rollout=rollout))
    assert ours.keys() == {"total", "nll_one_step", "nll_rollout"}
    assert ours["total"] == pytest.approx(1 / 3)


def test_terms_are_for_reading_only():
    """The objective carries the gradient, its terms do not."""
    prior = logits([0.2, 0.9], [0.3, 0.4]).requires_grad_()
    config = replace(CONFIG, edge_cost=1.0, type_label_weight=1.0)
    total, parts = window_loss(model(), batch(TYPES), output(prior, EVEN), config)
    assert total.requires_grad and not any(part.requires_grad for part in parts.values())


def test_an_unknown_likelihood_is_named():
    unchecked: Any = inspect.unwrap(nll)  # shape checks would refuse it first
    states = torch.zeros(2, 4)
    with pytest.raises(UserError, match="likelihood must be one of gaussian, laplace, got 'gausian'"):
        unchecked(states, states, torch.tensor([True, True]), torch.ones(4), 1.0, "gausian")
