from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from envs.entries import (
    FORECAST_KEYS,
    PATH_KEYS,
    ego_entries,
    entry_spaces,
    into_ego_axes,
    others_by_distance,
    path_entries,
)
from envs.observation import (
    SCENE_KEYS,
    ForecastConfig,
    ForecastStream,
    carries_scenes,
    open_forecaster,
    require_scenes,
    require_scenes_of,
    scene_entries,
    scene_spaces,
    scenes_from,
)
from envs.readers import reader_for
from envs.registry import CHECKPOINTS, make_env
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import CheckpointInfo, load_forecaster, resolve, save_checkpoint, shipped
from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from predictor.support.errors import UserError
from tests.envs.helpers import (
    HIGHWAY_SPEC,
    HORIZON,
    MAP_SPEC,
    TOLERANCE,
    assert_same,
    largest_difference,
    random_forecast,
    random_scenes,
    save_tiny,
    tiny_model,
)


def entries_by_loop(scenes: SceneBatch, forecast: Forecast) -> dict[str, np.ndarray]:
    """`ego_entries`, one number at a time."""
    batch, agents, features = scenes.states.shape
    samples, horizon = forecast.xy.shape[1], forecast.xy.shape[3]
    types, size = forecast.edge_probs.shape[-1], forecast.edge_features.shape[-1]
    out = {
        "agents": np.zeros((batch, agents - 1, features)),
        "forecast": np.zeros((batch, agents - 1, samples, horizon, 2)),
        "edge_probs": np.zeros((batch, agents - 1, 2 * (types - 1))),
        "edge_features": np.zeros((batch, agents - 1, 2 * size)),
        "valid": np.zeros((batch, agents - 1)),
    }
    for b in range(batch):
        angle = scenes.heading_rad[b]
        ego = scenes.states[b, 0]

        def turn(x: float, y: float, angle: float = angle) -> tuple[float, float]:
            """The same vector, seen from axes that are turned by the ego's heading."""
            return x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)

        present = [a for a in range(1, agents) if scenes.valid[b, a]]
        present.sort(key=lambda a, b=b, ego=ego: np.hypot(*(scenes.states[b, a, :2] - ego[:2])))
        for place, a in enumerate(present):
            x, y, vx, vy = scenes.states[b, a, :4] - ego[:4]
            out["agents"][b, place] = [*turn(x, y), *turn(vx, vy), *scenes.states[b, a, 4:]]
            for k in range(samples):
                for h in range(horizon):
                    out["forecast"][b, place, k, h] = turn(*forecast.xy[b, k, a, h].tolist())
            out["edge_probs"][b, place] = [*forecast.edge_probs[b, 0, a, 1:], *forecast.edge_probs[b, a, 0, 1:]]
            out["edge_features"][b, place] = [*forecast.edge_features[b, 0, a], *forecast.edge_features[b, a, 0]]
            out["valid"][b, place] = 1
    if samples == 1:
        out["forecast"] = out["forecast"][:, :, 0]
    return out


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**16),
    batch=st.integers(1, 3),
    agents=st.integers(1, 6),
    samples=st.integers(1, 3),
    types=st.integers(2, 4),
    features=st.integers(4, 6),
)
def test_entries_equal_a_plain_loop(seed: int, batch: int, agents: int, samples: int, types: int, features: int):
    rng = np.random.default_rng(seed)
    scenes = random_scenes(rng, batch, agents, features)
    forecast = random_forecast(rng, scenes, samples, 3, types, 2)
    entries = ego_entries(scenes, forecast)
    assert_same(entries, entries_by_loop(scenes, forecast))
    assert tuple(entries) == FORECAST_KEYS
    assert {value.dtype for value in entries.values()} == {np.dtype(np.float32)}


def one_scene(
    *others: tuple[float, float, float, float], ego: Any = (0, 0, 0, 0), heading_rad: float = 0
) -> SceneBatch:
    states = np.array([ego, *others], dtype=np.float64)
    valid = np.ones(len(states), dtype=np.bool_)
    return SceneBatch.stack([Scene(states, np.arange(len(states)), valid, float(heading_rad))])


def straight(scenes: SceneBatch, horizon: int = 2) -> dict[str, np.ndarray]:
    """What the ego sees of constant velocity."""
    spec = SceneSpec(dt_s=1.0, max_agents=scenes.valid.shape[1])
    return ForecastStream(ConstantVelocity(spec, horizon), spec, 1, ForecastConfig()).observe(scenes)


