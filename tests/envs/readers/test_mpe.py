import importlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from mpe2._mpe_utils.core import Agent
from mpe2._mpe_utils.simple_env import SimpleEnv
from mpe2.simple.simple import Scenario
from pettingzoo import ParallelEnv
from pettingzoo.sisl.pursuit.pursuit import parallel_env as pursuit_env
from pettingzoo.utils import BaseParallelWrapper

from envs.parallel import ForecastParallelEnv
from envs.readers.base import MultiagentReader, MultiagentScene
from envs.readers.mpe import MPE_FEATURES, MpeReader, is_mpe_env, mpe_scenario
from predictor.scene import PADDING_ID
from predictor.support.errors import ProtocolError, UserError

AGENTS = {
    "simple_v3": 1,
    "simple_spread_v3": 3,
    "simple_tag_v3": 4,
    "simple_adversary_v3": 3,
    "simple_push_v3": 2,
    "simple_world_comm_v3": 6,
    "simple_formation_v1": 4,
    "simple_line_v1": 4,
    "collect_treasure_v1": 8,
    "simple_reference_v3": 2,
    "simple_speaker_listener_v4": 2,
}
"""Agents of each scenario that moves."""
ADVERSARIES = {"simple_tag_v3": 3, "simple_adversary_v3": 1, "simple_push_v3": 1, "simple_world_comm_v3": 4}
RADIUS = MPE_FEATURES.index("radius_m")


def make(env_id: str, **kwargs: Any) -> ParallelEnv:
    return importlib.import_module(f"mpe2.{env_id}").parallel_env(**kwargs)


def random_step(env: ParallelEnv, rng: np.random.Generator) -> None:
    env.step({name: int(rng.integers(env.action_space(name).n)) for name in env.agents})


def world_of(env: ParallelEnv) -> Any:
    return env.unwrapped.world


def named(env: ParallelEnv, name: str) -> Any:
    return next(body for body in world_of(env).agents if body.name == name)


def entity_of_id(env: ParallelEnv, multi: MultiagentScene) -> dict[int, Any]:
    """Which entity each id stands for, found by position."""
    scene = multi.scene
    found = {}
    for state, number in zip(scene.states[scene.valid], scene.ids[scene.valid], strict=True):
        (entity,) = [e for e in world_of(env).entities if np.array_equal(e.state.p_pos, state[:2])]
        found[int(number)] = entity
    return found


@pytest.fixture
def tag() -> ParallelEnv:
    env = make("simple_tag_v3", max_cycles=50)
    env.reset(seed=0)
    return env


# --- What a scene holds -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("landmarks", [False, True])
@pytest.mark.parametrize("env_id", AGENTS)
def test_every_scenario_reads(env_id: str, landmarks: bool):
    env = make(env_id, max_cycles=5)
    reader = MpeReader(env, landmarks=landmarks)
    assert isinstance(reader, MultiagentReader)
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    still = len(world_of(env).landmarks) if landmarks else 0
    assert reader.spec.max_agents == AGENTS[env_id] + still
    while env.agents:
        multi = reader.read(env)
        multi.scene.check(env_id, reader.spec, agents=reader.spec.max_agents)
        assert sorted(multi.index_of) == sorted(env.agents)
        for name, index in multi.index_of.items():
            body = named(env, name)
            np.testing.assert_array_equal(multi.scene.states[index, :4], [*body.state.p_pos, *body.state.p_vel])
            assert multi.scene.states[index, RADIUS] == body.size
        assert not multi.heading_rad.any()
        random_step(env, rng)


@pytest.mark.parametrize("env_id", AGENTS)
def test_velocity_and_time_step_are_the_simulators(env_id: str):
    """mpe2 moves an entity with its old velocity before it changes it, so the next position is known exactly."""
    env = make(env_id, max_cycles=9)
    reader = MpeReader(env, landmarks=False)
    env.reset(seed=1)
    rng = np.random.default_rng(1)
    moved = 0.0
    while env.agents:
        before = reader.read(env).scene.states
        random_step(env, rng)
        after = reader.read(env).scene.states
        np.testing.assert_allclose(after[:, :2], before[:, :2] + before[:, 2:4] * reader.spec.dt_s, rtol=0, atol=1e-12)
        moved += np.abs(after[:, :2] - before[:, :2]).sum()
    assert moved > 0.1


