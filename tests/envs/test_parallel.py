from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import jaxtyping
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.test import parallel_api_test, parallel_seed_test
from pettingzoo.utils import BaseParallelWrapper

from envs.entries import FORECAST_KEYS, PATH_KEYS
from envs.parallel import ForecastParallelEnv
from envs.readers import multiagent_reader_for
from envs.readers.base import MultiagentScene, pad_multiagent_scene
from envs.registry import ENVS, MULTIAGENT_IDS, EnvEntry, make_multiagent_env
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.dgvae import DGVAE
from predictor.forecaster import Forecaster
from predictor.online import OnlineForecaster
from predictor.scene import Scene, SceneBatch, SceneSpec
from predictor.support.errors import ProtocolError, UserError
from tests.envs.helpers import HORIZON, SIZES, assert_same, largest_difference, save_tiny, tiny_model
from tests.envs.test_multiagent_observation import view_by_loops

WORLD = SceneSpec(dt_s=1.0, has_ego=False, perception_m=25.0, max_agents=8)
CENTROID = replace(WORLD, frame=("centroid", "centroid"))
AROUND_EGO = replace(WORLD, has_ego=True)
STEPS = 6


@dataclass(frozen=True)
class Life:
    """Steps at which a body is there, both ends included."""

    first: int = 0
    last: int = STEPS
    learns: bool = True


LIVES = {
    "stays": Life(),
    "dies": Life(last=3),
    "joins": Life(first=2),
    "takes over": Life(first=4),  # enters at the step after "dies" was seen last
    "visits": Life(first=2, last=4),
    "traffic": Life(learns=False),
    "short traffic": Life(first=1, last=3, learns=False),
}


class Toy(ParallelEnv):
    """Bodies on random walks, learners among them, that come and go by a script.

    Args:
        lives: who is there when.
        vanish: whether a body is off the map at the very step at which its agent dies.
    """

    def __init__(self, lives: Mapping[str, Life] = LIVES, vanish: bool = False) -> None:
        self.metadata = {"name": "toy_v0", "render_modes": []}
        self.render_mode = None
        self.lives, self.vanish = dict(lives), vanish
        self.possible_agents = [name for name, life in self.lives.items() if life.learns]
        self._rng = np.random.default_rng(0)
        self._spaces = {
            name: gym.spaces.Box(-np.inf, np.inf, (1 + i, 2)[: 1 + i % 2], np.float32)
            for i, name in enumerate(self.possible_agents)
        }
        self._actions = {name: gym.spaces.Discrete(2 + i) for i, name in enumerate(self.possible_agents)}

    def observation_space(self, agent: str) -> gym.Space:
        return self._spaces[agent]

    def action_space(self, agent: str) -> gym.Space:
        return self._actions[agent]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.t = 0
        count = len(self.lives)
        steps = self._rng.normal(size=(STEPS + 1, count, 4)) * np.array([2, 2, 1, 1])
        steps[0, :, :2] *= 5
        self.tracks = np.cumsum(steps, axis=0)
        self.headings = self._rng.uniform(-np.pi, np.pi, (STEPS + 1, count))
        self.agents = [name for name in self.possible_agents if self.lives[name].first == 0]
        self.observed = list(self.agents)
        return self._observations(), {name: {} for name in self.observed}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        assert set(actions) == set(self.agents)
        self.t += 1
        joining = [name for name in self.possible_agents if self.lives[name].first == self.t]
        self.observed = self.agents + joining
        died = {name: self.lives[name].last == self.t < STEPS for name in self.observed}
        over = dict.fromkeys(self.observed, self.t == STEPS)
        self.agents = [name for name in self.observed if not (died[name] or over[name])]
        rewards = dict.fromkeys(self.observed, float(self.t))
        return self._observations(), rewards, died, over, {name: {} for name in self.observed}

    def _observations(self) -> dict[str, np.ndarray]:
        return {
            name: np.full(self._spaces[name].shape, self.t + 10 * i, np.float32)
            for i, name in enumerate(self.possible_agents)
            if name in self.observed
        }

    def bodies(self) -> list[int]:
        """Who is on the map now, as places in `lives`."""
        there = []
        for i, life in enumerate(self.lives.values()):
            last = life.last - int(self.vanish and life.learns and life.last < STEPS)
            if life.first <= self.t <= last:
                there.append(i)
        return there


