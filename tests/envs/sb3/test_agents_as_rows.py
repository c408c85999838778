"""Agents as rows of one policy: every returned array and info, deaths, joins, padding, statistics and learning."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from mpe2 import simple_spread_v3, simple_tag_v3
from pettingzoo import ParallelEnv
from pettingzoo.sisl import pursuit_v5
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

from envs.sb3.agents_as_rows import AgentMonitor, ParallelVecEnv
from envs.sb3.partners import random_actions
from predictor.support.errors import ProtocolError, UserError

SIZES = {"ant_0": 2, "ant_1": 2, "bee_0": 3}
GAMMA, LAMBDA = 0.9, 0.8

Step = Mapping[str, tuple[float, float, str]]
"""Agent → what it sees (its value everywhere), its reward, its end ("", "terminated", "truncated", "both")."""

FIRST: tuple[Step, ...] = (
    {"ant_0": (1, 0, ""), "ant_1": (11, 0, "")},
    {"ant_0": (2, 0.5, ""), "ant_1": (12, -1, "")},
    {"ant_0": (3, 1.5, ""), "ant_1": (13, 7, "terminated"), "bee_0": (23, 99, "")},
    {"ant_0": (4, 2.5, ""), "bee_0": (24, 3, "")},
    {"ant_0": (5, 3.5, "truncated"), "bee_0": (25, 4, "terminated")},
)
"""ant_1 dies after two steps, at the step at which bee_0 joins; the episode has four steps."""
SECOND: tuple[Step, ...] = (
    {"ant_0": (31, 0, ""), "ant_1": (41, 0, ""), "bee_0": (51, 0, "")},
    {"ant_0": (32, 1, ""), "ant_1": (42, 2, ""), "bee_0": (52, 3, "truncated")},
    {"ant_0": (33, 4, "both"), "ant_1": (43, 5, "terminated")},
)
"""bee_0 is truncated after one step; ant_0 is terminated and truncated at once."""


class Scripted(ParallelEnv):
    """Plays the same episodes whatever the actions are, and keeps the actions."""

    metadata = {"name": "scripted", "render_fps": 7}
    render_mode = "rgb_array"

    def __init__(self, *episodes: tuple[Step, ...], sizes: Mapping[str, int] = SIZES):
        self.episodes, self.sizes = episodes or (FIRST, SECOND), sizes
        self.possible_agents = list(sizes)
        self.agents: list[str] = []
        self.acted: list[dict[str, Any]] = []
        self.resets: list[tuple[int | None, Any]] = []
        self.calls = 0
        self._observation_spaces = {a: spaces.Box(-100, 100, (n,), np.float32) for a, n in sizes.items()}
        self._action_spaces = {a: spaces.Discrete(n) for a, n in sizes.items()}

    def observation_space(self, agent: str) -> spaces.Space:
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self._action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.episode = self.episodes[len(self.resets) % len(self.episodes)]
        self.resets.append((seed, options))
        self.time = 0
        self.agents = list(self.episode[0])
        return self._seen(), {agent: {"reset": len(self.resets)} for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        assert set(actions) == set(self.agents)
        self.acted.append(actions)
        self.time += 1
        now = self.episode[self.time]
        self.agents = [agent for agent, (_, _, end) in now.items() if not end]
        return (
            self._seen(),
            {agent: reward for agent, (_, reward, _) in now.items()},
            {agent: end in ("terminated", "both") for agent, (_, _, end) in now.items()},
            {agent: end in ("truncated", "both") for agent, (_, _, end) in now.items()},
            {agent: {"time": self.time} for agent in now},
        )

    def _seen(self) -> dict[str, np.ndarray]:
        now = self.episode[self.time]
        return {agent: np.full(self.sizes[agent], value, np.float32) for agent, (value, _, _) in now.items()}

    def render(self) -> np.ndarray:
        return np.full((4, 6, 3), len(self.acted), np.uint8)

    def count(self, by: int) -> int:
        self.calls += by
        return self.calls

    def close(self) -> None:
        self.agents = ["closed"]


def row(value: float, agent: str) -> list[float]:
    """A padded observation with the one-hot of ant or bee behind it; `value` 0 is an environment that waits."""
    if not value:
        return [0.0] * 5
    return [value, value, 0, 1, 0] if agent.startswith("ant") else [value, value, value, 0, 1]


def rows(*values: float) -> np.ndarray:
    return np.array([row(value, agent) for value, agent in zip(values, SIZES, strict=True)], np.float32)


def play(venv: ParallelVecEnv, steps: int) -> list[tuple[Any, np.ndarray, np.ndarray, list[dict]]]:
    return [venv.step(np.zeros(venv.num_envs, int)) for _ in range(steps)]


# What the rows see, their rewards, which are done, truncated, alive and what they saw last, per step of two episodes.
EXPECTED = [
    ((2, 12, 0), (0.5, -1, 0), (0, 0, 0), (0, 0, 0), (1, 1, 0), {}),
    ((3, 0, 23), (1.5, 7, 0), (0, 1, 1), (0, 0, 0), (1, 1, 0), {1: 13, 2: 0}),
    ((4, 0, 24), (2.5, 0, 3), (0, 0, 0), (0, 0, 0), (1, 0, 1), {}),
    ((31, 41, 51), (3.5, 0, 4), (1, 1, 1), (1, 0, 0), (1, 0, 1), {0: 5, 1: 0, 2: 25}),
    ((32, 42, 0), (1, 2, 3), (0, 0, 1), (0, 0, 1), (1, 1, 1), {2: 52}),
    ((1, 11, 0), (4, 5, 0), (1, 1, 1), (0, 0, 0), (1, 1, 0), {0: 33, 1: 43, 2: 0}),
    ((2, 12, 0), (0.5, -1, 0), (0, 0, 0), (0, 0, 0), (1, 1, 0), {}),
]


def test_every_array_and_info_over_two_episodes():
    venv = ParallelVecEnv([Scripted])
    first = venv.reset()
    np.testing.assert_array_equal(first, rows(1, 11, 0))
    times = [1, 2, 3, 4, 1, 2, 1]
    for step, (seen, rewards, dones, truncated, alive, closing) in enumerate(EXPECTED):
        observations, actual_rewards, actual_dones, infos = venv.step(np.zeros(3, int))
        np.testing.assert_array_equal(observations, rows(*seen), err_msg=str(step))
        np.testing.assert_array_equal(actual_rewards, np.array(rewards, np.float32), err_msg=str(step))
        np.testing.assert_array_equal(actual_dones, np.array(dones, bool), err_msg=str(step))
        assert (actual_rewards.dtype, actual_dones.dtype) == (np.float32, np.bool_)
        for i, (agent, info) in enumerate(zip(SIZES, infos, strict=True)):
            expected = {"alive": bool(alive[i]), "TimeLimit.truncated": bool(truncated[i])}
            expected |= {"time": times[step]} if alive[i] else {}
            last = info.pop("terminal_observation", None)
            assert info == expected, (step, agent)
            assert (last is not None) == (i in closing) == bool(dones[i]), (step, agent)
            if last is not None:
                np.testing.assert_array_equal(last, np.array(row(closing[i], agent), np.float32))
    np.testing.assert_array_equal(first, rows(1, 11, 0), err_msg="returned arrays are the caller's to keep")


def test_only_the_living_act():
    venv = ParallelVecEnv([Scripted])
    venv.reset()
    for _ in range(4):
        venv.step(np.array([1, 0, 2]))
    assert venv.envs[0].acted == [
        {"ant_0": 1, "ant_1": 0},
        {"ant_0": 1, "ant_1": 0},
        {"ant_0": 1, "bee_0": 2},
        {"ant_0": 1, "bee_0": 2},
    ]


def test_copies_do_not_touch_each_other():
    def shifted() -> Scripted:
        return Scripted(SECOND, FIRST)

    together = ParallelVecEnv([Scripted, shifted])
    apart = [ParallelVecEnv([Scripted]), ParallelVecEnv([shifted])]
    np.testing.assert_array_equal(together.reset(), np.concatenate([venv.reset() for venv in apart]))
    for both, *single in zip(play(together, 12), *(play(venv, 12) for venv in apart), strict=True):
        for i in range(3):
            np.testing.assert_array_equal(both[i], np.concatenate([one[i] for one in single]))
        np.testing.assert_equal(both[3], [*single[0][3], *single[1][3]])


def test_each_env_has_its_agent_copy_and_role():
    venv = ParallelVecEnv([Scripted, Scripted])
    assert venv.agents_of_envs == [*SIZES, *SIZES]
    assert venv.copies_of_envs == [0, 0, 0, 1, 1, 1]
    assert venv.roles_of_envs == [0, 0, 1, 0, 0, 1]


def test_an_agent_dropped_without_a_flag_counts_as_truncated_at_what_it_saw_last():
    class Forgetful(Scripted):
        def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
            seen, rewards, *_ = super().step(actions)
            self.agents = []
            return seen if self.time > 1 else {}, rewards, {}, {}, {}

    venv = ParallelVecEnv([Forgetful])
    venv.reset()
    _, rewards, dones, infos = venv.step(np.zeros(3, int))
    np.testing.assert_array_equal(rewards, [0.5, -1, 0])
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [True, True, False]
    np.testing.assert_array_equal(infos[0]["terminal_observation"], row(1, "ant_0"))


def test_an_env_that_writes_into_arrays_of_its_own_does_not_change_what_was_seen_last():
    class Reuses(Scripted):
        def _seen(self) -> dict[str, np.ndarray]:
            self.arrays = getattr(self, "arrays", {a: np.zeros(n, np.float32) for a, n in SIZES.items()})
            for agent, seen in super()._seen().items():
                self.arrays[agent][:] = seen
            return {agent: self.arrays[agent] for agent in self.episode[self.time]}

    venvs = ParallelVecEnv([Reuses]), ParallelVecEnv([Scripted])
    for venv in venvs:
        venv.reset()
    for reused, plain in zip(*(play(venv, 6) for venv in venvs), strict=True):
        for one, other in zip(reused[3], plain[3], strict=True):
            np.testing.assert_array_equal(one.get("terminal_observation", ()), other.get("terminal_observation", ()))


@pytest.mark.parametrize("seed", [np.int64(3), np.array([3, 4]), [3, 4], 3])
def test_seeds_may_be_of_numpy(seed: Any):
    venv = ParallelVecEnv([Scripted, Scripted])
    venv.seed(seed)
    venv.reset()
    seeds = [env.resets[0][0] for env in venv.envs]
    assert seeds == [3, 4] and all(type(one) is int for one in seeds)


@pytest.mark.parametrize("seed", [[3], [0.2, 0.9], 1.5, -1, [0, -1], "a", True, [None, 1]])
def test_each_copy_needs_a_seed(seed: Any):
    with pytest.raises(UserError, match="seed needs a whole number from 0 on, or one for each of 2 copies, got"):
        ParallelVecEnv([Scripted, Scripted]).seed(seed)


def test_an_env_that_never_empties_its_agents_still_ends():
    class Keeps(Scripted):
        def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
            result = super().step(actions)
            self.agents = list(self.episode[self.time])
            return result

    venv = ParallelVecEnv([lambda: Keeps(SECOND[:1] + ({a: (9, 1, "terminated") for a in SIZES},))])
    venv.reset()
    observations, _, dones, _ = venv.step(np.zeros(3, int))
    assert dones.all()
    np.testing.assert_array_equal(observations, rows(31, 41, 51))


class Lives(BaseCallback):
    """Keeps each rollout as PPO saw it, with the values of closing observations under the policy that played."""

    def __init__(self) -> None:
        super().__init__()
        self.truncated: dict[tuple[int, int], float] = {}
        self.alive: list[list[bool]] = []
        self.step = 0

    def value(self, observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return self.model.policy.predict_values(torch.as_tensor(observations)).numpy().flatten()

    def _on_step(self) -> bool:
        self.alive.append([info["alive"] for info in self.locals["infos"]])
        for i, info in enumerate(self.locals["infos"]):
            if info["TimeLimit.truncated"]:
                self.truncated[self.step, i] = float(self.value(info["terminal_observation"][None])[0])
        self.step += 1
        return True

    def _on_rollout_end(self) -> None:
        buffer = self.model.rollout_buffer
        self.advantages, self.returns, self.values = (
            array.copy() for array in (buffer.advantages, buffer.returns, buffer.values)
        )
        self.after = self.value(self.locals["new_obs"])


def advantages_of_life(rewards: Sequence[float], values: np.ndarray, last_value: float) -> list[float]:
    """GAE of one agent's life, written out."""
    values = np.append(values, last_value)
    deltas = [reward + GAMMA * values[t + 1] - values[t] for t, reward in enumerate(rewards)]
    return [sum((GAMMA * LAMBDA) ** (k - t) * deltas[k] for k in range(t, len(deltas))) for t in range(len(deltas))]