def test_one_layout_for_all_scenarios():
    specs = [MpeReader(make(env_id)).spec for env_id in AGENTS]
    for spec in specs:
        spec.check_compatible(specs[0], "another", "this")
        assert spec.feature_scales == specs[0].feature_scales
        assert spec.constant_features == ("adversary", "landmark", "radius_m")
        assert (spec.has_ego, spec.frame, spec.dt_s) == (False, ("world", "world"), 0.1)


@pytest.mark.parametrize("env_id", AGENTS)
def test_constants_tell_adversaries_and_landmarks(env_id: str):
    env = make(env_id)
    env.reset(seed=0)
    scene = MpeReader(env, landmarks=True).read(env).scene
    adversary, landmark, radius = scene.states[scene.valid][:, 4:].T
    count = len(world_of(env).agents)
    assert adversary.tolist() == [1.0] * ADVERSARIES.get(env_id, 0) + [0.0] * (
        len(adversary) - ADVERSARIES.get(env_id, 0)
    )
    assert landmark.tolist() == [0.0] * count + [1.0] * len(world_of(env).landmarks)
    assert radius.tolist() == [entity.size for entity in world_of(env).entities]


def test_landmarks_are_left_out_by_choice(tag: ParallelEnv):
    assert MpeReader(tag, landmarks=False).read(tag).scene.valid.sum() == 4
    scene = MpeReader(tag).read(tag).scene
    assert scene.valid.sum() == 6
    np.testing.assert_array_equal(scene.states[4:, :2], [m.state.p_pos for m in world_of(tag).landmarks])
    assert not scene.states[4:, 2:4].any()


def test_wrapped_environments_read_alike(tag: ParallelEnv):
    wrapped = BaseParallelWrapper(tag)
    plain, seen = MpeReader(tag).read(tag), MpeReader(wrapped).read(wrapped)
    np.testing.assert_array_equal(seen.scene.states, plain.scene.states)
    assert seen.index_of == plain.index_of


@pytest.mark.parametrize("size", [4, 7])
def test_scenes_are_padded_to_max_agents(tag: ParallelEnv, size: int):
    scene = MpeReader(tag, landmarks=False, max_agents=size).read(tag).scene
    assert scene.valid.tolist() == [True] * 4 + [False] * (size - 4)
    assert (scene.ids[4:] == PADDING_ID).all()
    assert not scene.states[4:].any()


def test_too_small_max_agents_are_named(tag: ParallelEnv):
    with pytest.raises(UserError, match="MpeReader: 6 agents do not fit max_agents=5 of the reader's spec"):
        MpeReader(tag, max_agents=5).read(tag)


def test_perception_is_a_choice(tag: ParallelEnv):
    assert MpeReader(tag, perception_m=0.5).spec.perception_m == 0.5
    assert MpeReader(tag).read(tag).scene.valid.sum() == MpeReader(tag, perception_m=0.5).read(tag).scene.valid.sum()


# --- Identity ---------------------------------------------------------------------------------------------------------


def test_numbers_follow_the_order_of_entities(tag: ParallelEnv):
    scene = MpeReader(tag, landmarks=True).read(tag).scene
    assert scene.ids.tolist() == [0, 1, 2, 3, 4, 5]


def test_an_id_stays_with_its_entity_when_lists_are_sorted_anew(tag: ParallelEnv):
    reader = MpeReader(tag, landmarks=True)
    first = entity_of_id(tag, reader.read(tag))
    rng = np.random.default_rng(0)
    orders = set()
    for _ in range(6):
        world_of(tag).agents = [world_of(tag).agents[i] for i in rng.permutation(4)]
        rng.shuffle(world_of(tag).landmarks)
        multi = reader.read(tag)
        assert entity_of_id(tag, multi) == first
        for name, index in multi.index_of.items():
            np.testing.assert_array_equal(multi.scene.states[index, :2], named(tag, name).state.p_pos)
        orders.add(tuple(multi.scene.ids.tolist()))
    assert len(orders) > 1


