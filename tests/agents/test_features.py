from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from agents.features import EGO_PATH, TOKEN_KEYS, VALID_KEY, AttentionConfig, ForecastAttention
from agents.task import Task
from agents.training import TrainingPlan, make_model
from agents.vec_envs import make_venv
from envs import SceneObservation, VecForecast
from envs.entries import FORECAST_KEYS, PATH_KEYS, UNCERTAINTY_KEYS, WHAT_IF_KEYS
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

BATCH, AGENTS, HORIZON, FEATURES = 3, 5, 4, 6
SHAPES = {
    "observation": (5, 5),
    "agents": (AGENTS, 4),
    "forecast": (AGENTS, HORIZON, 2),
    "edge_probs": (AGENTS, 2),
    "edge_features": (AGENTS, 2 * FEATURES),
    "valid": (AGENTS,),
}
UNCERTAIN = SHAPES | {
    "forecast": (AGENTS, 3, HORIZON, 2),
    "ego_path": (HORIZON, 2),
    "closest": (AGENTS, 2),
    "mode_probs": (AGENTS, 3),
    "xy_scale": (AGENTS, 3, HORIZON, 2),
    "what_if_gap": (AGENTS, 2),
    "what_if_contact": (AGENTS, 2),
    "what_if_risk": (AGENTS, 2),
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


def make_extractor(shapes: dict[str, tuple[int, ...]], config: AttentionConfig | None = None) -> ForecastAttention:
    torch.manual_seed(0)
    extractor = ForecastAttention(make_space(shapes), config)
    with torch.no_grad():
        extractor.null_token.normal_()
        extractor.gain.uniform_(0.5, 1.5)  # at 0, where it begins, only the own observation would be passed on
    return extractor


def permuted(observations: dict[str, torch.Tensor], order: list[int]) -> dict[str, torch.Tensor]:
    return {k: v if k in ("observation", "ego_path") else v[:, order] for k, v in observations.items()}


def test_size_is_own_observation_and_attended():
    extractor = make_extractor(SHAPES)
    assert extractor(make_observations(SHAPES)).shape == (BATCH, extractor.features_dim) == (BATCH, 25 + 64)


def test_learning_begins_with_the_own_observation_alone():
    """As without forecasts; the first gradient step lets the rest in."""
    extractor, observations = ForecastAttention(make_space(SHAPES)), make_observations(SHAPES)
    features = extractor(observations)
    torch.testing.assert_close(features[:, :25], observations["observation"].flatten(1), rtol=0, atol=0)
    assert not features[:, 25:].any()
    features.sum().backward()
    assert extractor.gain.grad is not None and extractor.gain.grad.abs().max() > 1e-3


def by_loop(extractor: ForecastAttention, observations: dict[str, torch.Tensor]) -> torch.Tensor:
    """Computes the features, one env and one agent at a time: tokens, keys, values and weights as in the textbook."""
    config, features = extractor.config, []
    for b in range(BATCH):
        ego = extractor.ego(observations["observation"][b].flatten())
        tokens = [extractor.null_token]
        for a in range(AGENTS):
            if "valid" in observations and not observations["valid"][b, a]:
                continue
            now, motion = observations["agents"][b, a, :2], observations["agents"][b, a, 2:]
            forecast = observations["forecast"][b, a].flatten(0, -2)
            parts = [torch.tanh(now / config.near_m), now / config.far_m, motion / config.speed_mps]
            path = observations[EGO_PATH][b].repeat(3, 1) if EGO_PATH in observations else 0.0
            for places in (forecast - path, forecast - now):
                parts.append(torch.cat([torch.tanh(places / config.near_m), places / config.far_m], -1).flatten())
            if "xy_scale" in observations:
                parts.append(torch.tanh(observations["xy_scale"][b, a] / config.near_m).flatten())
            if "closest" in observations:
                distance, time = observations["closest"][b, a].split(1)
                parts += [torch.tanh(distance / config.near_m), distance / config.far_m, time]
            if "what_if_gap" in observations:
                gap = observations["what_if_gap"][b, a]
                parts += [torch.tanh(gap / config.near_m), gap / config.far_m]
            if "xy_scale" in observations:
                parts.append(observations["mode_probs"][b, a].flatten())
            parts += [observations["edge_probs"][b, a], observations["edge_features"][b, a]]
            if "what_if_gap" in observations:
                parts += [observations["what_if_contact"][b, a], observations["what_if_risk"][b, a]]
            hidden = extractor.token_in(torch.cat(parts)) + extractor.token_ego(ego)
            tokens.append(extractor.token_out(hidden))
        tokens = torch.stack(tokens)
        projected = extractor.query(ego), extractor.key(tokens), extractor.value(tokens)
        heads = [
            torch.softmax(key @ query / len(query) ** 0.5, dim=0) @ value
            for query, key, value in zip(*(p.chunk(config.heads, dim=-1) for p in projected), strict=True)
        ]
        attended = extractor.gain * extractor.attended(torch.cat(heads))
        features.append(torch.cat([observations["observation"][b].flatten(), attended]))
    return torch.stack(features)


@pytest.mark.parametrize("absent", [0, 1, AGENTS], ids=lambda n: f"{n} absent")
@pytest.mark.parametrize(
    "shapes",
    [SHAPES, SHAPES | {"forecast": (AGENTS, 3, HORIZON, 2)}, UNCERTAIN],
    ids=["0 sample axes", "1 sample axes", "uncertain"],
)
def test_features_and_gradients_equal_a_plain_loop(absent: int, shapes: dict[str, tuple[int, ...]]):
    extractor, observations = make_extractor(shapes), make_observations(shapes)
    observations["valid"][1, 1 : 1 + absent] = 0
    observations["valid"][2, :absent] = 0
    results = []
    for features in (extractor(observations), by_loop(extractor, observations)):
        extractor.zero_grad()
        (features * torch.linspace(-1, 1, features.shape[1])).square().sum().backward()
        results.append((features.detach(), {n: p.grad for n, p in extractor.named_parameters() if p.grad is not None}))
    (features, gradients), (expected, expected_gradients) = results
    torch.testing.assert_close(features, expected, rtol=1e-5, atol=1e-5)
    # a key's bias adds the same to all logits: rounding is all that the loop finds there
    assert expected_gradients.pop("key.bias").abs().max() < 1e-5
    assert set(gradients) == set(expected_gradients) == {n for n, _ in extractor.named_parameters()} - {"key.bias"}
    torch.testing.assert_close(gradients, expected_gradients, rtol=1e-4, atol=1e-4)


def test_order_of_agents_does_not_matter():
    extractor, observations = make_extractor(SHAPES), make_observations(SHAPES)
    observations["valid"][1, 3:] = 0
    torch.testing.assert_close(extractor(permuted(observations, [4, 2, 0, 3, 1])), extractor(observations))


def test_padded_agents_change_nothing_whatever_they_hold():
    extractor, observations = make_extractor(UNCERTAIN), make_observations(UNCERTAIN)
    observations["valid"][:, 3:] = 0
    expected = extractor(observations)
    for key in TOKEN_KEYS:
        observations[key][:, 3:] = torch.nan
    torch.testing.assert_close(extractor(observations), expected)


def test_padding_equals_a_smaller_scene():
    extractor, observations = make_extractor(SHAPES), make_observations(SHAPES)
    observations["valid"][:, 3:] = 0
    torch.testing.assert_close(extractor(permuted(observations, [0, 1, 2])), extractor(observations))


def test_forecasts_count_from_where_the_ego_then_is():
    """An agent that keeps pace with the ego is a constant, wherever both are going."""
    extractor, observations = make_extractor(UNCERTAIN), make_observations(UNCERTAIN)
    present = {key: observations[key][0, :1] for key in TOKEN_KEYS} | {EGO_PATH: observations[EGO_PATH][0][None]}
    before = extractor._token_inputs(present)
    further = torch.tensor([30.0, 4.0]) * torch.arange(1, HORIZON + 1)[:, None]
    moved = present | {EGO_PATH: present[EGO_PATH] + further, "forecast": present["forecast"] + further}
    changed = ((extractor._token_inputs(moved) - before).abs() > 1e-4).sum()
    own = extractor._squash(present["forecast"]).numel()
    assert 0 < changed <= own  # the displacement from now alone; not what is relative to the ego's path


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


def test_every_entry_of_the_wrappers_is_read():
    """One that is added to the wrappers alone would change no policy, without a word."""
    assert {*TOKEN_KEYS, VALID_KEY, EGO_PATH} == {*FORECAST_KEYS, *PATH_KEYS, *UNCERTAINTY_KEYS, *WHAT_IF_KEYS}


def test_a_new_token_key_is_read(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("agents.features.TOKEN_KEYS", (*TOKEN_KEYS, "brake_lights"))
    shapes = SHAPES | {"brake_lights": (AGENTS, 2)}
    extractor, observations = make_extractor(shapes), make_observations(shapes)
    before = extractor(observations)
    observations["brake_lights"] += 1.0
    assert (extractor(observations) - before).abs().max() > 1e-3


@pytest.mark.parametrize("key", TOKEN_KEYS)
def test_gradient_reaches_every_token_input(key: str):
    extractor, observations = make_extractor(UNCERTAIN), make_observations(UNCERTAIN)
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


@pytest.mark.parametrize("key", ["mode_probs", "xy_scale"])
def test_how_likely_and_how_uncertain_a_future_is_are_read(key: str):
    extractor, observations = make_extractor(UNCERTAIN), make_observations(UNCERTAIN)
    observations["mode_probs"] = torch.softmax(observations["mode_probs"] / 20, dim=-1)
    observations["xy_scale"] = observations["xy_scale"].abs()
    before = extractor(observations)
    observations[key] = observations[key].roll(1, dims=2)  # the same numbers, of other futures
    assert (extractor(observations) - before).abs().amax(1).min() > 1e-3


def test_missing_observation_is_named():
    with pytest.raises(UserError, match="needs a Dict with the key 'observation', or .* got Dict\\('agents'"):
        ForecastAttention(make_space({"agents": (AGENTS, 4)}))


def test_the_own_entries_of_a_dict_are_read_flattened():
    shapes = {key: shape for key, shape in SHAPES.items() if key != "observation"} | {"goal": (2,), "table": (3, 4)}
    extractor, observations = ForecastAttention(make_space(shapes)), make_observations({**shapes, "observation": (1,)})
    features = extractor(observations)
    own = torch.cat([observations["goal"], observations["table"].flatten(1)], dim=1)
    torch.testing.assert_close(features[:, :14], own, rtol=0, atol=0)
    assert features.shape[1] == extractor.features_dim == 14 + 64


def test_scales_on_roads_are_those_of_the_default():
    assert AttentionConfig.for_scenes(SceneSpec(dt_s=1.0)) == AttentionConfig()
    assert TrainingPlan(Task("highway-fast-v0"), "ppo", 1, 1, 0).attention == AttentionConfig()


def test_scales_in_a_small_arena_are_small():
    config = TrainingPlan(Task("simple_tag_v3"), "ppo", 1, 1, 0).attention
    assert (config.near_m, config.far_m, config.speed_mps) == (0.1, 0.5, 1.0)
    assert TrainingPlan(Task("simple_tag_v3", "none"), "ppo", 1, 1, 0).attention == AttentionConfig()


def test_features_depend_on_a_place_relative_to_the_scale_of_its_scene():
    """An arena a hundredth the size of a road, seen at its own scale, gives the features of the road."""
    arena = SceneSpec(dt_s=0.1, feature_scales=(1.0, 1.0, 0.3, 0.3))
    road, small = make_extractor(SHAPES), make_extractor(SHAPES, AttentionConfig.for_scenes(arena))
    observations = make_observations(SHAPES)
    shrunk = {k: v / 100 if k in ("agents", "forecast") else v for k, v in observations.items()}
    torch.testing.assert_close(small(shrunk), road(observations), rtol=1e-5, atol=1e-5)
    assert (road(shrunk) - road(observations)).abs().max() > 1e-2


def test_scales_travel_in_the_zip(tmp_path: Path):
    task = Task("simple_tag_v3", "constant-velocity", learners=("adversary",))
    venv = make_venv(task, 1)
    make_model(TrainingPlan(task, "ppo", 1, 1, 0), venv).save(tmp_path / "policy.zip")
    venv.close()
    extractor = PPO.load(tmp_path / "policy.zip", device="cpu").policy.features_extractor
    assert isinstance(extractor, ForecastAttention)
    assert (extractor.config.near_m, extractor.config.far_m, extractor.config.speed_mps) == (0.1, 0.5, 1.0)


def test_further_features_are_divided_by_their_scales(tmp_path: Path):
    names = (*SceneSpec(dt_s=0.1).feature_names, "z_m", "load_kg")
    spec = SceneSpec(dt_s=0.1, feature_names=names, feature_scales=(100.0, 100.0, 30.0, 30.0, 3000.0, 2.0))
    shapes = SHAPES | {"agents": (AGENTS, 6)}
    config = AttentionConfig.for_scenes(spec)
    assert config == AttentionConfig(more_scales=(3000.0, 2.0))
    scaled, plain = make_extractor(shapes, config), make_extractor(shapes)
    observations = make_observations(shapes)
    large = observations | {"agents": observations["agents"] * torch.tensor([1, 1, 1, 1, 3000.0, 2.0])}
    torch.testing.assert_close(scaled(large), plain(observations), rtol=1e-5, atol=1e-5)
    assert scaled.state_dict().keys() == plain.state_dict().keys(), "files of before can be read"
    with pytest.raises(UserError, match=r"more_scales must be one for each of 2 further features, got \(2.0,\)"):
        make_extractor(shapes, AttentionConfig(more_scales=(2.0,)))
    plain_spec = SceneSpec(dt_s=0.1, feature_names=names, feature_scales=(100.0, 100.0, 30.0, 30.0, 1.0, 1.0))
    assert AttentionConfig.for_scenes(plain_spec) == AttentionConfig()


def test_own_observations_of_several_choices_have_a_size_that_torch_takes():
    space = spaces.Dict({"vec": spaces.Box(-1, 1, (2,)), "pair": spaces.MultiDiscrete([3, 4])})
    size = ForecastAttention(spaces.Dict({**space.spaces, **make_space({"valid": (AGENTS,)}).spaces})).features_dim
    assert type(size) is int and size == 2 + 7 + 64


def test_heads_must_divide_width():
    assert AttentionConfig(width=8, heads=4).width == 8
    with pytest.raises(UserError, match="multiple of heads"):
        AttentionConfig(width=6, heads=4)


@pytest.mark.parametrize("scale", ["near_m", "far_m", "speed_mps"])
@pytest.mark.parametrize("value", [0.0, -1.0])
def test_scales_must_be_positive(scale: str, value: float):
    with pytest.raises(UserError, match="scales must be positive, got "):
        AttentionConfig(**{scale: value})


def vector(outer: Callable[[Any], Any]) -> Any:
    """Returns two highways with forecasts, in a wrapper of Stable-Baselines3."""
    inner = make_vec_env("highway-fast-v0", 2, seed=0, wrapper_class=SceneObservation)
    return outer(VecForecast(inner, "constant-velocity"))


def ppo(venv: Any) -> PPO:
    kwargs = {"features_extractor_class": ForecastAttention, "net_arch": [4]}
    return PPO("MultiInputPolicy", venv, n_steps=8, batch_size=8, n_epochs=1, policy_kwargs=kwargs)


def test_agents_that_a_wrapper_has_scaled_away_are_named():
    """VecNormalize makes an entry that is always 1 a 0: the network saw no agent, and nothing was said."""
    with pytest.raises(UserError, match=r"valid must be 0 or 1: .*with VecNormalize, pass norm_obs_keys"):
        ppo(vector(VecNormalize)).learn(32)
    ppo(vector(lambda venv: VecNormalize(venv, norm_obs_keys=["observation"]))).learn(16)


def test_entries_that_a_wrapper_has_stacked_are_named():
    with pytest.raises(UserError, match=r"entries as the wrapper gives them, .*leave out what stacks .*VecFrameStack"):
        ppo(vector(lambda venv: VecFrameStack(venv, 2)))


def test_one_further_feature_with_a_scale_is_enough_for_all_to_be_kept():
    names = (*SceneSpec(dt_s=0.1).feature_names, "z_m", "role")
    spec = SceneSpec(dt_s=0.1, feature_names=names, feature_scales=(100.0, 100.0, 30.0, 30.0, 3000.0, 1.0))
    assert AttentionConfig.for_scenes(spec).more_scales == (3000.0, 1.0)