class ToyReader:
    """All agents, in other places at each step unless told not to."""

    def __init__(self, env: Any, spec: SceneSpec = WORLD, shuffle: bool = True) -> None:
        self.spec, self._shuffle = spec, shuffle
        self._rng = np.random.default_rng(7)

    def reset(self) -> None:
        """Identities are the script's."""

    def read(self, env: Any) -> MultiagentScene:
        toy = env.unwrapped
        order = np.array(toy.bodies(), dtype=np.int64)
        if self._shuffle:
            order = self._rng.permutation(order)
        names = list(toy.lives)
        index_of = {names[i]: index for index, i in enumerate(order) if names[i] in toy.observed}
        full = Scene(toy.tracks[toy.t][order], 100 + order, np.ones(len(order), dtype=np.bool_))
        return pad_multiagent_scene(full, index_of, toy.headings[toy.t][order], self.spec, "ToyReader")


class Reference:
    """The same forecasts by the plainest means: an environment for every body of the script, a loop for every agent."""

    def __init__(self, forecaster: Forecaster, toy: Toy, perception_m: float, max_agents: int) -> None:
        self._front = int(forecaster.spec.has_ego)
        self._online = OnlineForecaster(forecaster, 1, len(toy.lives) + self._front)
        self._view = replace(WORLD, perception_m=perception_m, max_agents=max_agents)

    def reset(self) -> None:
        self._online.reset()

    def observe(self, toy: Toy) -> dict[str, dict[str, np.ndarray]]:
        count = len(toy.lives)
        states, ids, valid = np.zeros((count, 4)), np.full(count, -1), np.zeros(count, dtype=np.bool_)
        for i in toy.bodies():
            states[i], ids[i], valid[i] = toy.tracks[toy.t, i], i, True
        scene = Scene(states, ids, valid)
        self._online.observe(SceneBatch.stack([scene.behind_absent(self._front)]))
        forecast = self._online.forecast()
        front = self._front
        forecast = replace(
            forecast,
            xy=forecast.xy[:, :, front:],
            edge_probs=forecast.edge_probs[:, front:, front:],
            edge_features=forecast.edge_features[:, front:, front:],
            valid=forecast.valid[:, front:],
        )
        multi = MultiagentScene(scene, {}, toy.headings[toy.t])
        return {
            name: view_by_loops(multi, forecast, i, self._view)
            for i, name in enumerate(toy.lives)
            if name in toy.observed and valid[i]
        }


def wrap(toy: ParallelEnv, spec: SceneSpec = WORLD, shuffle: bool = True, **kwargs: Any) -> ForecastParallelEnv:
    kwargs.setdefault("forecaster", tiny_model(spec))
    return ForecastParallelEnv(toy, reader=lambda env: ToyReader(env, shuffle=shuffle), **kwargs)


def act(env: ParallelEnv, rng: np.random.Generator | None = None) -> dict[str, Any]:
    rng = rng or np.random.default_rng(0)
    actions: dict[str, Any] = {}
    for name in env.agents:
        space = env.action_space(name)
        if isinstance(space, gym.spaces.Discrete):
            actions[name] = int(rng.integers(space.n))
        else:
            assert isinstance(space, gym.spaces.Box)
            actions[name] = rng.uniform(space.low, space.high).astype(space.dtype)
    return actions


def play(env: ParallelEnv, seed: int | None = 0) -> list[dict[str, Any]]:
    """The observations of an episode; each must be in its space."""
    observations, _ = env.reset(seed=seed)
    episode, rng = [observations], np.random.default_rng(1)
    while env.agents:
        observations, *_ = env.step(act(env, rng))
        episode.append(observations)
    for step in episode:
        for name, observation in step.items():
            assert env.observation_space(name).contains(observation), name
    return episode