def test_heading_north_turns_ahead_into_x():
    """The ego drives north at 10 m/s; 30 m ahead someone drives east at 5 m/s."""
    scenes = one_scene((100, 230, 5, 0), ego=(100, 200, 0, 10), heading_rad=np.pi / 2)
    entries = straight(scenes)
    np.testing.assert_allclose(entries["agents"][0], [[30, 0, -10, -5]], atol=1e-5)
    np.testing.assert_allclose(entries["forecast"][0, 0], [[30, -5], [30, -10]], atol=1e-5)


def test_forecast_counts_from_where_the_ego_is_now():
    """Both drive east at 20 m/s, 10 m apart: in a frame that stays behind, the other gains 20 m per step."""
    entries = straight(one_scene((10, 4, 20, 0), ego=(0, 0, 20, 0)))
    np.testing.assert_allclose(entries["agents"][0], [[10, 4, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(entries["forecast"][0, 0], [[30, 4], [50, 4]], atol=1e-5)


def test_edges_read_agent_to_ego_before_ego_to_agent():
    """Pairs are (receiver, sender): index 0 of the graph is what the ego receives."""
    scenes = one_scene((20, 0, 0, 0), (10, 0, 0, 0))
    probs = torch.zeros(1, 3, 3, 2)
    features = torch.zeros(1, 3, 3, 1)
    probs[0, 0, 1, 1], probs[0, 1, 0, 1] = 0.1, 0.2  # from agent 1 to the ego; from the ego to agent 1
    probs[0, 0, 2, 1], probs[0, 2, 0, 1] = 0.3, 0.4
    features[0, 0, 1], features[0, 1, 0], features[0, 0, 2], features[0, 2, 0] = 1.0, 2.0, 3.0, 4.0
    forecast = Forecast(torch.zeros(1, 1, 3, 2, 2), probs, features, torch.from_numpy(scenes.valid))
    entries = ego_entries(scenes, forecast)
    np.testing.assert_allclose(entries["edge_probs"][0], [[0.3, 0.4], [0.1, 0.2]])
    np.testing.assert_allclose(entries["edge_features"][0], [[3, 4], [1, 2]])


def test_padding_is_zero_whatever_the_forecast_holds():
    rng = np.random.default_rng(0)
    scenes = random_scenes(rng, 2, 5, present=[1, 3])
    forecast = random_forecast(rng, scenes, 2, 3, 2, 4)
    absent = ~torch.from_numpy(scenes.valid)
    forecast.xy.transpose(1, 2)[absent] = forecast.edge_probs[absent] = forecast.edge_features[absent] = torch.nan
    entries = ego_entries(scenes, forecast)
    assert entries["valid"].tolist() == [[0, 0, 0, 0], [1, 1, 0, 0]]
    for value in entries.values():
        assert (value[0] == 0).all()
        assert (value[1, 2:] == 0).all()
        assert (value[1, :2] != 0).all()


def test_one_sample_drops_the_axis():
    rng = np.random.default_rng(0)
    scenes = random_scenes(rng, 2, 4)
    assert ego_entries(scenes, random_forecast(rng, scenes, 1, 3, 2, 4))["forecast"].shape == (2, 3, 3, 2)
    assert ego_entries(scenes, random_forecast(rng, scenes, 5, 3, 2, 4))["forecast"].shape == (2, 3, 5, 3, 2)


def test_ego_axes_closed_form():
    north, west = into_ego_axes(np.array([np.pi / 2, np.pi]))
    np.testing.assert_allclose(north @ [0, 1], [1, 0], atol=1e-12)
    np.testing.assert_allclose(west @ [0, 1], [0, -1], atol=1e-12)
    np.testing.assert_allclose(north.T @ north, np.eye(2), atol=1e-12)


@pytest.mark.shapes
def test_shapes_execute():
    rng = np.random.default_rng(0)
    scenes = random_scenes(rng, 2, 4)
    forecast = random_forecast(rng, scenes, 3, 5, 2, 4)
    with pytest.raises(TypeCheckError, match="xy"):
        replace(forecast, xy=forecast.xy.transpose(1, 2))
    with pytest.raises(TypeCheckError, match="into_ego_axes"):
        into_ego_axes(scenes.heading_rad[:, None])


def test_order_skips_padding_that_lies_nearer():
    states = np.zeros((1, 4, 4))
    states[0, 1, 0], states[0, 3, 0] = 50.0, 20.0
    valid = np.array([[True, True, False, True]])
    order = others_by_distance(SceneBatch(states, np.array([[0, 1, -1, 3]]), valid, np.zeros(1)))
    assert order.tolist() == [[2, 0, 1]]


# --- ForecastStream: the semantics of DESIGN.md as a policy meets them ------------------------------------------------


def stream(spec: SceneSpec, envs: int = 1, **config: Any) -> ForecastStream:
    return ForecastStream(tiny_model(spec), spec, envs, ForecastConfig(**config))


def drive(rng: np.random.Generator, batch: int, steps: int, agents: int = 6, present: Any = None) -> list[SceneBatch]:
    """Scenes in which each agent keeps an id and moves a little."""
    first = random_scenes(rng, batch, agents, present=present)
    scenes = [first]
    for _ in range(steps - 1):
        moved = scenes[-1].states + rng.normal(size=first.states.shape) * first.valid[..., None]
        scenes.append(replace(first, states=moved))
    return scenes


def shifted(scenes: SceneBatch, x_m: float, y_m: float) -> SceneBatch:
    states = scenes.states.copy()
    states[..., :2] += np.array([x_m, y_m]) * scenes.valid[..., None]
    return replace(scenes, states=states)


@pytest.mark.parametrize(
    ("spec", "x_m", "y_m", "changes"),
    [
        (HIGHWAY_SPEC, 10_000.0, 0.0, False),
        (HIGHWAY_SPEC, 0.0, 50.0, True),
        (MAP_SPEC, 50.0, 0.0, True),
        (replace(HIGHWAY_SPEC, frame=("ego", "ego")), 10_000.0, -10_000.0, False),
    ],
    ids=["highway-10km", "highway-other-lanes", "map", "open-plane"],
)
def test_a_shift_matters_only_where_there_is_a_map(spec: SceneSpec, x_m: float, y_m: float, changes: bool):
    scenes = drive(np.random.default_rng(0), batch=2, steps=3)
    here, there = stream(spec, 2), stream(spec, 2)
    for scene in scenes:
        expected, actual = here.observe(scene), there.observe(shifted(scene, x_m, y_m))
        if not changes:
            assert_same(actual, expected)
        else:
            assert largest_difference(actual, expected) > 100 * TOLERANCE


def test_more_padding_changes_nothing():
    scenes = drive(np.random.default_rng(1), batch=2, steps=3, agents=4, present=[3, 1])
    narrow, wide = stream(replace(HIGHWAY_SPEC, max_agents=4), 2), stream(replace(HIGHWAY_SPEC, max_agents=9), 2)
    for scene in scenes:
        pad = ((0, 0), (0, 5))
        padded = SceneBatch(
            np.pad(scene.states, (*pad, (0, 0))),
            np.pad(scene.ids, pad, constant_values=-1),
            np.pad(scene.valid, pad),
            scene.heading_rad,
        )
        expected, actual = narrow.observe(scene), wide.observe(padded)
        assert_same({key: value[:, :3] for key, value in actual.items()}, expected)
        assert all((value[:, 3:] == 0).all() for value in actual.values())


def test_ego_alone_is_an_empty_observation():
    for spec in (HIGHWAY_SPEC, replace(HIGHWAY_SPEC, max_agents=1)):
        scenes = drive(np.random.default_rng(2), batch=1, steps=2, agents=spec.max_agents, present=[1])
        alone = stream(spec)
        for scene in scenes:
            entries = alone.observe(scene)
            assert entries["valid"].shape == (1, spec.max_agents - 1)
            assert all((value == 0).all() for key, value in entries.items() if key != "ego_path")


def test_memory_follows_ids_when_agents_are_sorted_anew():
    rng = np.random.default_rng(3)
    scenes = drive(rng, batch=2, steps=4, present=[6, 6])
    fixed, sorted_anew = stream(HIGHWAY_SPEC, 2), stream(HIGHWAY_SPEC, 2)
    by_place = stream(HIGHWAY_SPEC, 2)
    for scene in scenes:
        order = np.concatenate([[0], 1 + rng.permutation(5)])
        moved = SceneBatch(scene.states[:, order], scene.ids[:, order], scene.valid[:, order], scene.heading_rad)
        expected, actual = fixed.observe(scene), sorted_anew.observe(moved)
        assert_same(actual, expected)
        wrong = by_place.observe(replace(moved, ids=scene.ids))
    assert largest_difference(wrong, expected) > 100 * TOLERANCE  # places for ids would have been noticed


def test_a_newcomer_inherits_nothing_from_the_leaver_of_its_place():
    """An edge's features come from the memory of its pair alone: a newcomer's are those of a first sight."""
    scenes = drive(np.random.default_rng(9), batch=1, steps=3, present=[3])
    ids = scenes[2].ids.copy()
    ids[0, 2] = 77
    last = replace(scenes[2], ids=ids)
    seasoned, fresh = stream(HIGHWAY_SPEC), stream(HIGHWAY_SPEC)
    for scene in scenes[:2]:
        seasoned.observe(scene)
    actual, first_sight = seasoned.observe(last)["edge_features"][0], fresh.observe(last)["edge_features"][0]
    newcomer = int(np.flatnonzero(others_by_distance(last)[0] == 1)[0])
    veteran = 1 - newcomer
    np.testing.assert_allclose(actual[newcomer], first_sight[newcomer], rtol=TOLERANCE, atol=TOLERANCE)
    assert np.abs(actual[veteran] - first_sight[veteran]).max() > 1e-3


def test_an_env_of_a_batch_is_as_if_alone():
    scenes = drive(np.random.default_rng(4), batch=3, steps=3)
    together = stream(HIGHWAY_SPEC, 3)
    alone = [stream(HIGHWAY_SPEC) for _ in range(3)]
    for scene in scenes:
        entries = together.observe(scene)
        for env, single in enumerate(alone):
            assert_same({k: v[[env]] for k, v in entries.items()}, single.observe(scene[np.array([env])]))


def test_reset_forgets_the_named_envs_only():
    scenes = drive(np.random.default_rng(5), batch=2, steps=3)
    kept, cut, fresh = stream(HIGHWAY_SPEC, 2), stream(HIGHWAY_SPEC, 2), stream(HIGHWAY_SPEC, 2)
    for scene in scenes[:2]:
        kept.observe(scene)
        cut.observe(scene)
    cut.reset(np.array([1]))
    remembered, actual, forgotten = kept.observe(scenes[2]), cut.observe(scenes[2]), fresh.observe(scenes[2])
    assert_same({k: v[0] for k, v in actual.items()}, {k: v[0] for k, v in remembered.items()})
    assert_same({k: v[1] for k, v in actual.items()}, {k: v[1] for k, v in forgotten.items()})
    assert largest_difference({k: v[1] for k, v in remembered.items()}, {k: v[1] for k, v in forgotten.items()}) > 1e-3


def test_samples_repeat_with_the_seed_and_the_first_is_the_most_likely():
    scenes = drive(np.random.default_rng(6), batch=1, steps=1, present=[5])[0]
    first, again, other = (stream(HIGHWAY_SPEC, num_samples=4, seed=s).observe(scenes)["forecast"] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first[0, 0, 1] != other[0, 0, 1]).any()
    likely = stream(HIGHWAY_SPEC).observe(scenes)["forecast"]
    np.testing.assert_allclose(first[:, :, 0], likely, rtol=TOLERANCE, atol=TOLERANCE)
    reseeded = stream(HIGHWAY_SPEC, num_samples=4, seed=2)
    reseeded.seed(1)
    np.testing.assert_array_equal(reseeded.observe(scenes)["forecast"], first)


@pytest.mark.parametrize(("samples", "horizon_steps"), [(1, None), (3, 7)])
def test_spaces_hold_the_entries(samples: int, horizon_steps: int | None):
    scenes = drive(np.random.default_rng(7), batch=2, steps=1)[0]
    made = stream(HIGHWAY_SPEC, 2, num_samples=samples, horizon_steps=horizon_steps)
    entries, spaces = made.observe(scenes), made.spaces()
    uncertain = {"mode_probs"} if samples > 1 else set()  # these samples are draws, without a scale
    assert set(spaces) == set(entries) == {*FORECAST_KEYS, *PATH_KEYS, *uncertain}
    for key, space in spaces.items():
        assert space.contains(entries[key][0]), key
    axis = () if samples == 1 else (samples,)
    assert entries["forecast"].shape == (2, 5, *axis, horizon_steps or HORIZON, 2)


@pytest.mark.parametrize(
    ("field", "value", "boundary"), [("num_samples", 0, 1), ("horizon_steps", 0, 1), ("num_samples", -3, 1)]
)
def test_config_names_what_is_out_of_range(field: str, value: int, boundary: int):
    assert getattr(ForecastConfig(**{field: boundary}), field) == boundary
    with pytest.raises(UserError, match=f"{field} must be at least 1, got {value}"):
        ForecastConfig(**{field: value})


# --- Scenes inside observations ---------------------------------------------------------------------------------------


def test_scenes_survive_the_way_through_an_observation():
    rng = np.random.default_rng(8)
    batch = random_scenes(rng, 3, 5)
    singles = [Scene(batch.states[i], batch.ids[i], batch.valid[i], float(batch.heading_rad[i])) for i in range(3)]
    entries = [scene_entries(s) for s in singles]
    spaces = scene_spaces(SceneSpec(dt_s=1.0, max_agents=5))
    assert all(space.contains(space.sample()) for space in spaces.values())
    assert tuple(spaces) == SCENE_KEYS
    assert all(space.contains(entries[0][key]) for key, space in spaces.items())
    back = scenes_from({key: np.stack([e[key] for e in entries]) for key in SCENE_KEYS})
    for name in ("states", "ids", "valid", "heading_rad"):
        np.testing.assert_array_equal(getattr(back, name), getattr(batch, name))
        assert getattr(back, name).dtype == getattr(batch, name).dtype


def test_spaces_without_scenes_are_named():
    whole = gym.spaces.Dict({"observation": gym.spaces.Discrete(2), **scene_spaces(HIGHWAY_SPEC)})
    assert carries_scenes(whole)
    assert require_scenes(whole, "Wrapper", "make them so") is whole
    partial = gym.spaces.Dict({key: whole[key] for key in SCENE_KEYS[:-1]})
    for space, name in ((partial, "Dict"), (gym.spaces.Box(0, 1, (3,)), "Box")):
        assert not carries_scenes(space)
        with pytest.raises(UserError, match=f"Wrapper needs environments that report scenes, got {name} .*SceneObserv"):
            require_scenes(space, "Wrapper", "make them so")
    shown = gym.spaces.Dict({**entry_spaces(ConstantVelocity(HIGHWAY_SPEC), HIGHWAY_SPEC, ForecastConfig())})
    with pytest.raises(UserError, match="Wrapper makes the forecasts of all .* SceneObservation in the place of"):
        require_scenes(shown, "Wrapper", "make them so")


def test_scenes_of_another_shape_are_named():
    require_scenes_of(HIGHWAY_SPEC, gym.spaces.Dict(scene_spaces(HIGHWAY_SPEC)), "Wrapper")
    stacked = {key: gym.spaces.Box(-9, 9, (2, *space.shape)) for key, space in scene_spaces(HIGHWAY_SPEC).items()}
    with pytest.raises(UserError, match=r"^Wrapper: a wrapper around SceneObservation changed 'scene_states' from"):
        require_scenes_of(HIGHWAY_SPEC, gym.spaces.Dict(stacked), "Wrapper")


# --- Which forecaster -------------------------------------------------------------------------------------------------


def test_time_steps_that_differ_are_both_named(tmp_path: Path):
    path = save_tiny(tmp_path / "slow", HIGHWAY_SPEC)
    expected = r"checkpoint '.*slow' was trained at dt_s=1 but env 'racetrack-v1' steps at dt_s=0.2; .*policy_frequency"
    with pytest.raises(UserError, match=expected):
        open_forecaster(path, replace(HIGHWAY_SPEC, dt_s=0.2), "racetrack-v1")


def test_features_that_differ_are_both_named(tmp_path: Path):
    wider = replace(
        MAP_SPEC,
        feature_names=("x_m", "y_m", "vx_mps", "vy_mps", "heading_rad"),
        feature_scales=(100.0, 100.0, 30.0, 30.0, 1.0),
    )
    path = tmp_path / "wide"
    config = DGVAEConfig(hidden_dim=4, rnn_dim=4, head_dim=4, message_dim=4, decoder_dim=4, edge_feature_dim=2)
    save_checkpoint(path, DGVAE(wider, config, 2), CheckpointInfo(wider, config, 2))
    with pytest.raises(UserError, match=r"trained on features \(.*'heading_rad'\) but env 'merge-v1' gives \('x_m'"):
        open_forecaster(str(path), MAP_SPEC, "merge-v1")


def test_unknown_checkpoint_is_named():
    with pytest.raises(UserError, match="no checkpoint 'nowhere': neither a folder nor a shipped name"):
        open_forecaster("nowhere", HIGHWAY_SPEC, "highway-fast-v0")


def test_id_without_a_checkpoint_is_named():
    with pytest.raises(UserError, match="no checkpoint ships for env 'parking-v0'; pass one .*'constant-velocity'"):
        open_forecaster(None, HIGHWAY_SPEC, "parking-v0")


def test_constant_velocity_fits_any_spec():
    made = open_forecaster("constant-velocity", MAP_SPEC, "anything")
    assert isinstance(made, ConstantVelocity)
    assert made.spec == MAP_SPEC


@pytest.mark.parametrize("env_id", CHECKPOINTS)
def test_a_checkpoint_ships_for_every_registered_id(env_id: str):
    name = CHECKPOINTS[env_id]
    assert name in shipped()
    scenes = reader_for(make_env(env_id)).spec
    model = load_forecaster(name, scenes, f"env '{env_id}'")
    assert model.spec.frame == scenes.frame
    assert model.horizon_steps >= 5
    folder = resolve(name)
    assert sum(file.stat().st_size for file in folder.iterdir()) < 5_000_000
    assert env_id in (folder / "README.md").read_text()  # the model card


def test_three_axes_are_refused():
    names = ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps")
    spec = SceneSpec(dt_s=1.0, frame=("world",) * 3, feature_names=names, feature_scales=(1.0,) * 6)
    with pytest.raises(UserError, match="positions in a plane, got has_ego=True and 3 axes; SceneStream"):
        ForecastStream(ConstantVelocity(spec), spec, 1, ForecastConfig())


# --- Devices ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("there", "taken"), [(True, "cuda"), (False, "cpu")])
def test_auto_takes_the_cuda_device_where_there_is_one(there: bool, taken: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    assert ForecastConfig(device="auto").device == taken


def test_devices_that_are_not_there_are_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="device 'cuda' was asked for but torch finds no CUDA device"):
        ForecastConfig(device="cuda")
    with pytest.raises(UserError, match="device must be cpu, cuda or auto, got 'tpu'"):
        ForecastConfig(device="tpu")


# --- path_entries: the ego's own path, and who comes close to it ------------------------------------------------------


def test_path_entries_of_a_head_on_meeting():
    """The ego drives north at 10 m/s; an agent 40 m ahead comes at 10 m/s: they meet after 2 s, half of the horizon."""
    states = np.array([[[5.0, 5.0, 0.0, 10.0], [5.0, 45.0, 0.0, -10.0], [35.0, 5.0, 0.0, 10.0], [0.0] * 4]])
    valid = np.array([[True, True, True, False]])
    scenes = SceneBatch(states, np.array([[0, 1, 2, -1]]), valid, np.array([np.pi / 2]))
    times_s = np.arange(1, 5)[:, None]
    forecast = np.zeros((1, 3, 4, 2), dtype=np.float32)
    forecast[0, 0] = np.hstack([0 * times_s - 0.0, -30.0 + 0 * times_s])  # the nearest, beside: keeps pace
    forecast[0, 0] += np.hstack([10.0 * times_s, 0 * times_s])
    forecast[0, 1] = np.hstack([40.0 - 10.0 * times_s, 0 * times_s])
    found = path_entries(scenes, forecast, dt_s=1.0)
    np.testing.assert_allclose(found["ego_path"][0], np.hstack([10.0 * times_s, 0 * times_s]), atol=1e-5)
    np.testing.assert_allclose(found["closest"][0], [[30.0, 0.0], [0.0, 0.5], [0.0, 0.0]], atol=1e-5)


def test_path_entries_take_the_most_probable_of_several_futures():
    states = np.array([[[0.0, 0.0, 0.0, 0.0], [9.0, 0.0, 0.0, 0.0]]])
    scenes = SceneBatch(states, np.array([[0, 1]]), np.array([[True, True]]), np.zeros(1))
    forecast = np.array([[[[[4.0, 3.0]], [[1.0, 0.0]]]]], dtype=np.float32)  # two futures of one step
    found = path_entries(scenes, forecast, dt_s=1.0)["closest"]
    np.testing.assert_allclose(found, [[[5.0, 1.0]]])


def test_two_that_stand_are_nearest_now_whatever_is_rounded():
    states = np.array([[[0.0, 0.0, 0.0, 0.0], [6.2, 0.0, 0.0, 0.0]]])
    scenes = SceneBatch(states, np.array([[0, 1]]), np.array([[True, True]]), np.zeros(1))
    forecast = np.full((1, 1, 5, 2), [6.2, 0.0], dtype=np.float32)  # 6.19999980926…
    assert float(forecast[0, 0, 0, 0]) < 6.2
    np.testing.assert_allclose(path_entries(scenes, forecast, dt_s=1.0)["closest"], [[[6.2, 0.0]]], rtol=1e-6)
