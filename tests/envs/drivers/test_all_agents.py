import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from envs.drivers import all_agents as drivers
from envs.drivers.all_agents import DRIVER_NAMES, Habits, idle_action, make_driver
from envs.registry import MULTIAGENT_IDS, make_multiagent_env
from envs.seeding import driver_rng
from predictor.support.errors import UserError

MPE = [env_id for env_id in MULTIAGENT_IDS if env_id.startswith(("simple", "collect"))]
STAY, PLUS_X, MINUS_X, PLUS_Y = 0, 2, 1, 4
PERFECT = Habits(attention=1.0, slip=0.0, lead_s=0.0, pace=1.0, lean_rad=0.0)


class Booth(ParallelEnv):
    """Agents with an action space of choice; nothing happens."""

    metadata: dict[str, Any] = {"name": "booth_v0"}

    def __init__(self, space: gym.Space, names: Iterable[str] = ("a", "b", "c")) -> None:
        self.space = space
        self.possible_agents = list(names)
        self.agents = list(names)

    def action_space(self, agent: str) -> gym.Space:
        return self.space


def seen(env: ParallelEnv) -> dict[str, Any]:
    return dict.fromkeys(env.agents, np.zeros(1))


def rng(seed: int = 0) -> np.random.Generator:
    return driver_rng(seed)


def played(env: ParallelEnv, name: str, seed: int, steps: int = 1000) -> tuple[list[dict[str, Any]], float]:
    """The actions of an episode, and the mean reward of all agents over it."""
    observations, _ = env.reset(seed=seed)
    driver = make_driver(name, env, rng(seed))
    actions, reward = [], 0.0
    for _ in range(steps):
        if not env.agents:
            break
        actions.append(driver(observations))
        observations, rewards, *_ = env.step(actions[-1])
        reward += float(np.mean(list(rewards.values())))
    return actions, reward


def bodies(env: ParallelEnv) -> dict[str, Any]:
    return {body.name: body for body in env.unwrapped.world.agents}


def put(env: ParallelEnv, **positions: tuple[float, float]) -> None:
    """Where agents stand, at rest; landmarks (landmark_0, ...) too."""
    found = bodies(env) | {f"landmark_{i}": mark for i, mark in enumerate(env.unwrapped.world.landmarks)}
    for name, position in positions.items():
        found[name].state.p_pos, found[name].state.p_vel = np.array(position, dtype=np.float64), np.zeros(2)


@pytest.fixture
def perfect(monkeypatch: pytest.MonkeyPatch) -> None:
    """No agent slips, sleeps, leans or dawdles."""
    monkeypatch.setattr(Habits, "draw", staticmethod(lambda rng: PERFECT))


# --- All drivers ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("env_id", MPE)
def test_every_driver_acts_within_every_space(env_id: str, continuous: bool):
    env = make_multiagent_env(env_id, max_cycles=4, continuous_actions=continuous)
    for name in DRIVER_NAMES:
        actions, _ = played(env, name, seed=1)
        assert len(actions) == 4
        for step in actions:
            assert list(step) == env.possible_agents
            for agent, action in step.items():
                assert env.action_space(agent).contains(action), (name, agent, action)


@pytest.mark.parametrize("name", DRIVER_NAMES)
def test_every_driver_acts_in_pursuit(name: str):
    env = make_multiagent_env("pursuit_v5", max_cycles=10)
    actions, _ = played(env, name, seed=1)
    assert len(actions) == 10
    assert all(env.action_space(agent).contains(a) for step in actions for agent, a in step.items())


@pytest.mark.parametrize("env_id", ["simple_tag_v3", "simple_spread_v3", "pursuit_v5"])
@pytest.mark.parametrize("name", ["random", "varied", "heuristic", "mixed"])
def test_an_episode_is_a_function_of_its_seed(env_id: str, name: str):
    env, again = make_multiagent_env(env_id, max_cycles=15), make_multiagent_env(env_id, max_cycles=15)
    first, _ = played(env, name, seed=3)
    assert played(again, name, seed=3)[0] == first
    again.reset(seed=8)
    assert played(again, name, seed=3)[0] == first
    assert played(env, name, seed=4)[0] != first


