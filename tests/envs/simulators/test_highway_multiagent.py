from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from highway_env.vehicle.kinematics import Vehicle
from pettingzoo.test import parallel_api_test, parallel_seed_test

from envs.drivers.all_agents import make_driver
from envs.multiagent_observation import check_multiagent_scene
from envs.parallel import ForecastParallelEnv
from envs.readers import multiagent_reader_for
from envs.readers.base import MultiagentReader, MultiagentScene
from envs.readers.highway_multiagent import HighwayMultiagentReader, most_vehicles
from envs.registry import make_multiagent_env
from envs.simulators.highway_multiagent import INTERSECTION, HighwayParallelEnv
from predictor.scene import Scene
from predictor.support.errors import ProtocolError, UserError

SLOWER, IDLE = 0, 1


def empty_road(agents: int = 2, **config: Any) -> HighwayParallelEnv:
    """A reset environment with the agents only."""
    env = HighwayParallelEnv(controlled_vehicles=agents, spawn_probability=0.0, **config)
    env.reset(seed=0)
    env.highway.road.vehicles = list(env.highway.controlled_vehicles)
    return env


def place(env: HighwayParallelEnv, index: int, lane_index: tuple[str, str, int], along_m: float) -> Vehicle:
    """Put an agent's vehicle on a lane, driving along it."""
    vehicle, lane = env.highway.controlled_vehicles[index], env.highway.road.network.get_lane(lane_index)
    vehicle.position, vehicle.heading = lane.position(along_m, 0.0), lane.heading_at(along_m)
    vehicle.lane_index, vehicle.lane, vehicle.target_lane_index = lane_index, lane, lane_index
    return vehicle


def all_idle(env: HighwayParallelEnv) -> dict[str, Any]:
    return dict.fromkeys(env.agents, IDLE)


def run(env: Any, seed: int = 0) -> list[Any]:
    """An episode of random actions, all that step() returns."""
    rng = np.random.default_rng(3)
    steps: list[Any] = [env.reset(seed=seed)]
    while env.agents:
        steps.append(env.step({agent: int(rng.integers(3)) for agent in env.agents}))
    return steps


# --- HighwayParallelEnv -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [INTERSECTION, "intersection-multi-agent-v1"])
def test_simulation_is_highway_envs(env_id: str):
    """Until an agent is gone, the numbers are those of the gymnasium environment."""
    env = HighwayParallelEnv(env_id, controlled_vehicles=3)
    inside = env.highway.__class__(config={"controlled_vehicles": 3})
    observations, _ = env.reset(seed=1)
    expected, _ = inside.reset(seed=1)
    compared = 0
    while len(env.agents) == 3:
        np.testing.assert_array_equal([observations[agent] for agent in env.possible_agents], expected)
        actions = {agent: IDLE + i % 2 for i, agent in enumerate(env.agents)}
        observations, rewards, *_ = env.step(actions)
        expected, _, _, _, info = inside.step(tuple(actions.values()))
        assert list(rewards.values()) == list(info["agents_rewards"])
        compared += 1
    assert compared > 2
    assert env.metadata["name"] == env_id


def test_spaces_are_cached_and_hold_the_observations():
    env = HighwayParallelEnv(controlled_vehicles=3)
    spaces = {agent: (env.observation_space(agent), env.action_space(agent)) for agent in env.possible_agents}
    assert list(spaces) == ["vehicle_0", "vehicle_1", "vehicle_2"]
    for seed in range(2):
        observations, _ = env.reset(seed=seed)
        for agent, (observation_space, action_space) in spaces.items():
            assert observation_space.contains(observations[agent])
            assert env.observation_space(agent) is observation_space
            assert env.action_space(agent) is action_space
    assert spaces["vehicle_0"][1] is not spaces["vehicle_1"][1]


def test_who_crashes_leaves_and_the_others_go_on():
    env = empty_road(3)
    wreck = env.highway.controlled_vehicles[1]
    wreck.crashed = True
    observations, rewards, terminations, truncations, infos = env.step(all_idle(env))
    assert terminations == {"vehicle_0": False, "vehicle_1": True, "vehicle_2": False}
    assert not any(truncations.values())
    assert set(observations) == set(rewards) == set(infos) == set(env.possible_agents)
    assert rewards["vehicle_1"] < -4 < rewards["vehicle_0"]
    assert infos["vehicle_1"] == {"speed_mps": float(wreck.speed), "crashed": True, "arrived": False}
    assert env.agents == ["vehicle_0", "vehicle_2"]
    observations, *rest = env.step(all_idle(env))
    for returned in (observations, *rest):
        assert list(returned) == ["vehicle_0", "vehicle_2"]
    assert wreck in env.highway.road.vehicles
    assert env.agents == ["vehicle_0", "vehicle_2"]


