"""Arms of a controlled comparison: equal shapes, and nothing shown but what the arm names."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from agents.task import Task
from envs import ForecastObservation, make_env
from envs.arms import ARMS, PRESENT_KEYS, Arm, EntryBank, EntryLayout, arm_of
from envs.entry_bank import record_bank
from envs.parallel import ForecastParallelEnv
from envs.registry import make_multiagent_env
from predictor.checkpoint import load_checkpoint
from predictor.support.errors import UserError

FAST = "highway-fast-v0"
PRESENT = ("observation", *PRESENT_KEYS)
ROOM = {"num_samples": 6, "what_if": True}


@pytest.fixture(scope="module")
def bank() -> EntryBank:
    return record_bank(ForecastObservation(make_env(FAST), "highway", **ROOM), "highway", episodes=3)


def observed(name: str, bank: EntryBank, **options: Any) -> dict[str, Any]:
    """Returns the third observation of one episode in an arm."""
    env = ForecastObservation(make_env(FAST), "highway", arm=Arm(name, bank=bank), **ROOM | options)
    env.reset(seed=5)
    env.step(1)
    found, *_ = env.step(1)
    assert env.observation_space.contains(found)
    env.close()
    return found


@pytest.fixture(scope="module")
def everything(bank: EntryBank) -> dict[str, Any]:
    return observed("forecast", bank)


HIDDEN = (
    *("forecast", "closest", "mode_probs", "xy_scale", "edge_probs", "edge_features"),
    *("what_if_gap", "what_if_contact", "what_if_risk"),
)
SHOWN = {
    "single": {"forecast", "closest", "mode_probs", "xy_scale", "edge_probs", "edge_features"},
    "no-edges": {"forecast", "closest", "mode_probs", "xy_scale"},
    "edges-only": {"edge_probs", "edge_features"},
    "modes": {"forecast", "closest", "mode_probs", "xy_scale", "edge_probs", "edge_features"},
    "what-if": {
        *("forecast", "closest", "mode_probs", "xy_scale", "edge_probs", "edge_features"),
        *("what_if_gap", "what_if_contact", "what_if_risk"),
    },
    "zeros": set(),
    "oracle": {"forecast", "closest", "mode_probs"},
    "oracle-what-if": {"forecast", "closest", "mode_probs", "what_if_gap", "what_if_contact", "what_if_risk"},
}


@pytest.mark.parametrize("name", [name for name in ARMS if name != "forecast"])
def test_arms_have_equal_shapes_and_the_same_present(name: str, bank: EntryBank, everything: dict[str, Any]):
    found = observed(name, bank)
    assert {key: value.shape for key, value in found.items()} == {key: v.shape for key, v in everything.items()}
    for key in PRESENT:
        np.testing.assert_array_equal(found[key], everything[key])


@pytest.mark.parametrize("name", SHOWN)
def test_an_arm_shows_its_part_alone(name: str, bank: EntryBank, everything: dict[str, Any]):
    found = observed(name, bank)
    for key in set(found) - set(PRESENT):
        assert found[key].any() == (key in SHOWN[name]), key
    if not name.startswith("oracle"):
        for key in SHOWN[name]:
            few = key in ("forecast", "mode_probs", "xy_scale") and name != "modes"
            shown, full = (values[:, :1] if few else values for values in (found[key], everything[key]))
            np.testing.assert_allclose(shown, full, atol=1e-4)  # 1 or 6 samples: other products of matrices
            assert not few or not found[key][:, 1:].any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["single", "no-edges", "what-if", "oracle", "oracle-what-if"])
def test_a_single_forecast_is_shown_to_its_last_step(name: str, bank: EntryBank):
    """Where the observation has room for one sample, the entry has no axis of samples that could be cut."""
    found = observed(name, bank, num_samples=1)["forecast"]
    shown = observed("forecast", bank, num_samples=1)["forecast"]
    seen = shown[:, 0].any(axis=-1)
    assert found.shape == shown.shape and seen.any()
    assert found[seen].any(axis=-1).all()
    if not name.startswith("oracle"):
        np.testing.assert_array_equal(found, shown)


@pytest.mark.parametrize(
    ("name", "room", "message"),
    [
        (
            "modes",
            {"what_if": True},
            "arm modes shows several futures .* set num_samples to 2 or more, or take arm single",
        ),
        ("what-if", {"num_samples": 6}, "arm what-if shows candidate plans .* set what_if, or take arm single"),
        ("oracle-what-if", {"num_samples": 6}, "arm oracle-what-if shows candidate plans .* or take arm oracle"),
    ],
)
def test_an_arm_without_room_for_what_it_shows_is_refused(name: str, room: dict[str, Any], message: str):
    """It would show what another arm shows, under its own name."""
    with pytest.raises(UserError, match=message):
        ForecastObservation(make_env(FAST), "highway", arm=Arm(name), **room)
    with pytest.raises(UserError, match=message):
        Task(FAST, name, **room)
    if "what_if" not in room:
        with pytest.raises(UserError, match=message):
            ForecastParallelEnv(make_multiagent_env("simple_tag_v3"), "simple-tag", arm=Arm(name), **room)


def test_a_predator_sees_a_single_forecast_to_its_last_step():
    shown = {}
    for name in ("forecast", "no-edges"):
        env = ForecastParallelEnv(make_multiagent_env("simple_tag_v3"), "simple-tag", arm=Arm(name))
        observations, _ = env.reset(seed=5)
        shown[name] = observations["adversary_0"]["forecast"]
    np.testing.assert_array_equal(shown["no-edges"], shown["forecast"])


def test_shuffled_is_another_scene_and_the_same_in_every_run(bank: EntryBank, everything: dict[str, Any]):
    found, again = observed("shuffled", bank), observed("shuffled", bank)
    present = found["valid"] > 0
    for key in set(found) - set(PRESENT):
        np.testing.assert_array_equal(found[key], again[key])
        assert not found[key][~present].any(), key
    assert (np.abs(found["forecast"][present] - everything["forecast"][present]) > 1.0).any(axis=(1, 2, 3)).all()
    for key in HIDDEN:
        recorded = bank.entries[key].reshape(-1, *found[key].shape[1:])
        recorded, shown = (values.reshape(len(values), -1) for values in (recorded, found[key][present]))
        assert all((recorded == one).all(axis=1).any() for one in shown), key


@pytest.fixture(scope="module")
def driven() -> list[dict[str, Any]]:
    """Observations of some episodes in the arm that shows everything."""
    env = ForecastObservation(make_env(FAST), "highway", **ROOM)
    found = []
    for seed in range(12):
        seen, _ = env.reset(seed=seed)
        for _ in range(8):
            found.append(seen)
            seen, _, terminated, *_ = env.step(env.unwrapped.np_random.integers(0, 2))
            if terminated:
                break
    env.close()
    return found


@pytest.mark.parametrize("name", ["forecast", "zeros", "shuffled"])
def test_a_probe_predicts_the_scene_from_forecasts_alone(name: str, bank: EntryBank, driven: list[dict[str, Any]]):
    """Ridge regression from the hidden entries to the nearest agent's present x: of use with forecasts alone."""
    entries = {key: np.stack([seen[key] for seen in driven]) for key in driven[0] if key != "observation"}
    spaces = {key: gym.spaces.Box(-np.inf, np.inf, values.shape[1:]) for key, values in entries.items()}
    shown = Arm(name, bank=bank).filled(entries, spaces)
    x = np.hstack([shown[key][:, 0].reshape(len(driven), -1) for key in sorted(shown) if key not in PRESENT])
    y = entries["agents"][:, 0, 0]
    half = len(x) // 2
    mean, scale = x[:half].mean(axis=0), x[:half].std(axis=0) + 1e-6
    x = np.hstack([(x - mean) / scale, np.ones((len(x), 1))])
    weights = np.linalg.solve(x[:half].T @ x[:half] + 1.0 * np.eye(x.shape[1]), x[:half].T @ y[:half])
    r2 = 1 - np.mean((x[half:] @ weights - y[half:]) ** 2) / np.var(y[half:])
    assert r2 > 0.8 if name == "forecast" else r2 < 0.1, r2