def test_advantages_of_the_living_are_those_of_each_agent_alone():
    venv = ParallelVecEnv([Scripted])
    kwargs = {"policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 3}
    model = PPO("MlpPolicy", venv, n_steps=8, batch_size=8, n_epochs=1, gamma=GAMMA, gae_lambda=LAMBDA, **kwargs)
    seen = Lives()
    model.learn(24, callback=seen)
    # (row, first step, rewards, how it ends), eight steps: two episodes and the first two steps of the third
    lives = [
        (0, 0, [0.5, 1.5, 2.5, 3.5], "truncated"),
        (0, 4, [1, 4], "terminated"),
        (0, 6, [0.5, 1.5], "goes on"),
        (1, 0, [-1, 7], "terminated"),
        (1, 4, [2, 5], "terminated"),
        (1, 6, [-1, 7], "terminated"),
        (2, 2, [3, 4], "terminated"),
        (2, 4, [3], "truncated"),
    ]
    alive = np.zeros((8, 3), bool)
    for i, start, rewards, end in lives:
        steps = slice(start, start + len(rewards))
        last = {"truncated": seen.truncated.get((steps.stop - 1, i)), "terminated": 0.0, "goes on": seen.after[i]}[end]
        assert last is not None
        expected = advantages_of_life(rewards, seen.values[steps, i], last)
        np.testing.assert_allclose(seen.advantages[steps, i], expected, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(seen.returns[steps, i], expected + seen.values[steps, i], rtol=1e-5, atol=1e-5)
        alive[steps, i] = True
    np.testing.assert_array_equal(np.array(seen.alive), alive)
    # A wait that was closed is worth nothing, whatever comes after it.
    for i, start, length in ((1, 2, 2), (2, 0, 2), (2, 5, 1)):
        expected = advantages_of_life([0] * length, seen.values[start : start + length, i], 0.0)
        np.testing.assert_allclose(seen.advantages[start : start + length, i], expected, rtol=1e-5, atol=1e-5)


def episodes_of(venv: VecMonitor, steps: int) -> list[tuple[int, int, float, int]]:
    """(step, row, return, length) of every episode that the monitor reports."""
    venv.reset()
    found = []
    for step in range(steps):
        infos = venv.step(np.zeros(venv.num_envs, int))[3]
        found += [
            (step, i, info["episode"]["r"], info["episode"]["l"]) for i, info in enumerate(infos) if "episode" in info
        ]
    return found


LIVES = [(1, 1, 6, 2), (3, 0, 8, 4), (3, 2, 7, 2), (4, 2, 3, 1), (5, 0, 5, 2), (5, 1, 7, 2)]
WAITS = [(1, 2, 0, 2), (3, 1, 0, 2), (5, 2, 0, 1)]


def test_the_agent_monitor_counts_lives_and_no_waits(tmp_path):
    venv = AgentMonitor(ParallelVecEnv([Scripted]), str(tmp_path / "log"), info_keywords=("time",))
    assert episodes_of(venv, 6) == LIVES
    assert venv.episode_count == len(LIVES)
    venv.close()
    lines = (tmp_path / "log.monitor.csv").read_text().splitlines()
    assert [tuple(float(x) for x in line.split(",")[:2]) for line in lines[2:]] == [(r, n) for _, _, r, n in LIVES]


def test_sb3s_own_monitor_counts_each_wait_as_an_episode_of_return_zero():
    assert episodes_of(VecMonitor(ParallelVecEnv([Scripted])), 6) == sorted(LIVES + WAITS)


def test_evaluation_through_the_agent_monitor_averages_lives():
    venv = AgentMonitor(ParallelVecEnv([Scripted]))
    model = PPO("MlpPolicy", venv, device="cpu", policy_kwargs={"net_arch": [4]})
    returns, lengths = evaluate_policy(model, venv, n_eval_episodes=6, return_episode_rewards=True)
    assert (returns, lengths) == ([r for _, _, r, _ in LIVES], [n for _, _, _, n in LIVES])


# --- spaces


def with_spaces(
    observations: Mapping[str, spaces.Space],
    actions: Mapping[str, spaces.Space],
    see: Callable[[str, Any], Any] = lambda agent, seen: seen,
) -> Callable[[], ParallelEnv]:
    """One-step episodes of agents with these spaces; what they see is `see(agent, a sample)`."""

    class Typed(ParallelEnv):
        metadata: dict[str, Any] = {}

        def __init__(self) -> None:
            self.possible_agents = list(observations)
            self.acted: list[dict[str, Any]] = []
            self.samples = {agent: see(agent, space.sample()) for agent, space in observations.items()}

        def observation_space(self, agent: str) -> spaces.Space:
            return observations[agent]

        def action_space(self, agent: str) -> spaces.Space:
            return actions[agent]

        def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
            self.agents = list(observations)
            return self.samples, {agent: {} for agent in self.agents}

        def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
            self.acted.append(actions)
            names, self.agents = self.agents, []
            return self.samples, *({agent: value for agent in names} for value in (0.0, True, False)), {}

    return Typed


BOX2, BOX3 = spaces.Box(-1, 1, (2,), np.float32), spaces.Box(0.5, 2, (3,), np.float32)
FIVE, THREE = spaces.Discrete(5), spaces.Discrete(3, start=-1)


def test_padded_bounds_hold_every_agent_the_padding_and_a_waiting_env():
    venv = ParallelVecEnv([with_spaces({"a": BOX2, "b": BOX3}, {"a": FIVE, "b": FIVE})])
    assert venv.observation_space == spaces.Box(
        np.array([-1, -1, 0, 0, 0], np.float32), np.array([2, 2, 2, 1, 1], np.float32)
    )
    assert all(venv.observation_space.contains(seen) for seen in venv.reset())
    assert venv.observation_space.contains(np.zeros(5, np.float32))


def test_equal_spaces_stay_as_they_are_unless_the_indicator_is_asked_for():
    factory = with_spaces({"x_0": BOX2, "x_1": BOX2, "y_0": BOX2}, dict.fromkeys(("x_0", "x_1", "y_0"), FIVE))
    assert ParallelVecEnv([factory]).observation_space == BOX2
    venv = ParallelVecEnv([factory], agent_indicator=True)
    np.testing.assert_array_equal(venv.reset()[:, 2:], [[1, 0], [1, 0], [0, 1]])
    one_role = ParallelVecEnv([factory], agents=["x_0", "x_1"], partner="random", agent_indicator=True)
    np.testing.assert_array_equal(one_role.reset()[:, 2:], [[1], [1]])


def test_unequal_spaces_without_the_indicator_are_padded_only():
    venv = ParallelVecEnv([Scripted], agent_indicator=False)
    np.testing.assert_array_equal(venv.reset(), rows(1, 11, 0)[:, :3])


def test_dict_observations_are_padded_entry_by_entry_and_the_role_joins_the_own_vector():
    other, kind = spaces.Box(-9, 9, (2, 4), np.float32), spaces.MultiBinary(2)
    agents = {
        "a": spaces.Dict({"observation": BOX2, "agents": other, "kind": kind}),
        "b": spaces.Dict({"observation": BOX3, "agents": other, "kind": kind}),
    }
    venv = ParallelVecEnv([with_spaces(agents, {"a": FIVE, "b": FIVE})])
    seen, samples = venv.reset(), venv.envs[0].samples
    assert {key: array.shape for key, array in seen.items()} == {
        "observation": (2, 5),
        "agents": (2, 2, 4),
        "kind": (2, 2),
    }
    np.testing.assert_array_equal(seen["observation"][0], [*samples["a"]["observation"], 0, 1, 0])
    np.testing.assert_array_equal(seen["observation"][1], [*samples["b"]["observation"], 0, 1])
    for key in ("agents", "kind"):
        np.testing.assert_array_equal(seen[key], [samples[agent][key] for agent in agents])
    infos = venv.step(np.zeros(2, int))[3]
    assert venv.observation_space.contains(infos[0]["terminal_observation"])
    np.testing.assert_equal(infos[1]["terminal_observation"], {key: array[1] for key, array in seen.items()})


@settings(max_examples=30, deadline=None)
@given(shapes=st.lists(st.lists(st.integers(1, 4), min_size=2, max_size=2), min_size=1, max_size=4))
def test_padding_adds_zeros_at_the_end_of_each_axis_and_nothing_else(shapes: list[list[int]]):
    own = {f"x_{i}": spaces.Box(-1, 1, tuple(shape), np.float64) for i, shape in enumerate(shapes)}
    venv = ParallelVecEnv([with_spaces(own, dict.fromkeys(own, FIVE))])
    assert venv.observation_space.shape == tuple(np.max(shapes, axis=0))
    for seen, (i, j), sample in zip(venv.reset(), shapes, venv.envs[0].samples.values(), strict=True):
        np.testing.assert_array_equal(seen[:i, :j], sample)
        assert np.count_nonzero(seen) == np.count_nonzero(sample)


def test_a_discrete_observation_is_stacked_too():
    factory = with_spaces({"a": THREE, "b": THREE}, {"a": FIVE, "b": FIVE})

    class Alone(factory):
        def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
            super().reset()
            self.agents = ["a"]
            return self.samples, {"a": {}}

    venv = ParallelVecEnv([Alone])
    assert venv.observation_space == THREE
    # There is no zero to see while waiting here: the space's first value stands for it.
    for _ in range(5):
        np.testing.assert_array_equal(venv.reset(), [venv.envs[0].samples["a"], -1])
        venv.envs[0].samples["a"] = THREE.sample()


def test_an_action_beyond_an_agents_own_counts_as_its_last():
    venv = ParallelVecEnv([with_spaces({"a": BOX2, "b": BOX2}, {"a": FIVE, "b": THREE})])
    assert venv.action_space == spaces.Discrete(5)
    venv.reset()
    for action in range(5):
        venv.step(np.array([action, action]))
    assert [acted["a"] for acted in venv.envs[0].acted] == [0, 1, 2, 3, 4]
    assert [acted["b"] for acted in venv.envs[0].acted] == [-1, 0, 1, 1, 1]


def test_box_actions_are_cut_and_clipped_to_the_agents_own_bounds():
    venv = ParallelVecEnv([with_spaces({"a": BOX2, "b": BOX2}, {"a": BOX2, "b": BOX3})])
    assert venv.action_space == spaces.Box(np.array([-1, -1, 0.5], np.float32), np.array([2, 2, 2], np.float32))
    venv.reset()
    venv.step(np.array([[2, -0.5, 2], [-1, 1.5, 1]], np.float32))
    np.testing.assert_array_equal(venv.envs[0].acted[0]["a"], np.array([1, -0.5], np.float32))
    np.testing.assert_array_equal(venv.envs[0].acted[0]["b"], np.array([0.5, 1.5, 1], np.float32))


def test_equal_actions_of_other_kinds_pass_unchanged():
    own = spaces.MultiDiscrete([2, 3])
    venv = ParallelVecEnv([with_spaces({"a": BOX2, "b": BOX2}, {"a": own, "b": own})])
    assert venv.action_space == own
    venv.reset()
    venv.step(np.array([[1, 2], [0, 1]]))
    np.testing.assert_array_equal(venv.envs[0].acted[0]["a"], [1, 2])


@pytest.mark.parametrize(
    ("observations", "actions", "indicator", "message"),
    [
        ((BOX2, BOX2), (FIVE, BOX2), None, "all Discrete, all 1-D Boxes, or equal"),
        ((BOX2, BOX2), (spaces.Box(0, 1, (2, 2)), BOX2), None, "all Discrete, all 1-D Boxes, or equal"),
        ((BOX2, BOX2), (spaces.MultiBinary(2), spaces.MultiBinary(3)), None, "all Discrete, all 1-D Boxes, or equal"),
        ((BOX2, spaces.Box(0, 1, (2, 2))), (FIVE, FIVE), None, "Boxes of as many axes"),
        ((BOX2, FIVE), (FIVE, FIVE), None, "Boxes of as many axes"),
        ((FIVE, THREE), (FIVE, FIVE), None, "Boxes of as many axes"),
        ((spaces.Tuple([BOX2]),) * 2, (FIVE, FIVE), None, "Boxes of as many axes"),
        ((spaces.Dict(a=BOX2), spaces.Dict(b=BOX2)), (FIVE, FIVE), None, "same entries for all agents.*'b'"),
        ((spaces.Dict(a=BOX2), BOX2), (FIVE, FIVE), None, "same entries for all agents.*'b'"),
        ((spaces.Dict(observation=spaces.Dict(a=BOX2)),) * 2, (FIVE, FIVE), None, "flat Dict"),
        ((spaces.Box(0, 1, (2, 2)),) * 2, (FIVE, FIVE), True, "agent_indicator needs a 1-D Box"),
        ((spaces.Dict(a=BOX2),) * 2, (FIVE, FIVE), True, "agent_indicator needs a 1-D Box"),
    ],
)
def test_spaces_that_one_policy_cannot_have(observations, actions, indicator, message):
    factory = with_spaces(dict(zip("ab", observations, strict=True)), dict(zip("ab", actions, strict=True)))
    with pytest.raises(UserError, match=message):
        ParallelVecEnv([factory], agent_indicator=indicator)


def test_an_observation_of_another_shape_than_its_space_is_named():
    factory = with_spaces({"a": BOX2, "b": BOX3}, {"a": FIVE, "b": FIVE}, lambda agent, seen: seen[:1])
    with pytest.raises(UserError, match=r"the observation of agent 'a' must have shape \(2,\), got \(1,\)"):
        ParallelVecEnv([factory]).reset()


# --- learners and partners


def test_a_partner_drives_those_who_do_not_learn():
    calls = []

    def partner(env: ParallelEnv, observations: dict, generator: np.random.Generator) -> dict:
        calls.append({agent: float(seen[0]) for agent, seen in observations.items()})
        return {"ant_0": 7, "bee_0": 8, "ant_1": "ignored"}

    venv = ParallelVecEnv([Scripted], agents=["ant_1"], partner=partner)
    assert (venv.num_envs, venv.observation_space.shape, venv.action_space) == (1, (2,), spaces.Discrete(2))
    np.testing.assert_array_equal(venv.reset(), [[11, 11]])
    steps = play(venv, 3)
    # The copy resets when its only learner is dead, though the others would go on.
    assert [step[0].tolist() for step in steps] == [[[12, 12]], [[41, 41]], [[42, 42]]]
    assert [bool(step[2][0]) for step in steps] == [False, True, False]
    np.testing.assert_array_equal(steps[1][3][0]["terminal_observation"], [13, 13])
    assert calls == [{"ant_0": 1}, {"ant_0": 2}, {"ant_0": 31, "bee_0": 51}]
    assert venv.envs[0].acted[2] == {"ant_1": 0, "ant_0": 7, "bee_0": 8}


def test_a_copy_goes_on_for_a_learner_who_has_yet_to_join():
    gap = (
        {"ant_0": (1, 0, ""), "ant_1": (11, 0, "")},
        {"ant_0": (2, 0, ""), "ant_1": (12, 0, "terminated")},
        {"ant_0": (3, 0, "")},
        {"ant_0": (4, 0, ""), "bee_0": (24, 0, "")},
        {"ant_0": (5, 0, ""), "bee_0": (25, 0, "terminated")},
        {"ant_0": (6, 0, "terminated")},
    )
    venv = ParallelVecEnv([lambda: Scripted(gap)], agents=["ant_1", "bee_0"], partner="random")
    venv.reset()
    steps = play(venv, 8)
    # The second episode waits for bee_0 as the first did; neither waits for ant_0, who does not learn.
    dones = [[True, False], [False, False], [False, True], [True, True]]
    assert [step[2].tolist() for step in steps] == 2 * dones
    alive = [[True, False], [False, False], [False, False], [False, True]]
    assert [[info["alive"] for info in step[3]] for step in steps] == 2 * alive


def test_random_partners_repeat_with_the_seed_and_differ_between_copies():
    def acted(seed: int) -> list[list[int]]:
        venv = ParallelVecEnv([Scripted, Scripted], agents=["ant_0"], partner="random")
        venv.seed(seed)
        venv.reset()
        play(venv, 12)
        return [
            [action for step in env.acted for agent, action in step.items() if agent != "ant_0"] for env in venv.envs
        ]

    first, second = acted(5), acted(5)
    assert first == second
    assert first[0] != first[1]
    assert acted(6)[0] == first[1]
    assert set(first[0]) <= {0, 1, 2}


def test_random_actions_reach_both_bounds_of_whole_numbers():
    own = {"a": spaces.Box(0, 1, (2,), np.int8)}
    env = with_spaces(dict.fromkeys(own, BOX2), own)()
    generator = np.random.default_rng(0)
    drawn = np.stack([random_actions(env, {"a": 0}, generator)["a"] for _ in range(200)])
    assert drawn.dtype == np.int8 and 0.4 < drawn.mean() < 0.6 and set(drawn.flat) == {0, 1}


def test_random_actions_may_have_no_axes():
    own = {"a": spaces.Box(-1, 1, (), np.float32)}
    drawn = random_actions(with_spaces(dict.fromkeys(own, BOX2), own)(), {"a": 0}, np.random.default_rng(0))["a"]
    assert own["a"].contains(drawn)


def test_random_actions_cover_each_agents_own_space():
    own = {"a": THREE, "b": BOX3, "c": spaces.MultiBinary(2), "d": spaces.Box(-np.inf, np.inf, (1,))}
    env = with_spaces(dict.fromkeys(own, BOX2), own)()
    generator = np.random.default_rng(0)
    drawn = [random_actions(env, {"a": 0, "b": 0, "c": 0}, generator) for _ in range(100)]
    assert {actions["a"] for actions in drawn} == {-1, 0, 1}
    assert all(own[name].contains(actions[name]) for actions in drawn for name in ("b", "c"))
    with pytest.raises(
        UserError, match="random partners need a Discrete.*bounded Box action space.*pass a callable as"
    ):
        random_actions(env, {"d": 0}, generator)


def test_a_partner_without_an_action_for_an_agent_is_named():
    venv = ParallelVecEnv([Scripted], agents=["bee_0"], partner=lambda env, observations, generator: {"ant_0": 0})
    venv.reset()
    with pytest.raises(UserError, match=r"gave no action for \['ant_1'\]"):
        play(venv, 1)


# --- bad input


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"agents": ["ant_0", "wasp"], "partner": "random"}, r"some of \['ant_0'.*got \['ant_0', 'wasp'\]"),
        ({"agents": ["ant_0", "ant_0"], "partner": "random"}, "each once"),
        ({"agents": [], "partner": "random"}, r"each once; got \[\]"),
        ({"agents": ["ant_0", "ant_1"]}, r"\['bee_0'\] do not learn.*pass partner="),
        ({"partner": "random"}, "all agents learn"),
        ({"agents": ["ant_0"], "partner": "queen"}, "no partner is called 'queen'; known: random"),
    ],
)
def test_learners_and_partners_must_fit(kwargs, message):
    with pytest.raises(UserError, match=message):
        ParallelVecEnv([Scripted], **kwargs)