def test_who_leaves_takes_its_number_along_although_python_reuses_addresses(tag: ParallelEnv):
    reader = MpeReader(tag, landmarks=False, max_agents=5)
    world = world_of(tag)
    numbers, addresses = [], []
    for step in range(20):
        visitor = Agent()
        visitor.name = "visitor"
        visitor.state.p_pos, visitor.state.p_vel = np.array([0.01 * step, 3.0]), np.zeros(2)
        world.agents.append(visitor)
        multi = reader.read(tag)
        numbers.append(int(multi.scene.ids[4]))
        addresses.append(id(visitor))
        assert "visitor" not in multi.index_of
        world.agents.pop()
        del visitor
    assert len(set(addresses)) < len(addresses)
    assert numbers == list(range(4, 24))


def test_one_leaves_as_another_comes(tag: ParallelEnv):
    reader = MpeReader(tag, landmarks=False)
    before = entity_of_id(tag, reader.read(tag))
    world = world_of(tag)
    gone = world.agents[1]
    newcomer = Agent()
    newcomer.name, newcomer.state.p_pos, newcomer.state.p_vel = "new", np.array([0.0, 2.0]), np.zeros(2)
    world.agents[1] = newcomer
    after = entity_of_id(tag, reader.read(tag))
    assert after == {0: before[0], 4: newcomer, 2: before[2], 3: before[3]}
    assert gone not in after.values()


def test_numbering_restarts_at_reset(tag: ParallelEnv):
    reader = MpeReader(tag, landmarks=True)
    reader.read(tag)
    tag.reset(seed=7)
    assert reader.read(tag).scene.ids.tolist() == [0, 1, 2, 3, 6, 7]  # obstacles elsewhere are others
    reader.reset()
    assert reader.read(tag).scene.ids.tolist() == [0, 1, 2, 3, 4, 5]


def test_a_treasure_that_appears_again_is_a_new_one():
    env = make("collect_treasure_v1", max_cycles=9)
    env.reset(seed=0)
    world = world_of(env)
    for i, entity in enumerate(world.entities):
        entity.state.p_pos = np.array([0.3 * i - 2.0, 0.5])
    world.agents[0].state.p_pos = world.landmarks[2].state.p_pos + 0.01
    reader = MpeReader(env, landmarks=True)
    count = len(world.agents)
    idle = dict.fromkeys(env.agents, 0)
    before = reader.read(env).scene
    env.step(idle)
    taken = reader.read(env).scene
    assert not world.landmarks[2].alive
    assert taken.ids[taken.valid].tolist() == [i for i in before.ids.tolist() if i != before.ids[count + 2]]
    assert np.abs(taken.states).max() < 5  # mpe2 parks what is collected at -999
    env.step(idle)
    again = reader.read(env).scene
    assert world.landmarks[2].alive
    assert again.valid.all()
    new = len(world.entities)
    assert again.ids.tolist() == [new if i == before.ids[count + 2] else i for i in before.ids.tolist()]


def test_a_treasure_is_another_one_even_if_its_absence_was_not_read():
    env = make("collect_treasure_v1")
    env.reset(seed=0)
    reader = MpeReader(env, landmarks=True)
    before = reader.read(env).scene.ids
    world_of(env).landmarks[0].state.p_pos = np.array([0.123, 0.456])
    after = reader.read(env).scene.ids
    assert np.flatnonzero(after != before).tolist() == [8]
    assert after[8] == 14


# --- Who is living ----------------------------------------------------------------------------------------------------