def test_constant_velocity_has_the_shapes_of_the_shipped_checkpoint():
    spaces = [Task(FAST, observe).wrapped(Task(FAST, observe).make()).observation_space for observe in ROWS]
    assert all(space == spaces[0] for space in spaces)


ROWS = ("forecast", "zeros", "constant-velocity", "oracle")


def test_multiagent_views_are_filled_too():
    env = ForecastParallelEnv(make_multiagent_env("simple_tag_v3"), "simple-tag", arm=Arm("zeros"))
    observations, _ = env.reset(seed=0)
    for seen in observations.values():
        assert seen["agents"].any() and seen["valid"].all()
        assert not any(seen[key].any() for key in ("forecast", "edge_probs", "edge_features"))
    env.close()


def test_layout_adds_room_for_edges():
    layout = EntryLayout.of(load_checkpoint("highway")[0])
    env = ForecastObservation(make_env(FAST), "constant-velocity", arm=Arm(layout=layout), num_samples=2)
    found, _ = env.reset(seed=0)
    assert found["edge_probs"].shape == (11, 2) and not found["edge_probs"].any()
    assert found["xy_scale"].shape == (11, 2, 5, 2) and found["forecast"].any()
    env.close()


def test_each_direction_of_edges_keeps_its_place_in_a_larger_layout():
    """Both have room of their own: "ego → agent" begins where it begins for the forecaster with more types."""
    env = ForecastObservation(make_env(FAST), "highway", arm=Arm(layout=EntryLayout(3, 10, True)), num_samples=2)
    plain = ForecastObservation(make_env(FAST), "highway", num_samples=2)
    (found, _), (own, _) = env.reset(seed=0), plain.reset(seed=0)
    assert own["edge_probs"].any() and own["edge_features"].shape[-1] == 16
    np.testing.assert_array_equal(found["edge_probs"][:, [0, 2]], own["edge_probs"])
    np.testing.assert_array_equal(found["edge_features"][:, [*range(8), *range(10, 18)]], own["edge_features"])
    assert not found["edge_probs"][:, [1, 3]].any() and not found["edge_features"][:, [8, 9, 18, 19]].any()
    env.close(), plain.close()