def test_copies_must_be_there_distinct_and_alike():
    shared = Scripted()
    for factories, message in [
        ([], "at least one factory"),
        ([lambda: shared, lambda: shared], "one was returned twice"),
        ([Scripted, lambda: Scripted(sizes={"ant_0": 2})], "copy 0 has .*'bee_0'.*, copy 1 has"),
        ([Scripted, lambda: Scripted(sizes={**SIZES, "bee_0": 4})], "same observation_spaces; 'bee_0'"),
        ([Scripted, lambda: Scripted(sizes={})], "copy 1 has no possible_agents"),
        ([simple_tag_v3.env], "factory 0 must make a PettingZoo ParallelEnv.*aec_to_parallel"),
    ]:
        with pytest.raises(UserError, match=message):
            ParallelVecEnv(factories)


def test_unknown_agents_and_agents_without_an_observation_are_named():
    venv = ParallelVecEnv([Scripted])
    venv.envs[0].possible_agents.remove("bee_0")
    venv.reset()
    with pytest.raises(UserError, match=r"one of possible_agents, but \['bee_0'\] are not"):
        play(venv, 2)

    class Blind(Scripted):
        def _seen(self) -> dict[str, np.ndarray]:
            return {"ant_1": super()._seen()["ant_1"]}

    with pytest.raises(UserError, match=r"gave none for \['ant_0'\]"):
        ParallelVecEnv([Blind]).reset()
    with pytest.raises(UserError, match="reset\\(\\) left env.agents empty"):
        ParallelVecEnv([lambda: Scripted(({},))]).reset()