def test_an_agent_that_dies_in_an_episode_has_no_index_but_its_body_stays(tag: ParallelEnv):
    reader = MpeReader(tag)
    before = reader.read(tag)
    tag.unwrapped.agents = [name for name in tag.agents if name != "adversary_1"]
    after = reader.read(tag)
    assert sorted(after.index_of) == ["adversary_0", "adversary_2", "agent_0"]
    np.testing.assert_array_equal(after.scene.ids, before.scene.ids)
    assert after.scene.valid.all()


class EndsOne(BaseParallelWrapper):
    """Ends one agent at the first step; its body stays in the world."""

    def step(self, actions: Any) -> Any:
        observations, rewards, terminations, truncations, infos = self.env.step(actions | {"adversary_1": 0})
        self.agents = [name for name in self.env.agents if name != "adversary_1"]
        return observations, rewards, terminations | {"adversary_1": True}, truncations, infos


def test_the_last_observation_of_one_that_a_wrapper_ends_has_forecasts():
    env = ForecastParallelEnv(EndsOne(make("simple_tag_v3")), "constant-velocity")
    env.reset(seed=0)
    shown, _, terminations, _, _ = env.step(dict.fromkeys(env.agents, 0))
    assert terminations["adversary_1"] and "adversary_1" not in env.agents
    assert [int(seen["valid"].sum()) for seen in shown.values()] == [5, 5, 5, 5]


def test_last_observations_have_indices_although_no_agent_lives_by_then():
    env = make("simple_tag_v3", max_cycles=2)
    env.reset(seed=0)
    reader = MpeReader(env)
    random_step(env, np.random.default_rng(0))
    index_of = reader.read(env).index_of
    observations, *_ = env.step(dict.fromkeys(env.agents, 1))
    assert env.agents == []
    assert reader.read(env).index_of == index_of
    assert set(index_of) == set(observations)


def test_reading_before_the_first_reset_is_a_protocol_error():
    env = make("simple_tag_v3")
    with pytest.raises(ProtocolError, match="no agents yet; call reset"):
        MpeReader(env).read(env)


def test_reading_changes_nothing(tag: ParallelEnv):
    reader = MpeReader(tag, landmarks=True)
    first, second = reader.read(tag), reader.read(tag)
    np.testing.assert_array_equal(first.scene.states, second.scene.states)
    np.testing.assert_array_equal(first.scene.ids, second.scene.ids)
    first.scene.states[:] = 99.0
    assert np.abs(reader.read(tag).scene.states).max() < 2


# --- Which environments -----------------------------------------------------------------------------------------------


def test_scenarios_are_told_apart_although_they_share_their_metadata():
    envs = {env_id: make(env_id) for env_id in AGENTS}
    assert len({env.metadata["name"] for env in envs.values()}) == 1
    for env_id, env in envs.items():
        assert is_mpe_env(env)
        assert mpe_scenario(env) == env_id.rpartition("_")[0]


def test_own_scenarios_read_too():
    class Own(SimpleEnv):
        def __init__(self) -> None:
            scenario = Scenario()
            super().__init__(scenario, scenario.make_world(), max_cycles=5)

    env = Own()
    assert is_mpe_env(env)
    assert mpe_scenario(env) == ""
    env.reset(seed=0)
    assert MpeReader(env).read(env).index_of == {"agent_0": 0}


def test_other_families_are_named():
    assert not is_mpe_env(gym.make("CartPole-v1"))
    assert not is_mpe_env(pursuit_env())
    with pytest.raises(UserError, match="MpeReader needs an mpe2 environment, got raw_env"):
        MpeReader(pursuit_env())


def test_where_nothing_moves_there_is_nothing_to_forecast():
    with pytest.raises(UserError, match="nothing moves in simple_crypto, so there is nothing to forecast"):
        MpeReader(make("simple_crypto_v3"))


@pytest.mark.parametrize("env_id", AGENTS)
def test_no_scenario_draws_noise_from_the_global_generator(env_id: str):
    """mpe2 would take it from `np.random`, which no seed of an environment fixes."""
    env = make(env_id)
    assert {(body.u_noise, body.c_noise) for body in world_of(env).agents} == {(None, None)}
