from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from envs.drivers import trained
from envs.readers import FunctionReader
from envs.readers.highway_labels import LEADER
from envs.rollouts.world import EgoWorld, MultiagentWorld, World, default_drivers, open_world
from envs.sb3.policy_file import ForecasterPin, PolicyNote
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError
from tests.envs.evaluation import TAG, save_tag
from tests.envs.helpers import HIGHWAY_SPEC, PLURAL, save_tiny

ROAD = "two-way-v0"


def watched(world: World, seed: int, steps: int = 4) -> list[tuple[Scene, Scene]]:
    """What is perceived, and all agents, at the start of an episode and after each step."""
    world.reset(seed)
    seen = [(world.perceived(), world.full_scene())]
    for _ in range(steps):
        world.step()
        seen.append((world.perceived(), world.full_scene()))
    return seen


@pytest.fixture(scope="module", params=[ROAD, TAG])
def world(request: pytest.FixtureRequest) -> World:
    return open_world(request.param, "varied")


def test_perceived_agents_are_among_all_agents(world: World):
    for perceived, full in watched(world, seed=0):
        perceived.check("perceived", world.spec, agents=world.spec.max_agents)
        full.check("full", world.spec)
        assert full.valid.all()
        truth = dict(zip(full.ids.tolist(), full.states, strict=True))
        assert int(perceived.valid.sum()) > 1
        for i in np.flatnonzero(perceived.valid):
            np.testing.assert_array_equal(perceived.states[i], truth[int(perceived.ids[i])])
        if world.spec.has_ego:
            assert full.ids[0] == perceived.ids[0]


def test_an_episode_is_a_function_of_its_seed(world: World):
    first, other, again = (watched(world, seed) for seed in (1, 2, 1))
    for (_, before), (_, after) in zip(first, again, strict=True):
        np.testing.assert_array_equal(before.states, after.states)
        np.testing.assert_array_equal(before.ids, after.ids)
    assert not np.array_equal(first[0][1].states[:, :2], other[0][1].states[:, :2])


def test_a_step_says_when_the_episode_is_over():
    world = open_world(TAG, "random")
    world.reset(0)
    assert [world.step() for _ in range(25)] == [False] * 24 + [True]  # mpe2's max_cycles
    assert world.full_scene().valid.sum() == world.spec.max_agents  # who was there at the end
    road = open_world("u-turn-v1", "idle")
    road.reset(3)
    ends = [road.step() for _ in range(3)]
    assert ends[0] is False and set(ends) <= {False, True}


def test_edges_are_known_on_roads_in_the_order_of_all_agents():
    world = open_world(ROAD, "idle")
    world.reset(0)
    labels = world.labels()
    assert labels is not None
    assert labels.edge_types.shape == (len(world.full_scene().ids),) * 2
    assert (labels.edge_types == LEADER).any()
    multi = open_world(TAG, "idle")
    multi.reset(0)
    assert multi.labels() is None


def test_one_ego_or_many_learners_with_forecasts_or_without(highway_checkpoint: str):
    plain, forecast = open_world(ROAD, "idle"), open_world(ROAD, "idle", highway_checkpoint)
    assert isinstance(plain, EgoWorld) and isinstance(plain.env, SceneObservation)
    assert isinstance(forecast, EgoWorld) and isinstance(forecast.env, ForecastObservation)
    forecast.reset(0)
    assert forecast.observation["forecast"].ndim == 3
    assert forecast.forecast(4).xy.shape[1] == 4
    torch.testing.assert_close(forecast.forecast(4).xy[:, :1], forecast.env.forecast.xy)
    multi = open_world(TAG, "idle", "constant-velocity", horizon_steps=7)
    assert isinstance(multi, MultiagentWorld)
    multi.reset(0)
    assert multi.forecast(2).xy.shape == (1, 2, multi.spec.max_agents, 7, 2)


@pytest.mark.parametrize("env_id", [ROAD, TAG])
def test_more_samples_begin_with_the_one_that_is_observed_and_leave_it_alone(env_id: str, tmp_path: Path):
    """A driver that is a policy sees one future, whatever is measured beside it."""
    if env_id == ROAD:
        checkpoint = save_tiny(tmp_path / "plural", HIGHWAY_SPEC, **PLURAL)
    else:
        checkpoint = save_tag(tmp_path / "plural", **PLURAL)
    world, untouched = (open_world(env_id, "idle", checkpoint) for _ in range(2))
    assert isinstance(world, EgoWorld | MultiagentWorld)
    for one in (world, untouched):
        one.reset(0)
    for _ in range(3):
        before = deepcopy(world.env.forecast)
        for samples in (1, 3, PLURAL["num_modes"], 9):
            found = world.forecast(samples)
            assert found.xy.shape[1] == samples
            torch.testing.assert_close(found.xy[:, :1], before.xy, rtol=1e-4, atol=1e-4)
            assert found.xy_scale is not None and found.xy_scale.shape == found.xy.shape
            if found.mode_probs is not None:
                torch.testing.assert_close(found.mode_probs.sum(1), torch.ones_like(found.mode_probs[:, 0]))
        assert torch.equal(world.env.forecast.xy, before.xy)
        shown, expected = (w.observation if isinstance(w, EgoWorld) else w._observations for w in (world, untouched))
        assert_same_nested(shown, expected)
        assert world.step() == untouched.step()