def test_who_arrives_leaves_with_its_reward():
    env = empty_road(2)
    place(env, 0, ("il2", "o2", 0), 20.0)
    _, rewards, terminations, _, infos = env.step(all_idle(env))
    assert terminations == {"vehicle_0": True, "vehicle_1": False}
    assert rewards["vehicle_0"] == env.highway.config["arrived_reward"]
    assert infos["vehicle_0"]["arrived"]
    assert env.agents == ["vehicle_1"]


def test_a_vehicle_without_an_agent_drives_on_and_leaves_the_map():
    env = empty_road(2, duration=30)
    gone = place(env, 0, ("il2", "o2", 0), 30.0)
    target_mps = gone.target_speed
    place(env, 1, ("o0", "ir0", 0), 10.0)
    env.step(all_idle(env))
    seen = []
    for _ in range(11):
        before = gone.position.copy()
        env.step({"vehicle_0": SLOWER, "vehicle_1": IDLE})  # what the first one wants no longer counts
        seen.append(gone in env.highway.road.vehicles)
        if seen[-1]:
            assert np.linalg.norm(gone.position - before) > 5
            assert gone.target_speed == target_mps
    assert seen[0]
    assert not seen[-1]
    assert sorted(seen, reverse=True) == seen
    assert 0 <= gone.lane.length - gone.lane.local_coordinates(gone.position)[0] <= 4 * gone.LENGTH
    assert "vehicle_1" in env.agents


def test_a_vehicle_with_an_agent_is_never_taken_off():
    env = empty_road(2)
    env.highway.has_arrived = lambda vehicle, exit_distance=25: exit_distance > 25  # at the road's end, not arrived
    env.step(all_idle(env))
    assert len(env.highway.road.vehicles) == 2


def test_all_are_truncated_at_the_duration():
    env = empty_road(2, duration=3)
    for step in range(3):
        place(env, 0, ("o0", "ir0", 0), 10.0)
        place(env, 1, ("o1", "ir1", 0), 10.0)
        _, _, terminations, truncations, _ = env.step(all_idle(env))
        assert not any(terminations.values())
        assert truncations == dict.fromkeys(env.possible_agents, step == 2)
    assert env.agents == []


@pytest.mark.parametrize("config", [True, False])
def test_off_the_road_ends_only_if_so_configured(config: bool):
    env = empty_road(2, offroad_terminal=config)
    env.highway.controlled_vehicles[1].position += np.array([0.0, 30.0])
    _, _, terminations, _, _ = env.step(all_idle(env))
    assert terminations == {"vehicle_0": False, "vehicle_1": config}


def test_the_idle_driver_neither_brakes_nor_accelerates():
    """Its action is highway-env's IDLE; action 0 is SLOWER."""
    env = empty_road()
    driver = make_driver("idle", ForecastParallelEnv(env, "intersection"), np.random.default_rng(0))
    target_mps = [vehicle.target_speed for vehicle in env.vehicles.values()]
    for _ in range(2):
        actions = driver(dict.fromkeys(env.agents))
        assert actions == all_idle(env)
        env.step(actions)
    assert [vehicle.target_speed for vehicle in env.vehicles.values()] == target_mps


def test_a_driver_with_pedals_and_wheel_idles_too():
    action = {"type": "MultiAgentAction", "action_config": {"type": "ContinuousAction"}}
    env = empty_road(2, action=action)
    gone = place(env, 0, ("il2", "o2", 0), 30.0)
    straight = {agent: np.zeros(2, np.float32) for agent in env.agents}
    env.step(straight)
    assert env.agents == ["vehicle_1"]
    speed, heading = gone.speed, gone.heading
    env.step({"vehicle_1": np.ones(2, np.float32)})
    assert (gone.speed, gone.heading) == pytest.approx((speed, heading))


@pytest.mark.slow
def test_equal_seeds_give_equal_episodes():
    first, second = HighwayParallelEnv(controlled_vehicles=3), HighwayParallelEnv(controlled_vehicles=3)
    episode = run(first, seed=5)
    assert data_equivalence(run(second, seed=5), episode)
    assert data_equivalence(run(first, seed=5), episode)
    assert not data_equivalence(run(first, seed=6)[0], episode[0])