def test_steps_out_of_order_are_refused():
    venv = ParallelVecEnv([Scripted])
    with pytest.raises(ProtocolError, match="call reset"):
        venv.step(np.zeros(3, int))
    venv.reset()
    with pytest.raises(ProtocolError, match="call step_async"):
        venv.step_wait()
    with pytest.raises(UserError, match=r"one action per env \(3\), got 2"):
        venv.step(np.zeros(2, int))
    venv.step_async(np.zeros(3, int))
    venv.reset()
    with pytest.raises(ProtocolError, match="call step_async"):
        venv.step_wait()


# --- the VecEnv interface


def test_seeds_and_options_reach_the_next_reset_only():
    venv = ParallelVecEnv([lambda: Scripted(SECOND)] * 2)
    assert venv.seed(10) == [10, 10, 10, 11, 11, 11]
    venv.set_options([{"map": i} for i in range(6)])
    venv.reset()
    play(venv, 2)
    venv.reset()
    assert [env.resets for env in venv.envs] == [
        [(10, {"map": 0}), (None, None), (None, None)],
        [(11, {"map": 3}), (None, None), (None, None)],
    ]
    unseeded = venv.seed(None)
    assert unseeded[3] == unseeded[0] + 1


def test_reset_infos_follow_every_reset():
    venv = ParallelVecEnv([Scripted])
    venv.reset()
    assert venv.reset_infos == [{"reset": 1, "alive": True}, {"reset": 1, "alive": True}, {"alive": False}]
    play(venv, 4)
    assert venv.reset_infos == [{"reset": 2, "alive": True}] * 3