def test_a_spec_in_json_makes_the_environment_again():
    env = gym.make("highway-fast-v0")
    env = ForecastObservation(env, "constant-velocity", arm=Arm("zeros", EntryLayout(2, 3, True)), num_samples=2)
    assert env.spec is not None
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.observation_space == env.observation_space
    assert not again.reset(seed=0)[0]["forecast"].any()
    with pytest.raises(UserError, match="arm: unknown key 'nam'"):
        arm_of({"nam": "zeros"})


def test_an_unknown_arm_is_refused():
    with pytest.raises(UserError, match=r"arm must be one of forecast, .*, got 'psychic'"):
        Arm("psychic")


def test_another_scene_needs_a_bank():
    with pytest.raises(UserError, match="record_bank"):
        ForecastObservation(make_env(FAST), "highway", arm=Arm("shuffled")).reset(seed=0)


def test_a_bank_without_an_entry_is_refused(bank: EntryBank):
    """The present scene's own was shown."""
    less = EntryBank("less", {key: values for key, values in bank.entries.items() if not key.startswith("what_if")})
    with pytest.raises(UserError, match=r"arm 'shuffled': the bank has no 'what_if_gap', .*; record the bank with"):
        observed("shuffled", less)


def test_a_bank_of_other_sizes_is_refused(bank: EntryBank):
    with pytest.raises(
        UserError, match=r"arm 'shuffled': 'forecast' of an agent has the shape .*; record the bank with"
    ):
        observed("shuffled", bank, horizon_steps=3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"arm": Arm("zeros")}, "got the arm 'zeros' and a Dict observation"),
        ({"flatten": True}, "and a Box observation"),
    ],
)
def test_a_bank_is_recorded_from_whole_forecasts(options: dict[str, Any], words: str):
    with pytest.raises(UserError, match=f"a bank is recorded with the arm 'forecast' and flatten=False, .*{words}"):
        record_bank(ForecastObservation(make_env(FAST), "highway", **options), "highway")


def test_a_predator_is_told_one_true_future_where_there_is_room_for_several():
    env = ForecastParallelEnv(make_multiagent_env("simple_tag_v3"), "simple-tag", num_samples=3, arm=Arm("oracle"))
    observations, _ = env.reset(seed=0)
    for seen in observations.values():
        there = seen["valid"].astype(bool)
        assert seen["forecast"][there, 0].any() and not seen["forecast"][:, 1:].any()
        assert (seen["mode_probs"][there, 0] == 1.0).all() and not seen["xy_scale"].any()
    env.close()


def test_an_arm_without_edges_needs_no_room_for_them():
    own, _ = load_checkpoint("highway")
    small = EntryLayout(num_edge_types=1, edge_feature_dim=0, has_scale=False)
    for name in ("zeros", "no-edges", "oracle"):
        assert Arm(name, small).layout_for(own) == small
    with pytest.raises(
        UserError, match=r"the forecaster has edges of \d+ types with \d+ features, and the observation"
    ):
        Arm("single", small).layout_for(own)


@pytest.mark.parametrize(
    ("name", "what_if", "played"),
    [("oracle", True, 1), ("oracle", False, 1), ("oracle-what-if", True, None), ("what-if", True, 0)],
)
def test_only_plans_that_are_shown_are_played(name: str, what_if: bool, played: int | None):
    """Each one costs a copy of the simulator in every step."""
    assert Arm(name).plays(what_if) == played