def test_driving_it_out_of_order_is_named():
    env = HighwayParallelEnv()
    with pytest.raises(ProtocolError, match=r"no agent is on the road; call reset\(\) first"):
        env.step({})
    env.reset(seed=0)
    with pytest.raises(UserError, match="an action for each living agent, vehicle_1 had none"):
        env.step({"vehicle_0": IDLE})
    for wrong in (99, -1, "idle", None, [0, 1], 0.5):
        with pytest.raises(UserError, match=r"vehicle_0 has no action .*; it has Discrete\(3\)"):
            env.step({"vehicle_0": wrong, "vehicle_1": IDLE})
    env.step({"vehicle_0": np.int64(IDLE), "vehicle_1": np.array(IDLE)})
    env.agents = []
    with pytest.raises(ProtocolError, match="no agent is on the road"):
        env.step({"vehicle_0": IDLE, "vehicle_1": IDLE})


def test_another_number_of_agents_at_reset_is_refused():
    env = HighwayParallelEnv(controlled_vehicles=3)
    with pytest.raises(UserError, match="made with 3 agents but its config now has 2; .*not to reset"):
        env.reset(seed=0, options={"config": {"controlled_vehicles": 2}})


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("intersection-v2", "needs an intersection with several agents, got 'intersection-v2'"),
        ("nowhere-v0", "nowhere"),
    ],
)
def test_other_ids_are_refused(env_id: str, message: str):
    with pytest.raises(UserError, match=message):
        HighwayParallelEnv(env_id)


def test_it_can_be_looked_at():
    env = HighwayParallelEnv(render_mode="rgb_array")
    assert env.metadata["render_modes"] == ["human", "rgb_array"]
    assert env.metadata["is_parallelizable"]
    env.reset(seed=0)
    first = env.render()
    env.step(all_idle(env))
    assert first.shape == (600, 600, 3)
    assert (env.render() != first).any()
    env.close()


# --- HighwayMultiagentReader ------------------------------------------------------------------------------------------


def test_reader_sees_every_vehicle_as_it_is():
    env = HighwayParallelEnv(controlled_vehicles=3)
    reader = multiagent_reader_for(env)
    assert isinstance(reader, MultiagentReader)
    env.reset(seed=2)
    for _ in range(4):
        multi = check_multiagent_scene(reader.read(env), reader.spec)
        vehicles = env.highway.road.vehicles
        assert multi.scene.valid.sum() == len(vehicles) > 3
        for i, vehicle in enumerate(vehicles):
            velocity = vehicle.speed * np.array([np.cos(vehicle.heading), np.sin(vehicle.heading)])
            np.testing.assert_allclose(multi.scene.states[i], [*vehicle.position, *velocity])
            assert multi.heading_rad[i] == vehicle.heading
        assert list(multi.index_of) == env.agents
        for agent, vehicle in env.vehicles.items():
            assert vehicles[multi.index_of[agent]] is vehicle
            assert vehicle is env.highway.controlled_vehicles[int(agent[-1])]
        env.step(all_idle(env))


def test_ids_are_the_vehicles_own():
    env = HighwayParallelEnv(controlled_vehicles=2)
    reader = multiagent_reader_for(env)
    env.reset(seed=0)
    known: dict[Vehicle, int] = {}
    for _ in range(3):
        env.highway.road.vehicles.reverse()
        scene = reader.read(env).scene
        for vehicle, number in zip(env.highway.road.vehicles, scene.ids[scene.valid], strict=True):
            assert known.setdefault(vehicle, int(number)) == number
        leaver = next(v for v in env.highway.road.vehicles if v not in env.highway.controlled_vehicles)
        env.highway.road.vehicles.remove(leaver)
        newcomer = Vehicle(env.highway.road, leaver.position + 50.0)
        env.highway.road.vehicles.insert(0, newcomer)
    assert len(set(known.values())) == len(known) == scene.valid.sum() + 2
    reader.reset()
    assert sorted(reader.read(env).scene.ids)[-1] == len(env.highway.road.vehicles) - 1


def test_an_agent_has_an_index_for_its_last_observation_and_no_longer():
    env = empty_road(2)
    reader = multiagent_reader_for(env)
    wreck = env.highway.controlled_vehicles[0]
    number = reader.read(env).scene.ids[0]
    wreck.crashed = True
    env.step(all_idle(env))
    assert env.agents == ["vehicle_1"]
    assert set(reader.read(env).index_of) == {"vehicle_0", "vehicle_1"}
    env.step(all_idle(env))
    multi = reader.read(env)
    assert list(multi.index_of) == ["vehicle_1"]
    assert multi.scene.ids[0] == number  # it is still there, for others to see


def test_an_empty_road_can_be_read():
    env = empty_road(2)
    env.highway.road.vehicles = []
    env._observed = []
    multi = multiagent_reader_for(env).read(env)
    assert not multi.scene.valid.any()
    assert multi.index_of == {}