def entries_of(observation: Mapping[str, Any]) -> dict[str, Any]:
    return {key: observation[key] for key in (*FORECAST_KEYS, *PATH_KEYS)}


# --- What every agent sees --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spec", [WORLD, CENTROID, AROUND_EGO], ids=["world", "centroid", "absent-ego"])
@pytest.mark.parametrize(("perception_m", "max_agents"), [(25.0, None), (9.0, 4)], ids=["all", "few"])
def test_equals_a_plain_loop_while_agents_come_and_go(spec: SceneSpec, perception_m: float, max_agents: int | None):
    toy = Toy()
    env = wrap(toy, spec, perception_m=perception_m, max_agents=max_agents)
    reference = Reference(tiny_model(spec), toy, perception_m, max_agents or WORLD.max_agents)
    counts = []
    for episode in range(2):
        observations, _ = env.reset(seed=episode)
        reference.reset()
        while True:
            expected = reference.observe(toy)
            assert set(observations) == set(expected) == set(toy.observed)
            for name, entries in expected.items():
                assert_same(entries_of(observations[name]), entries, 1e-4)
            counts.append({name: int(observations[name]["valid"].sum()) for name in observations})
            if not env.agents:
                break
            observations, *_ = env.step(act(env))
    assert [set(step) for step in counts[:5]] == [
        {"stays", "dies"},
        {"stays", "dies"},
        {"stays", "dies", "joins", "visits"},
        {"stays", "dies", "joins", "visits"},
        {"stays", "joins", "visits", "takes over"},
    ]
    assert len({count for step in counts for count in step.values()}) > 2  # perception had a say


def test_own_observation_rewards_and_ends_are_untouched():
    plain, env = Toy(), wrap(Toy())
    observations, infos = env.reset(seed=3)
    expected, expected_infos = plain.reset(seed=3)
    assert infos == expected_infos
    while True:
        assert env.agents == plain.agents
        assert list(observations) == list(expected)
        for name in expected:
            np.testing.assert_array_equal(observations[name]["observation"], expected[name])
        if not plain.agents:
            break
        observations, *rest = env.step(act(env))
        expected, *expected_rest = plain.step(act(plain))
        assert rest == expected_rest
    assert env.possible_agents == plain.possible_agents
    assert env.metadata == plain.metadata
    assert env.unwrapped is env.env


def test_spaces_are_the_same_objects_and_differ_between_agents():
    toy = Toy()
    env = wrap(toy)
    spaces = {name: env.observation_space(name) for name in env.possible_agents}
    for name, space in spaces.items():
        assert env.observation_space(name) is space
        assert space["observation"] is toy.observation_space(name)
        assert env.action_space(name) is toy.action_space(name)
    first, second = spaces["stays"], spaces["dies"]
    assert first["observation"].shape == (1,)
    assert second["observation"].shape == (2, 2)
    assert first["forecast"] is not second["forecast"]
    assert first["forecast"] == second["forecast"]


def test_an_agent_without_a_place_in_possible_agents_has_a_space():
    toy = Toy()
    toy.possible_agents = [name for name in toy.possible_agents if name != "joins"]
    env = wrap(toy)
    assert env.observation_space("joins")["observation"] is toy.observation_space("joins")


@pytest.mark.parametrize("samples", [1, 3])
def test_episode_stays_in_its_spaces(samples: int):
    env = wrap(Toy(), num_samples=samples, horizon_steps=4)
    axis = () if samples == 1 else (samples,)
    for observations in play(env):
        for observation in observations.values():
            assert observation["forecast"].shape == (7, *axis, 4, 2)
            assert all(np.isfinite(value).all() for value in observation.values())


# --- History ----------------------------------------------------------------------------------------------------------