def test_attributes_and_methods_go_to_the_copy_of_an_env():
    venv = ParallelVecEnv([Scripted, Scripted])
    venv.set_attr("calls", 5, indices=[4])
    assert venv.get_attr("calls") == [0, 0, 0, 5, 5, 5]
    assert venv.get_attr("calls", indices=3) == [5]
    # A method runs once per copy, though every row gets the result.
    assert venv.env_method("count", 2) == [2, 2, 2, 7, 7, 7]
    assert venv.env_method("count", indices=[0, 1], by=1) == [3, 3]
    assert not venv.has_attr("nothing")
    assert venv.metadata["render_fps"] == 7


def test_wrappers_are_found_at_any_depth():
    class Mine(BaseParallelWrapper):
        pass

    venv = ParallelVecEnv([lambda: BaseParallelWrapper(Mine(Scripted())), Scripted])
    assert venv.env_is_wrapped(Mine) == [True] * 3 + [False] * 3
    assert venv.env_is_wrapped(Monitor, indices=[0, 5]) == [False, False]


def test_one_frame_per_copy():
    venv = ParallelVecEnv([Scripted, Scripted])
    venv.reset()
    assert len(venv.get_images()) == 2
    assert venv.render().shape == (8, 6, 3)
    venv.close()
    assert [env.agents for env in venv.envs] == [["closed"]] * 2