@pytest.mark.parametrize("name", DRIVER_NAMES)
def test_only_the_living_act(name: str):
    env = make_multiagent_env("simple_tag_v3")
    observations, _ = env.reset(seed=0)
    driver = make_driver(name, env, rng())
    assert list(driver(observations)) == env.possible_agents
    env.agents = [agent for agent in env.agents if agent != "adversary_1"]
    assert list(driver(observations)) == ["adversary_0", "adversary_2", "agent_0"]
    env.agents = []
    assert driver(observations) == {}


@pytest.mark.parametrize("name", DRIVER_NAMES)
def test_some_agents_may_have_another_driver(name: str):
    env = make_multiagent_env("simple_tag_v3")
    observations, _ = env.reset(seed=0)
    driver = make_driver(name, env, rng())
    assert list(driver({"adversary_1": observations["adversary_1"]})) == ["adversary_1"]


def test_agents_may_come_late():
    env = Booth(gym.spaces.Discrete(5))
    env.agents = ["a"]
    driver = make_driver("varied", env, rng())
    assert list(driver(seen(env))) == ["a"]
    env.agents = ["a", "late"]
    assert list(driver(seen(env))) == ["a", "late"]


def test_drivers_are_made_before_the_first_reset_and_see_through_wrappers():
    for name in DRIVER_NAMES:
        plain, inner = (make_multiagent_env("simple_spread_v3", max_cycles=5) for _ in range(2))
        driver, same = make_driver(name, plain, rng()), make_driver(name, BaseParallelWrapper(inner), rng())
        observations, _ = plain.reset(seed=2)
        others, _ = inner.reset(seed=2)
        assert driver(observations) == same(others)


# --- random, idle, varied ---------------------------------------------------------------------------------------------


def test_random_takes_each_action_equally_often():
    env = Booth(gym.spaces.Discrete(4, start=2))
    driver = make_driver("random", env, rng())
    counts = np.zeros((3, 6))
    for _ in range(2000):
        for agent, action in enumerate(driver(seen(env)).values()):
            counts[agent, action] += 1
    assert not counts[:, :2].any()
    np.testing.assert_allclose(counts[:, 2:] / 2000, 0.25, atol=0.05)


def test_random_fills_a_box():
    low, high = np.array([-1.0, 2.0], np.float32), np.array([0.0, 5.0], np.float32)
    env = Booth(gym.spaces.Box(low, high))
    driver = make_driver("random", env, rng())
    actions = np.array([driver(seen(env))["a"] for _ in range(1000)])
    np.testing.assert_allclose(actions.min(axis=0), low, atol=0.05)
    np.testing.assert_allclose(actions.max(axis=0), high, atol=0.05)


@pytest.mark.parametrize("continuous", [False, True])
def test_idle_agents_stay_where_they_are(continuous: bool):
    env = make_multiagent_env("collect_treasure_v1", max_cycles=5, continuous_actions=continuous)
    env.reset(seed=0)
    before = [body.state.p_pos.copy() for body in bodies(env).values()]
    played(env, "idle", seed=0)
    np.testing.assert_array_equal([body.state.p_pos for body in bodies(env).values()], before)


def test_idle_pursuers_stay_where_they_are():
    env = make_multiagent_env("pursuit_v5", max_cycles=5)
    env.reset(seed=0)
    layer = env.unwrapped.env.pursuer_layer
    before = layer.get_state()
    played(env, "idle", seed=0)
    np.testing.assert_array_equal(env.unwrapped.env.pursuer_layer.get_state(), before)


def test_an_environment_may_say_what_idling_is():
    class Road(Booth):
        def idle_action(self, agent: str) -> int:
            return {"a": 1, "b": 2, "c": 3}[agent]

    env = Road(gym.spaces.Discrete(5))
    assert make_driver("idle", env, rng())(seen(env)) == {"a": 1, "b": 2, "c": 3}
    assert idle_action(BaseParallelWrapper(env), "b") == 2