def test_reset_forgets_and_nothing_else_does():
    """The last observation of an episode knows its past; the first of the next knows nothing, whatever came before."""
    env, fresh = wrap(Toy(), shuffle=False), wrap(Toy(), shuffle=False)
    first = play(env, seed=0)
    second = play(env, seed=1)
    expected = play(fresh, seed=1)
    for seen, wanted in zip(second, expected, strict=True):
        for name in wanted:
            assert_same(seen[name], wanted[name])
    amnesiac = wrap(Toy(), shuffle=False)
    amnesiac.reset(seed=0)
    while amnesiac.agents:
        amnesiac.stream.reset()
        last, *_ = amnesiac.step(act(amnesiac))
    assert set(last) == set(first[-1]) == {"stays", "joins", "takes over"}
    for name in last:
        assert largest_difference(first[-1][name], last[name]) > 1e-3


def test_identities_are_forgotten_before_a_new_episode_is_read():
    calls = []

    class Noted(ToyReader):
        def reset(self) -> None:
            calls.append("reset")

        def read(self, env: Any) -> MultiagentScene:
            calls.append("read")
            return super().read(env)

    env = ForecastParallelEnv(Toy(), "constant-velocity", reader=Noted)
    env.reset(seed=0)
    env.step(act(env))
    env.reset()
    assert calls == ["reset", "read", "read", "reset", "read"]


@pytest.mark.parametrize("learns", [True, False], ids=["learners", "traffic"])
def test_an_agent_in_a_leavers_place_gets_none_of_its_memory(learns: bool):
    """The newcomer of step 4 stands in the place of the leaver of step 3 and has the edges of a first sight."""
    lives = {"stays": Life(), "leaves": Life(last=3, learns=learns), "comes": Life(first=4, learns=learns)}
    env = wrap(Toy(lives), shuffle=False, perception_m=np.inf)
    fresh = wrap(Toy(lives), shuffle=False, perception_m=np.inf)
    env.reset(seed=0)
    fresh.reset(seed=0)
    places = []
    for _ in range(4):
        observations, *_ = env.step(act(env))
        places.append({int(i): index for index, i in enumerate(env.scene.scene.ids) if i >= 0})
        fresh.stream.reset()
        first_sight, *_ = fresh.step(act(fresh))
    assert places[2][101] == places[3][102] == 1
    assert observations["stays"]["valid"].sum() == 1
    np.testing.assert_allclose(
        observations["stays"]["edge_features"], first_sight["stays"]["edge_features"], rtol=1e-5, atol=1e-5
    )


def test_memory_survives_a_change_of_places():
    shuffled, fixed = wrap(Toy(), shuffle=True), wrap(Toy(), shuffle=False)
    for seen, wanted in zip(play(shuffled), play(fixed), strict=True):
        for name in wanted:
            assert_same(seen[name], wanted[name], 1e-4)


def test_the_order_of_agents_is_only_an_order():
    backwards = dict(reversed(LIVES.items()))

    class Mirrored(Toy):
        """The same walks for the same names, listed the other way round."""

        def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
            super().reset(seed, options)
            self.tracks, self.headings = self.tracks[:, ::-1], self.headings[:, ::-1]
            return self._observations(), {name: {} for name in self.observed}

    env, mirrored = wrap(Toy()), wrap(Mirrored(backwards))
    for seen, wanted in zip(play(mirrored), play(env), strict=True):
        assert list(seen) != list(wanted) or len(seen) == 1
        for name in wanted:
            assert_same(entries_of(seen[name]), entries_of(wanted[name]), 1e-4)


# --- Ends -------------------------------------------------------------------------------------------------------------


def test_a_dying_agent_sees_the_others_once_more():
    env = wrap(Toy(), perception_m=np.inf)
    episode = play(env)
    assert "dies" in episode[3]
    assert "dies" not in episode[4]
    assert episode[3]["dies"]["valid"].sum() == 5
    assert all(episode[-1][name]["valid"].sum() == 3 for name in ("stays", "joins", "takes over"))


def test_a_dying_agent_off_the_map_sees_nothing():
    env = wrap(Toy(vanish=True), num_samples=2, perception_m=np.inf)
    episode = play(env)
    gone = episode[3]["dies"]
    assert all((value == 0).all() for value in entries_of(gone).values())
    np.testing.assert_array_equal(gone["observation"], np.full((2, 2), 13.0))
    assert env.observation_space("dies").contains(gone)
    assert episode[3]["stays"]["valid"].sum() == 4


