import numpy as np
import pytest
import torch
from gymnasium import spaces

from agents.features import AttentionConfig, ForecastAttention
from predictor.errors import UserError

BATCH, AGENTS, HORIZON, FEATURES = 3, 5, 4, 6
SHAPES = {
    "observation": (5, 5),
    "agents": (AGENTS, 4),
    "forecast": (AGENTS, HORIZON, 2),
    "edge_probs": (AGENTS, 2),
    "edge_features": (AGENTS, 2 * FEATURES),
    "valid": (AGENTS,),
}


def make_space(shapes: dict[str, tuple[int, ...]]) -> spaces.Dict:
    return spaces.Dict({k: spaces.Box(-np.inf, np.inf, s, np.float32) for k, s in shapes.items()})


def make_observations(shapes: dict[str, tuple[int, ...]], seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    observations = {k: 20 * torch.randn(BATCH, *s, generator=generator) for k, s in shapes.items()}
    observations["observation"] /= 20
    if "valid" in shapes:
        observations["valid"] = torch.ones(BATCH, *shapes["valid"])
    return observations


def make_extractor(shapes: dict[str, tuple[int, ...]]) -> ForecastAttention:
    torch.manual_seed(0)
    extractor = ForecastAttention(make_space(shapes))
    with torch.no_grad():
        extractor.null_token.normal_()
    return extractor


def permuted(observations: dict[str, torch.Tensor], order: list[int]) -> dict[str, torch.Tensor]:
    return {k: v if k == "observation" else v[:, order] for k, v in observations.items()}


def test_size_is_ego_and_attended():
    extractor = make_extractor(SHAPES)
    assert extractor(make_observations(SHAPES)).shape == (BATCH, extractor.features_dim) == (BATCH, 128)


def test_order_of_agents_does_not_matter():
    extractor, observations = make_extractor(SHAPES), make_observations(SHAPES)
    observations["valid"][1, 3:] = 0
    torch.testing.assert_close(extractor(permuted(observations, [4, 2, 0, 3, 1])), extractor(observations))


def test_padded_rows_change_nothing_whatever_they_hold():
    extractor, observations = make_extractor(SHAPES), make_observations(SHAPES)
    observations["valid"][:, 3:] = 0
    expected = extractor(observations)
    for key in ("agents", "forecast", "edge_probs", "edge_features"):
        observations[key][:, 3:] = torch.nan
    torch.testing.assert_close(extractor(observations), expected)


def test_padding_equals_a_smaller_scene():
    extractor, observations = make_extractor(SHAPES), make_observations(SHAPES)
    observations["valid"][:, 3:] = 0
    torch.testing.assert_close(extractor(permuted(observations, [0, 1, 2])), extractor(observations))


def test_a_valid_agent_does_change_something():
    extractor, observations = make_extractor(SHAPES), make_observations(SHAPES)
    before = extractor(observations)
    observations["forecast"][:, 2] += 5.0
    assert (extractor(observations) - before).abs().max() > 1e-3


def test_empty_scene_is_finite_with_finite_gradients():
    extractor, observations = make_extractor(SHAPES), make_observations(SHAPES)
    observations["valid"][:] = 0
    features = extractor(observations)
    features.sum().backward()
    assert features.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in extractor.parameters())
    assert extractor.null_token.grad is not None


@pytest.mark.parametrize("key", ["agents", "forecast", "edge_probs", "edge_features"])
def test_gradient_reaches_every_token_input(key: str):
    extractor, observations = make_extractor(SHAPES), make_observations(SHAPES)
    observations[key].requires_grad_()
    extractor(observations).square().sum().backward()
    gradient = observations[key].grad
    assert gradient is not None
    assert (gradient.flatten(2).abs().sum(-1) > 0).all()


@pytest.mark.parametrize(
    "keys",
    [
        ("observation",),
        ("observation", "agents", "valid"),
        ("observation", "forecast", "valid"),
        ("observation", "edge_probs", "edge_features"),
        ("observation", "valid"),
    ],
    ids="+".join,
)
def test_any_subset_of_token_keys_works(keys: tuple[str, ...]):
    shapes = {k: SHAPES[k] for k in keys}
    assert make_extractor(shapes)(make_observations(shapes)).isfinite().all()


def test_several_samples_are_read():
    shapes = SHAPES | {"forecast": (AGENTS, 3, HORIZON, 2)}
    extractor, observations = make_extractor(shapes), make_observations(shapes)
    before = extractor(observations)
    observations["forecast"][:, :, 2] += 5.0
    assert (extractor(observations) - before).abs().max() > 1e-3


def test_missing_observation_is_named():
    with pytest.raises(UserError, match="needs a Dict with the key 'observation', got Dict\\('agents'"):
        ForecastAttention(make_space({"agents": (AGENTS, 4)}))


def test_heads_must_divide_width():
    assert AttentionConfig(width=8, heads=4).width == 8
    with pytest.raises(UserError, match="multiple of heads"):
        AttentionConfig(width=6, heads=4)