def test_a_copy_without_a_render_mode_makes_no_fuss():
    assert ParallelVecEnv([with_spaces({"a": BOX2}, {"a": FIVE})]).render_mode is None


# --- with SB3


class Named(ParallelEnv):
    """An observation names an action; the right one pays 1. A mule must do the opposite of what a horse must."""

    metadata = {"name": "named"}
    render_mode = None
    steps = 5

    def __init__(self) -> None:
        self.possible_agents = ["horse_0", "horse_1", "mule_0"]
        self._spaces = {
            a: spaces.Box(0, 1, (n,), np.float32) for a, n in zip(self.possible_agents, (3, 3, 2), strict=True)
        }
        self._actions = {agent: spaces.Discrete(space.shape[0]) for agent, space in self._spaces.items()}
        self._rng = np.random.default_rng(0)

    def observation_space(self, agent: str) -> spaces.Space:
        return self._spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self._actions[agent]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.agents, self.time = list(self.possible_agents), 0
        return self._name(), {agent: {} for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        names = self.agents
        right = {a: self.named[a] if a.startswith("horse") else 1 - self.named[a] for a in names}
        rewards = {agent: float(actions[agent] == right[agent]) for agent in names}
        self.time += 1
        # horse_1 is gone after the second step: its row waits for three
        dead = {agent: agent == "horse_1" and self.time == 2 for agent in names}
        over = {agent: self.time == self.steps for agent in names}
        seen = self._name()
        self.agents = [agent for agent in names if not dead[agent] and not over[agent]]
        return seen, rewards, dead, over, {agent: {} for agent in names}

    def _name(self) -> dict[str, np.ndarray]:
        self.named = {agent: int(self._rng.integers(self._spaces[agent].shape[0])) for agent in self.agents}
        return {a: np.eye(self._spaces[a].shape[0], dtype=np.float32)[self.named[a]] for a in self.agents}


@pytest.mark.slow
def test_ppo_learns_what_each_role_must_do():
    venv = AgentMonitor(ParallelVecEnv([Named] * 4))
    kwargs = {"policy_kwargs": {"net_arch": [32]}, "device": "cpu", "seed": 0}
    model = PPO("MlpPolicy", venv, n_steps=64, batch_size=128, learning_rate=5e-3, gamma=0.0, ent_coef=0.0, **kwargs)
    model.learn(12_000)
    returns, lengths = evaluate_policy(model, venv, n_eval_episodes=24, return_episode_rewards=True)
    assert set(lengths) == {2, Named.steps}
    # The optimum is a reward of 1 per step.
    assert sum(returns) == sum(lengths)


def test_dqn_frame_stacks_and_normalisation_run_on_it():
    venv = VecNormalize(VecFrameStack(ParallelVecEnv([Scripted, Scripted]), 2))
    model = DQN("MlpPolicy", venv, learning_starts=6, train_freq=1, batch_size=4, buffer_size=100, device="cpu")
    model.learn(60)
    assert model.num_timesteps >= 60


@pytest.mark.parametrize(
    ("module", "kwargs", "shape"),
    [
        (simple_tag_v3, {"max_cycles": 3}, (8, 18)),
        (simple_spread_v3, {"max_cycles": 3}, (6, 18)),
        (pursuit_v5, {"max_cycles": 3, "n_pursuers": 3, "n_evaders": 2}, (6, 7, 7, 3)),
    ],
)
def test_ppo_runs_on_pettingzoos_own(module, kwargs, shape):
    venv = AgentMonitor(ParallelVecEnv([lambda: module.parallel_env(**kwargs)] * 2))
    model = PPO("MlpPolicy", venv, n_steps=8, batch_size=16, n_epochs=1, device="cpu", seed=0)
    assert venv.reset().shape == shape
    model.learn(8 * shape[0])
    # All episodes are cut by time after three steps.
    assert {episode["l"] for episode in model.ep_info_buffer} == {3}
    dones, infos = [], []
    venv.reset()
    for _ in range(3):
        actions = np.array([venv.action_space.sample() for _ in range(venv.num_envs)])
        observations, _, done, infos = venv.step(actions)
        dones.append(done.tolist())
    assert dones == [[False] * shape[0]] * 2 + [[True] * shape[0]]
    assert all(info["TimeLimit.truncated"] and info["alive"] for info in infos)
    assert all(venv.observation_space.contains(info["terminal_observation"]) for info in infos)
    venv.close()


def test_the_same_seed_repeats_several_episodes_of_a_real_env():
    def observed() -> np.ndarray:
        venv = ParallelVecEnv([lambda: simple_tag_v3.parallel_env(max_cycles=3)] * 2)
        venv.seed(4)
        return np.array([venv.reset(), *(step[0] for step in play(venv, 8))])

    first = observed()
    np.testing.assert_array_equal(first, observed())
    # Another episode, another start; another copy, another seed.
    assert not np.array_equal(first[0], first[3])
    assert not np.array_equal(first[0][:4], first[0][4:])


def test_multi_input_policy_runs_on_dict_observations():
    agents = {
        "a": spaces.Dict({"observation": BOX2, "near": BOX3}),
        "b": spaces.Dict({"observation": BOX3, "near": BOX3}),
    }
    venv = ParallelVecEnv([with_spaces(agents, {"a": FIVE, "b": FIVE})])
    PPO("MultiInputPolicy", venv, n_steps=8, batch_size=8, n_epochs=1, device="cpu").learn(32)