HIGHWAY_POLICY = Path(__file__).parents[3] / "agents" / "pretrained" / "highway-fast.zip"


def assert_same_nested(found: Any, expected: Any) -> None:
    if isinstance(expected, dict):
        assert set(found) == set(expected)
        for key in expected:
            assert_same_nested(found[key], expected[key])
    else:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("env_id", "driver", "checkpoint", "message"),
    [
        ("nope-v0", "idle", None, "cannot make env 'nope-v0'"),
        (ROAD, "reckless", None, "driver must be one of random"),
        (ROAD, "keep-lane", "constant-velocity", "keep-lane needs continuous steering"),
        (ROAD, "absent.zip", None, "no policy at absent.zip"),
        (ROAD, "idle", "nowhere", "no checkpoint 'nowhere'"),
        (TAG, "reckless", None, "driver must be one of random"),
        (TAG, "absent.zip", None, "no policy at absent.zip"),
        (TAG, "idle", "nowhere", "no checkpoint 'nowhere'"),
        (
            TAG,
            str(HIGHWAY_POLICY),
            None,
            "policy .*highway-fast.zip was trained with plans of one ego",
        ),
    ],
)
def test_what_does_not_go_together_is_named(env_id: str, driver: str, checkpoint: str | None, message: str):
    with pytest.raises(UserError, match=f"^{message}"):
        open_world(env_id, driver, checkpoint)


def test_true_futures_beside_agents_that_a_driver_moves_are_refused(monkeypatch: pytest.MonkeyPatch):
    """They follow from that driver, which the environment alone does not have."""
    pin = ForecasterPin(CONSTANT_VELOCITY, None, 10, 1, 6, None, arm="oracle")
    monkeypatch.setattr(trained, "sees_forecasts", lambda driver: True)
    for learners, refused in ((("adversary",), True), ((), False)):
        note = PolicyNote(pin, learners, env_id=TAG)
        monkeypatch.setattr(trained, "note_of", lambda path, note=note: note)
        message = "was trained on arm 'oracle' beside agents that do not learn" if refused else "no policy at"
        with pytest.raises(UserError, match=message):
            open_world(TAG, "absent.zip")


@pytest.mark.parametrize(
    ("env_id", "first"), [(ROAD, "varied"), (TAG, "heuristic"), ("intersection-multi-agent-v2", "varied")]
)
def test_default_drivers_can_drive(env_id: str, first: str):
    names = default_drivers(env_id)
    assert names[0] == first
    for name in names:
        open_world(env_id, name).close()


def test_all_agents_are_read_into_arrays_of_their_own(monkeypatch: pytest.MonkeyPatch):
    """A reader may give the simulator's own array, which the next step changes."""
    world = open_world(ROAD, "idle")
    world.reset(3)
    held = world.full_scene()
    monkeypatch.setattr(world._reader, "read_all", lambda env: held)
    kept = world.full_scene()
    held.states[:] = 0.0
    assert kept.states.any()
    world.close()


def test_agents_that_a_reader_marks_as_absent_are_not_there():
    """A reader with a fixed table may keep the place, and the id, of who has left."""

    def read(env: gym.Env) -> Scene:
        states = np.array([[0.0, 0.0, 1.0, 0.0], [20.0, 0.0, 1.0, 0.0]]) * [[1.0], [float(env.unwrapped.left > 2)]]  # type: ignore[attr-defined]
        return Scene(states, np.array([0, 7]), np.array([True, env.unwrapped.left > 2]), 0.5)  # type: ignore[attr-defined]

    world = EgoWorld(
        SceneObservation(Leaving(), reader=FunctionReader(read, SceneSpec(dt_s=1.0, max_agents=2))), "idle"
    )
    full = [scene for _, scene in watched(world, 0, steps=2)]
    assert [scene.ids.tolist() for scene in full] == [[0, 7], [0, 7], [0]]
    assert all(scene.valid.all() and scene.heading_rad == 0.5 for scene in full)
    assert world.reread()[1].ids.tolist() == [0]


class Leaving(gym.Env):
    """Counts its steps down from 4."""

    observation_space = gym.spaces.Box(0, 1, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = 4
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        return np.zeros(1, np.float32), 0.0, False, False, {}