def test_idling_is_zero_or_the_nearest_to_it():
    assert idle_action(Booth(gym.spaces.Discrete(3, start=4)), "a") == 4
    space = gym.spaces.Box(np.array([-1.0, 2.0], np.float32), np.array([1.0, 3.0], np.float32))
    action = idle_action(Booth(space), "a")
    np.testing.assert_array_equal(action, [0.0, 2.0])
    assert space.contains(action)


def shares(actions: list[int]) -> np.ndarray:
    return np.bincount(actions, minlength=5) / len(actions)


def test_varied_agents_keep_their_own_taste_for_an_episode():
    env = Booth(gym.spaces.Discrete(5))
    driver = make_driver("varied", env, rng(1))
    steps = [driver(seen(env)) for _ in range(6000)]
    tastes = {}
    for agent in env.agents:
        early, late = ([step[agent] for step in half] for half in (steps[:3000], steps[3000:]))
        np.testing.assert_allclose(shares(early), shares(late), atol=0.1)
        tastes[agent] = shares(early + late)
    for one, other in itertools.combinations(tastes.values(), 2):
        assert np.abs(one - other).sum() > 0.3


def test_varied_agents_differ_in_persistence():
    env = Booth(gym.spaces.Box(0.0, 1.0, (1,)), [str(i) for i in range(20)])
    driver = make_driver("varied", env, rng())
    steps = [driver(seen(env)) for _ in range(300)]
    kept = [np.mean([float(s[a][0]) == float(t[a][0]) for s, t in itertools.pairwise(steps)]) for a in env.agents]
    assert min(kept) < 0.2
    assert max(kept) > 0.7
    assert max(kept) < 1.0


def test_a_heuristic_repeats_what_it_chose_even_if_the_environment_changed_the_action():
    space, choice = gym.spaces.Box(-1, 1, (2,)), np.array([0.5, -0.5], dtype=np.float32)
    habits = replace(Habits.draw(rng()), attention=0.0, slip=0.0)
    last: list[Any] = []
    for _ in range(3):
        action = drivers._choose(space, rng(), habits, lambda: choice.copy(), last, None)
        np.testing.assert_array_equal(action, choice)
        action *= 0.5


def test_mixed_agents_are_of_all_kinds_and_stay_so(monkeypatch: pytest.MonkeyPatch):
    env = make_multiagent_env("simple_tag_v3")
    env.reset(seed=0)
    monkeypatch.setattr(drivers, "uniform_action", lambda space, rng, who: 1)
    monkeypatch.setattr(drivers, "varied_actions", lambda space, rng, who: lambda seen: 2)
    monkeypatch.setattr(drivers, "_heuristic", lambda env, rng: lambda agent, own: lambda seen: 3)
    kinds = []
    for seed in range(100):
        driver = make_driver("mixed", env, rng(seed))
        kinds += list((first := driver(seen(env))).values())
        assert driver(seen(env)) == first
    np.testing.assert_allclose(np.bincount(kinds, minlength=4) / len(kinds), [0, 1 / 3, 1 / 3, 1 / 3], atol=0.08)