def test_no_learner_left_and_no_agent_there():
    """All learners die at step 2, then one joins; then all agents are off the map."""
    lives = {"a": Life(last=2), "b": Life(last=2), "late": Life(first=2, last=4)}
    env = wrap(Toy(lives, vanish=True))
    observations, _ = env.reset(seed=0)
    seen = [sorted(observations)]
    while env.agents:
        observations, *_ = env.step(act(env))
        seen.append(sorted(observations))
    assert seen == [["a", "b"], ["a", "b"], ["a", "b", "late"], ["late"], ["late"]]
    assert not env.scene.scene.valid.any()
    assert env.forecast.xy.shape == (1, 1, WORLD.max_agents, HORIZON, 2)


def test_scene_and_forecast_are_of_the_latest_step():
    env = wrap(Toy({"a": Life(), "b": Life()}), forecaster=ConstantVelocity(WORLD, 2), perception_m=np.inf)
    env.reset(seed=0)
    observations, *_ = env.step(act(env))
    scene, index = env.scene.scene, env.scene.index_of["a"]
    np.testing.assert_array_equal(scene.states[index], env.unwrapped.tracks[1, 0])
    expected = scene.states[index, :2] + 2 * scene.states[index, 2:4]
    np.testing.assert_allclose(env.forecast.xy[0, 0, index, 1], expected, rtol=1e-5)
    offset = env.forecast.xy[0, 0, env.scene.index_of["b"], 1].numpy() - scene.states[index, :2]
    assert np.linalg.norm(observations["a"]["forecast"][0, 1]) == pytest.approx(np.linalg.norm(offset), rel=1e-4)
    assert env.scene_spec is env.reader.spec


def test_there_is_nothing_to_look_at_before_the_first_reset():
    env = wrap(Toy())
    for name in ("scene", "forecast"):
        with pytest.raises(ProtocolError, match=f"there is no {name} yet; call reset\\(\\) first"):
            getattr(env, name)


def test_a_seed_repeats_the_samples():
    class Still(Toy):
        """The same walks whatever the seed: only the samples can differ."""

        def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
            return super().reset(0, options)

    env = wrap(Still(), num_samples=3, shuffle=False)
    first, again, other, unseeded = (play(env, seed) for seed in (5, 5, 6, None))
    for seen, wanted in zip(again, first, strict=True):
        assert data_equivalence(seen, wanted)
    for changed in (other, unseeded):
        samples, wanted = changed[0]["stays"]["forecast"], first[0]["stays"]["forecast"]
        np.testing.assert_array_equal(samples[:, 0], wanted[:, 0])
        assert (samples[0, 1] != wanted[0, 1]).any()


# --- Which forecaster -------------------------------------------------------------------------------------------------


def test_checkpoint_decides_how_far_agents_see(tmp_path: Path):
    path = save_tiny(tmp_path / "near", replace(WORLD, perception_m=9.0))
    near = ForecastParallelEnv(Toy(), path, reader=ToyReader)
    far = ForecastParallelEnv(Toy(), path, reader=ToyReader, perception_m=np.inf)
    seen = [observation["valid"].sum() for step in play(near) for observation in step.values()]
    full = [observation["valid"].sum() for step in play(far) for observation in step.values()]
    assert sum(seen) < sum(full)
    toy = Toy()
    expected = ForecastParallelEnv(toy, reader=ToyReader, forecaster=tiny_model(WORLD), perception_m=9.0)
    assert seen == [observation["valid"].sum() for step in play(expected) for observation in step.values()]


def test_constant_velocity_needs_no_checkpoint():
    env = ForecastParallelEnv(Toy(), "constant-velocity", reader=ToyReader)
    observation = play(env)[0]["stays"]
    assert observation["forecast"].shape == (7, 5, 2)
    assert (observation["edge_probs"] == 0).all()