def test_spec_follows_the_config():
    env = HighwayParallelEnv(controlled_vehicles=3, policy_frequency=5, duration=2)
    spec = multiagent_reader_for(env).spec
    assert (spec.dt_s, spec.frame, spec.has_ego) == (0.2, ("world", "world"), False)
    assert spec.max_agents == most_vehicles(env.highway.config) == 10 + 3 + 11
    narrow = multiagent_reader_for(env, perception_m=30.0, max_agents=20).spec
    assert (narrow.perception_m, narrow.max_agents) == (30.0, 20)


def test_default_holds_the_most_that_can_come():
    env = HighwayParallelEnv(controlled_vehicles=4, initial_vehicle_count=3, spawn_probability=1.0, duration=6)
    counts = []
    env.reset(seed=0)
    while env.agents:
        env.step(dict.fromkeys(env.agents, 0))
        counts.append(len(env.highway.road.vehicles))
    assert most_vehicles(env.highway.config) >= max(counts) > most_vehicles(env.highway.config) / 2


def test_too_small_a_scene_is_named():
    env = HighwayParallelEnv()
    env.reset(seed=0)
    with pytest.raises(UserError, match="HighwayMultiagentReader: .* agents do not fit max_agents=2 of the reader"):
        multiagent_reader_for(env, max_agents=2).read(env)


def test_a_time_step_that_changed_is_named():
    env = HighwayParallelEnv()
    reader = multiagent_reader_for(env)
    env.reset(seed=0, options={"config": {"policy_frequency": 5}})
    with pytest.raises(UserError, match=r"wrapped at dt_s=1 but now steps at dt_s=0.2"):
        reader.read(env)


def test_other_envs_are_refused():
    with pytest.raises(UserError, match="needs a HighwayParallelEnv, got raw_env"):
        HighwayMultiagentReader(make_multiagent_env("simple_tag_v3"))


# --- With forecasts ---------------------------------------------------------------------------------------------------


def displacement_m(forecasts: list[np.ndarray], scenes: list[Scene]) -> float:
    """Mean over all vehicles that are still there `horizon` steps later; by ids."""
    errors = []
    horizon = forecasts[0].shape[1]
    for t in range(len(scenes) - horizon):
        for agent in np.flatnonzero(scenes[t].valid):
            for h in range(1, horizon + 1):
                later = np.flatnonzero(scenes[t + h].valid & (scenes[t + h].ids == scenes[t].ids[agent]))
                if len(later):
                    truth = scenes[t + h].states[later[0], :2]
                    errors.append(float(np.linalg.norm(forecasts[t][agent, h - 1] - truth)))
    return float(np.mean(errors))


@pytest.mark.slow
def test_the_checkpoint_of_the_single_ego_serves_and_beats_constant_velocity():
    env = ForecastParallelEnv(HighwayParallelEnv(controlled_vehicles=3), "intersection")
    model, straight = [], []
    for seed in range(2):
        scenes: list[Scene] = []
        forecasts: dict[str, list[np.ndarray]] = {"model": [], "straight": []}
        observations, _ = env.reset(seed=seed)
        while True:
            multi: MultiagentScene = env.scene
            scenes.append(multi.scene)
            forecasts["model"].append(env.forecast.xy[0, 0].numpy())
            steps_s = np.arange(1, 6)[:, None]
            states = multi.scene.states[:, None]
            forecasts["straight"].append(states[..., :2] + states[..., 2:4] * steps_s)
            for agent, observation in observations.items():
                assert env.observation_space(agent).contains(observation)
                assert all(np.isfinite(value).all() for value in observation.values())
                assert observation["forecast"].any()
            if not env.agents:
                break
            observations, *_ = env.step(dict.fromkeys(env.agents, IDLE))
        model.append(displacement_m(forecasts["model"], scenes))
        straight.append(displacement_m(forecasts["straight"], scenes))
    assert np.mean(model) < 0.9 * np.mean(straight)


@pytest.mark.slow
def test_pettingzoos_contracts():
    parallel_api_test(HighwayParallelEnv(duration=4), num_cycles=8)
    parallel_seed_test(HighwayParallelEnv, num_cycles=3)


@pytest.mark.slow
def test_pettingzoos_contracts_with_forecasts():
    parallel_api_test(ForecastParallelEnv(HighwayParallelEnv(duration=4), "intersection"), num_cycles=8)
    parallel_seed_test(lambda: ForecastParallelEnv(HighwayParallelEnv(), "intersection"), num_cycles=3)


@pytest.mark.slow
def test_equal_seeds_give_equal_forecasts():
    def make() -> ForecastParallelEnv:
        env = HighwayParallelEnv(controlled_vehicles=3, duration=4)
        return ForecastParallelEnv(env, "intersection", num_samples=2, max_agents=5)

    assert data_equivalence(run(make(), seed=4), run(make(), seed=4))
    assert isinstance(make().observation_space("vehicle_0"), gym.spaces.Dict)