def test_mixed_does_without_a_heuristic_where_there_is_none(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(drivers, "varied_actions", lambda space, rng, who: lambda seen: 9)
    env = Booth(gym.spaces.Discrete(5))
    found = [set(make_driver("mixed", env, rng(seed))(seen(env)).values()) for seed in range(20)]
    assert {9} < set.union(*found) <= {0, 1, 2, 3, 4, 9}


# --- Heuristics -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("env_id", [i for i in MPE if i not in ("simple_tag_v3", "simple_adversary_v3")])
def test_heuristics_earn_more_than_chance(env_id: str, continuous: bool):
    env = make_multiagent_env(env_id, max_cycles=50, continuous_actions=continuous)
    earned = {name: [played(env, name, seed)[1] for seed in range(4)] for name in ("heuristic", "random")}
    assert np.mean(earned["heuristic"]) > np.mean(earned["random"]) + 0.5 * np.std(earned["random"])
    assert np.mean(earned["heuristic"]) > np.mean(earned["random"]) + 3.0


def contacts(env: ParallelEnv, name: str, seed: int) -> tuple[int, float]:
    """Steps at which prey is caught in an episode, and how far out it runs [m]."""
    observations, _ = env.reset(seed=seed)
    driver = make_driver(name, env, rng(seed))
    caught, out_m = 0, 0.0
    while env.agents:
        observations, rewards, *_ = env.step(driver(observations))
        caught += rewards["adversary_0"] > 0
        out_m = max(out_m, np.abs(bodies(env)["agent_0"].state.p_pos).max())
    return caught, out_m


def test_hunters_catch_prey_that_stays_in_the_arena():
    env = make_multiagent_env("simple_tag_v3", max_cycles=60)
    hunted, chance = ([contacts(env, name, seed) for seed in range(6)] for name in ("heuristic", "random"))
    assert sum(caught for caught, _ in hunted) > 2 * sum(caught for caught, _ in chance)
    assert np.median([out_m for _, out_m in hunted]) < 1.3


@pytest.mark.parametrize(
    ("hunter", "prey", "hunts", "flees"),
    [
        ((-0.5, 0.0), (0.0, 0.0), PLUS_X, PLUS_X),
        ((0.5, 0.0), (0.0, 0.0), MINUS_X, MINUS_X),
        ((0.0, -0.5), (0.0, 0.0), PLUS_Y, PLUS_Y),
        ((-0.8, 0.0), (0.99, 0.0), PLUS_X, MINUS_X),  # back from the arena's edge
    ],
)
def test_hunters_chase_and_prey_flees(
    perfect: None, hunter: tuple[float, float], prey: tuple[float, float], hunts: int, flees: int
):
    env = make_multiagent_env("simple_tag_v3", num_adversaries=1, num_obstacles=0)
    observations, _ = env.reset(seed=0)
    put(env, adversary_0=hunter, agent_0=prey)
    assert make_driver("heuristic", env, rng())(observations) == {"adversary_0": hunts, "agent_0": flees}


def test_prey_turns_away_from_obstacles(perfect: None):
    env = make_multiagent_env("simple_tag_v3", num_adversaries=1, num_obstacles=1)
    observations, _ = env.reset(seed=0)
    put(env, adversary_0=(-0.6, 0.0), agent_0=(0.0, 0.0), landmark_0=(0.3, -0.05))
    assert make_driver("heuristic", env, rng())(observations)["agent_0"] != PLUS_X
    put(env, landmark_0=(0.9, -0.9))
    assert make_driver("heuristic", env, rng())(observations)["agent_0"] == PLUS_X


def test_hunters_lead_by_the_velocity_of_the_prey(monkeypatch: pytest.MonkeyPatch):
    env = make_multiagent_env("simple_tag_v3", num_adversaries=1, num_obstacles=0)
    observations, _ = env.reset(seed=0)
    put(env, adversary_0=(-0.5, 0.0), agent_0=(0.0, 0.0))
    bodies(env)["agent_0"].state.p_vel = np.array([0.0, 1.3])
    for lead_s, expected in ((0.0, PLUS_X), (1.0, PLUS_Y)):
        habits = Habits(attention=1.0, slip=0.0, lead_s=lead_s, pace=1.0, lean_rad=0.0)
        monkeypatch.setattr(Habits, "draw", staticmethod(lambda rng, habits=habits: habits))
        assert make_driver("heuristic", env, rng())(observations)["adversary_0"] == expected


@pytest.mark.parametrize("continuous", [False, True])
def test_agents_brake_before_their_goal(perfect: None, continuous: bool):
    env = make_multiagent_env("simple_v3", max_cycles=60, continuous_actions=continuous)
    observations, _ = env.reset(seed=0)
    put(env, agent_0=(-0.9, 0.2), landmark_0=(0.8, -0.3))
    driver = make_driver("heuristic", env, rng())
    distance_m = []
    while env.agents:
        observations, *_ = env.step(driver(observations))
        distance_m.append(np.linalg.norm(bodies(env)["agent_0"].state.p_pos - [0.8, -0.3]))
    arrived = int(np.argmax(np.array(distance_m) < 0.15))
    assert 0 < arrived < 25
    assert max(distance_m[arrived:]) < 0.25


def test_agents_spread_over_all_places_and_then_swap(perfect: None):
    env = make_multiagent_env("simple_spread_v3", max_cycles=100)
    observations, _ = env.reset(seed=1)
    put(env, landmark_0=(-0.8, 0.0), landmark_1=(0.8, 0.0), landmark_2=(0.0, 0.8))
    put(env, agent_0=(0.7, 0.3), agent_1=(-0.1, 0.4), agent_2=(-0.7, -0.5))
    driver = make_driver("heuristic", env, rng())
    places = np.array([mark.state.p_pos for mark in env.unwrapped.world.landmarks])
    taken = []
    while env.agents:
        observations, *_ = env.step(driver(observations))
        here = np.array([body.state.p_pos for body in bodies(env).values()])
        distance_m = np.linalg.norm(here[:, None] - places, axis=-1)
        if (distance_m.min(axis=1) < 0.15).all():
            taken.append(tuple(distance_m.argmin(axis=1).tolist()))
    assert taken[0] == (1, 2, 0)  # the nearest pairs
    assert all(sorted(t) == [0, 1, 2] for t in taken)
    assert len(set(taken)) > 1


def test_good_agents_cover_all_landmarks_and_the_adversary_follows_the_best_placed(perfect: None):
    env = make_multiagent_env("simple_adversary_v3")
    observations, _ = env.reset(seed=0)
    put(env, landmark_0=(-0.8, 0.0), landmark_1=(0.8, 0.0))
    put(env, agent_0=(-0.5, 0.0), agent_1=(-0.6, 0.0), adversary_0=(0.0, 0.0))
    expected = {"adversary_0": MINUS_X, "agent_0": PLUS_X, "agent_1": MINUS_X}
    assert make_driver("heuristic", env, rng())(observations) == expected


def test_the_pusher_guards_the_landmark_that_the_agent_is_nearest_to(perfect: None):
    env = make_multiagent_env("simple_push_v3")
    observations, _ = env.reset(seed=0)
    put(env, landmark_0=(-0.8, 0.0), landmark_1=(0.8, 0.0), agent_0=(-0.2, 0.0), adversary_0=(0.5, 0.0))
    bodies(env)["agent_0"].goal_a = env.unwrapped.world.landmarks[1]
    expected = {"adversary_0": MINUS_X, "agent_0": PLUS_X}
    assert make_driver("heuristic", env, rng())(observations) == expected


def test_prey_eats_only_while_no_adversary_is_near(perfect: None):
    env = make_multiagent_env("simple_world_comm_v3", num_adversaries=1, num_good=1, num_food=1, num_obstacles=1)
    observations, _ = env.reset(seed=0)
    world = env.unwrapped.world
    put(env, leadadversary_0=(-0.9, 0.0), agent_0=(0.0, 0.0), landmark_0=(0.9, 0.9))
    world.food[0].state.p_pos = np.array([-0.3, 0.0])
    driver = make_driver("heuristic", env, rng())
    assert driver(observations)["agent_0"] == MINUS_X
    put(env, leadadversary_0=(-0.5, 0.0))
    assert driver(observations)["agent_0"] == PLUS_X


def test_collectors_fetch_and_deliver_and_deposits_come_to_meet_them(perfect: None):
    env = make_multiagent_env("collect_treasure_v1", num_collectors=1, num_treasures=1)
    observations, _ = env.reset(seed=0)
    put(env, collector_0=(0.0, 0.0), deposit_0=(0.5, 0.0), deposit_1=(-0.5, 0.0), landmark_0=(0.0, 0.5))
    driver = make_driver("heuristic", env, rng())
    fetching = {"collector_0": PLUS_Y, "deposit_0": MINUS_X, "deposit_1": PLUS_X}
    assert driver(observations) == fetching
    bodies(env)["collector_0"].holding = 1
    assert driver(observations)["collector_0"] == MINUS_X
    env.unwrapped.world.landmarks[0].alive = False
    bodies(env)["collector_0"].holding = None
    assert driver(observations)["collector_0"] == STAY


def test_the_nearest_pair_chooses_first():
    here = np.array([[0.0, 0.0], [1.0, 0.0], [5.0, 0.0]])
    places = np.array([[1.1, 0.0], [6.0, 0.0], [-3.0, 0.0]])
    assert drivers._nearest_pairs(here, places).tolist() == [2, 0, 1]
    assert drivers._nearest_pairs(here, places[:1]).tolist() == [0, 0, 0]


@pytest.mark.slow
def test_pursuers_close_in_and_catch():
    env = make_multiagent_env("pursuit_v5", max_cycles=150, n_evaders=12)
    left = {}
    for name in ("heuristic", "random"):
        left[name] = 0
        for seed in range(3):
            played(env, name, seed)
            left[name] += len(env.unwrapped.env.evader_layer.allies)
    assert left["heuristic"] < left["random"]


def test_pursuers_go_round_walls(perfect: None):
    env = make_multiagent_env("pursuit_v5", n_pursuers=1, n_evaders=1, freeze_evaders=True, max_cycles=40)
    observations, _ = env.reset(seed=0)
    grid = env.unwrapped.env
    grid.pursuer_layer.set_position(0, 1, 1)
    grid.evader_layer.set_position(0, 1, 13)
    driver = make_driver("heuristic", env, rng())
    cells = []
    while env.agents:
        observations, *_ = env.step(driver(observations))
        cells.append(tuple(grid.pursuer_layer.get_position(0)))
    assert abs(cells[-1][0] - 1) + abs(cells[-1][1] - 13) == 1
    assert cells[-1] == cells[20]


def test_each_agent_has_habits_of_its_own_in_each_episode(monkeypatch: pytest.MonkeyPatch):
    drawn: list[Habits] = []
    draw = Habits.draw
    monkeypatch.setattr(Habits, "draw", staticmethod(lambda rng: drawn.append(draw(rng)) or drawn[-1]))
    env = make_multiagent_env("simple_tag_v3", max_cycles=5)
    for seed in range(5):
        played(env, "heuristic", seed)
    assert len(set(drawn)) == len(drawn) == 20
    assert all(0.5 <= h.attention <= 1 and 0 <= h.slip <= 0.1 and 0.5 <= h.pace <= 1 for h in drawn)


@pytest.mark.parametrize(("attention", "slip"), [(0.3, 0.0), (1.0, 1.0)])
def test_inattention_repeats_and_slips_are_random(attention: float, slip: float, monkeypatch: pytest.MonkeyPatch):
    habits = Habits(attention=attention, slip=slip, lead_s=0.0, pace=1.0, lean_rad=0.0)
    monkeypatch.setattr(Habits, "draw", staticmethod(lambda rng: habits))
    env = make_multiagent_env("simple_v3")
    observations, _ = env.reset(seed=0)
    intended = itertools.count()
    monkeypatch.setattr(drivers._MpeIntentions, "_discrete", lambda self, *_: next(intended) % 5)
    driver = make_driver("heuristic", env, rng())
    actions = [driver(observations)["agent_0"] for _ in range(2000)]
    kept = np.mean([one == two for one, two in itertools.pairwise(actions)])
    assert kept == pytest.approx(1 - attention if slip == 0 else 0.2, abs=0.05)
    assert (next(intended) == 0) == (slip == 1.0)


# --- Errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["fast", "policy.zip"])
def test_unknown_names_are_listed(name: str):
    with pytest.raises(
        UserError, match=rf"driver must be one of {', '.join(DRIVER_NAMES)} or own:module:function, got '{name}'"
    ):
        make_driver(name, make_multiagent_env("simple_tag_v3"), rng())


def test_where_there_is_no_heuristic_the_others_are_named():
    expected = "no heuristic drives booth_v0, only pursuit and mpe2's simple, .*; use random, idle, varied, mixed"
    with pytest.raises(UserError, match=expected):
        make_driver("heuristic", Booth(gym.spaces.Discrete(5)), rng())


@pytest.mark.parametrize("name", DRIVER_NAMES)
@pytest.mark.parametrize("space", [gym.spaces.Text(3), gym.spaces.Box(-np.inf, np.inf, (2,))])
def test_spaces_that_no_driver_supports_are_named_early(space: gym.Space, name: str):
    with pytest.raises(UserError, match=r"drivers need a Discrete, .* or bounded Box action space, got (Text|Box)"):
        make_driver(name, Booth(space), rng())