def test_larger_max_agents_are_padding():
    wide = play(wrap(Toy(), max_agents=12, shuffle=False))
    exact = play(wrap(Toy(), shuffle=False))
    for seen, wanted in zip(wide, exact, strict=True):
        for name in wanted:
            assert seen[name]["valid"].shape == (11,)
            shown, expected = entries_of(seen[name]), entries_of(wanted[name])
            np.testing.assert_array_equal(shown.pop("ego_path"), expected.pop("ego_path"))
            assert_same({key: value[:7] for key, value in shown.items()}, expected)


def test_without_a_name_it_takes_the_checkpoint_of_the_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = save_tiny(tmp_path / "toy", WORLD)
    monkeypatch.setitem(ENVS, "toy_v0", EnvEntry(checkpoint=path))
    implied = play(ForecastParallelEnv(Toy(), reader=ToyReader))
    for seen, wanted in zip(implied, play(ForecastParallelEnv(Toy(), path, reader=ToyReader)), strict=True):
        assert data_equivalence(seen, wanted)


def test_without_a_checkpoint_the_message_says_what_to_pass():
    with pytest.raises(UserError, match="no checkpoint ships for .*'toy_v0'.*'constant-velocity'"):
        ForecastParallelEnv(Toy(), reader=ToyReader)


def test_without_a_reader_the_message_says_what_to_pass():
    with pytest.raises(UserError, match="no scene reader knows .*toy_v0.*pass reader="):
        ForecastParallelEnv(Toy(), "constant-velocity")


def test_checkpoint_and_forecaster_exclude_each_other():
    with pytest.raises(UserError, match="a checkpoint or a forecaster, not both"):
        wrap(Toy(), checkpoint="intersection")


@pytest.mark.parametrize("given", ["checkpoint", "forecaster"])
def test_time_steps_that_differ_are_both_named(given: str, tmp_path: Path):
    slow = replace(WORLD, dt_s=2.0)
    model = {"checkpoint": save_tiny(tmp_path / "slow", slow), "forecaster": tiny_model(slow)}[given]
    with pytest.raises(UserError, match=r"was trained at dt_s=2 but env 'toy_v0' steps at dt_s=1; "):
        ForecastParallelEnv(Toy(), reader=ToyReader, **{given: model})


def test_a_forecaster_around_one_ego_is_refused():
    with pytest.raises(UserError, match="relative to one ego, but these scenes have many learners"):
        wrap(Toy(), forecaster=tiny_model(replace(AROUND_EGO, frame=("ego", "world"))))


# --- What is refused --------------------------------------------------------------------------------------------------


class Masked(BaseParallelWrapper):
    """Adds an action mask to one agent's observation, as PettingZoo's games do."""

    def observation_space(self, agent: str) -> gym.Space:
        own = self.env.observation_space(agent)
        if agent != "dies":
            return own
        return gym.spaces.Dict({"observation": own, "action_mask": gym.spaces.MultiBinary(2)})


def test_an_action_mask_stays_beside_the_forecasts():
    env = wrap(Masked(Toy()))
    assert {"observation", "action_mask", "forecast"} <= set(env.observation_space("dies").spaces)
    assert "action_mask" not in env.observation_space("stays").spaces


def test_an_aec_env_is_told_how_to_convert(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the type check would complain first
    not_parallel: Any = AECEnv()
    with pytest.raises(UserError, match=r"needs a PettingZoo parallel env, got AECEnv; .*aec_to_parallel"):
        ForecastParallelEnv(not_parallel, "constant-velocity")


def test_a_reader_that_breaks_the_contract_is_named():
    class Careless(ToyReader):
        def read(self, env: Any) -> MultiagentScene:
            return replace(super().read(env), index_of={"stays": 7})

    env = ForecastParallelEnv(Toy(), "constant-velocity", reader=Careless)
    with pytest.raises(UserError, match="scene reader of env 'toy_v0': agent 'stays' has index 7"):
        env.reset(seed=0)


class Renaming(ToyReader):
    """Says where agents are from some step on, under names of its own."""

    rename: Callable[[Mapping[str, int]], Mapping[Any, int]] = staticmethod(lambda index_of: {})
    since = 0

    def read(self, env: Any) -> MultiagentScene:
        scene = super().read(env)
        return replace(scene, index_of=self.rename(scene.index_of)) if env.unwrapped.t >= self.since else scene


NAMES: dict[str, tuple[Any, str]] = {
    "none": (lambda index_of: {}, r"lacks \['stays', 'dies'\] .*; its names are \[\]"),
    "numbers": (lambda index_of: dict(enumerate(index_of.values())), r"lacks \['stays', 'dies'\].* are \[0, 1\]"),
    "one": (
        lambda index_of: {n: i for n, i in index_of.items() if n != "dies"},
        r"lacks \['dies'\] .* are \['stays'\]",
    ),
}


@pytest.mark.unchecked
@pytest.mark.parametrize("fault", NAMES)
def test_every_observed_agent_must_be_named_at_the_reset(fault: str):
    rename, message = NAMES[fault]
    reader = type("Renamed", (Renaming,), {"rename": staticmethod(rename)})
    env = ForecastParallelEnv(Toy(), "constant-velocity", reader=lambda env: reader(env, shuffle=False))
    with pytest.raises(
        UserError, match=f"scene reader of env 'toy_v0': index_of must have .*{message}; name agents as"
    ):
        env.reset(seed=0)


class OtherNames(BaseParallelWrapper):
    """Calls agents otherwise than the environment, which the reader reads."""

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        return tuple({f"my {agent}": value for agent, value in of.items()} for of in self.env.reset(seed, options))

    def observation_space(self, agent: str) -> gym.Space:
        return self.env.observation_space(agent.removeprefix("my "))


@pytest.mark.unchecked
def test_a_wrapper_that_renames_agents_needs_a_reader_that_knows_the_names():
    env = ForecastParallelEnv(OtherNames(Toy()), "constant-velocity", reader=ToyReader)
    with pytest.raises(UserError, match=r"index_of must have .*lacks \['my stays', 'my dies'\]"):
        env.reset(seed=0)


def test_one_that_is_no_longer_named_has_entries_of_zeros():
    """As one that an intervention has taken out."""

    def without_one(index_of: Mapping[str, int]) -> Mapping[str, int]:
        return {name: index for name, index in index_of.items() if name != "dies"}

    forgets = type("Forgets", (Renaming,), {"since": 2, "rename": staticmethod(without_one)})
    env = ForecastParallelEnv(Toy(), "constant-velocity", reader=forgets)
    env.reset(seed=0)
    for _ in range(2):
        shown, _, ended, *_ = env.step(dict.fromkeys(env.agents, 0))
    assert not ended["dies"]
    assert not shown["dies"]["valid"].any()
    assert shown["stays"]["valid"].any()


class BlackDeath(BaseParallelWrapper):
    """Shows zeros of agents that have gone, which stay in `agents`, as wrappers for fixed numbers of agents do."""

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        shown, infos = self.env.reset(seed=seed, options=options)
        self.agents = list(shown)
        return shown, infos

    def step(self, actions: Any) -> Any:
        shown, *others = self.env.step({agent: actions.get(agent, 0) for agent in self.env.agents})
        zeros = {agent: np.zeros(self.observation_space(agent).shape, np.float32) for agent in self.agents}
        return zeros | {agent: shown[agent] for agent in self.agents if agent in shown}, *others


class ShowsAll(BlackDeath):
    """Shows zeros of agents that have not come yet, too."""

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        shown, infos = super().reset(seed=seed, options=options)
        self.agents = list(self.possible_agents)
        zeros = {agent: np.zeros(self.observation_space(agent).shape, np.float32) for agent in self.agents}
        return zeros | shown, dict.fromkeys(self.agents, {}) | infos


def test_a_wrapper_that_shows_the_dead_from_the_reset_on_is_no_fault_of_the_reader():
    env = ForecastParallelEnv(ShowsAll(Toy()), "constant-velocity", reader=ToyReader)
    shown, _ = env.reset(seed=0)
    assert not shown["joins"]["valid"].any()
    assert shown["stays"]["valid"].any()


def test_a_wrapper_that_shows_the_dead_is_no_fault_of_the_reader():
    env = ForecastParallelEnv(BlackDeath(Toy()), "constant-velocity", reader=ToyReader)
    env.reset(seed=0)
    for _ in range(4):
        shown, *_ = env.step(dict.fromkeys(env.agents, 0))
    assert "dies" in shown
    assert not shown["dies"]["valid"].any()


# --- PettingZoo's contracts, on the toy and on everything that is registered ------------------------------------------

SHORT = 5


def short_env(env_id: str, **kwargs: Any) -> ParallelEnv:
    """A registered environment whose episodes end after a few steps."""
    length = {"duration": SHORT} if env_id.startswith("intersection") else {"max_cycles": SHORT}
    return make_multiagent_env(env_id, **length, **kwargs)


def save_tiny_for(env: ParallelEnv, path: Path) -> str:
    """As `save_tiny`, for any number of features."""
    spec = multiagent_reader_for(env).spec
    sizes = replace(SIZES, delta_scales=())
    save_checkpoint(path, DGVAE(spec, sizes, HORIZON), CheckpointInfo(spec, sizes, HORIZON))
    return str(path)


def check_episodes_repeat(make: Any, seeds: Sequence[int] = (4, 4)) -> None:
    """PettingZoo's own seed test stops after one step."""
    first, second = make(), make()
    episodes = [play(env, seed) for env, seed in zip((first, second), seeds, strict=True)]
    episodes.append(play(first, seeds[0]))
    for episode in episodes[1:]:
        for seen, wanted in zip(episode, episodes[0], strict=True):
            assert data_equivalence(seen, wanted)


def test_toy_keeps_pettingzoos_contracts():
    parallel_api_test(wrap(Toy(), shuffle=False), num_cycles=STEPS)
    parallel_seed_test(lambda: wrap(Toy(), shuffle=False, num_samples=3))
    check_episodes_repeat(lambda: wrap(Toy(), shuffle=False))


@pytest.mark.parametrize("env_id", MULTIAGENT_IDS)
def test_registered_envs_keep_pettingzoos_contracts(env_id: str):
    parallel_api_test(ForecastParallelEnv(short_env(env_id), "constant-velocity"), num_cycles=SHORT)
    parallel_seed_test(lambda: ForecastParallelEnv(short_env(env_id), "constant-velocity"), num_cycles=SHORT)
    check_episodes_repeat(lambda: ForecastParallelEnv(short_env(env_id), "constant-velocity"))


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["simple_tag_v3", "simple_speaker_listener_v4", "pursuit_v5"])
def test_registered_envs_run_with_a_dgvae(env_id: str, tmp_path: Path):
    path = save_tiny_for(short_env(env_id), tmp_path / env_id)
    parallel_api_test(ForecastParallelEnv(short_env(env_id), path), num_cycles=SHORT)
    check_episodes_repeat(lambda: ForecastParallelEnv(short_env(env_id), path, num_samples=2))
    last = play(ForecastParallelEnv(short_env(env_id), path))[-1]
    assert all(observation["valid"].any() and observation["forecast"].any() for observation in last.values())


@pytest.mark.parametrize(
    ("valid", "headings", "message"),
    [
        ([True, False], 2, "a full scene holds only agents that are there, 1 are not"),
        ([True, True], 3, r"2 agents need as many headings, got shape \(3,\)"),
    ],
)
def test_a_scene_that_is_not_full_is_not_padded(valid: list[bool], headings: int, message: str):
    full = Scene(np.zeros((2, 4)), np.arange(2), np.array(valid))
    with pytest.raises(UserError, match=f"Mine: {message}"):
        pad_multiagent_scene(full, {"a": 0}, np.zeros(headings), WORLD, "Mine")


def test_every_space_is_the_agent_s_with_forecasts():
    env = ForecastParallelEnv(make_multiagent_env("simple_tag_v3"), "constant-velocity")
    spaces = env.observation_spaces
    assert spaces == {agent: env.observation_space(agent) for agent in env.possible_agents}
    observations, _ = env.reset(seed=0)
    assert all(spaces[agent].contains(shown) for agent, shown in observations.items())
    env.close()
