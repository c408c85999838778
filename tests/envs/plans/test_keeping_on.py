"""True futures of several learners: what a copy does in which they keep on is what then happens."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pettingzoo.utils import BaseParallelWrapper

from envs import ForecastParallelEnv, make_multiagent_env, parallel
from envs.arms import Arm
from envs.drivers.all_agents import make_driver
from envs.own_observation import without_added
from envs.sb3.agents_as_rows import ParallelVecEnv
from predictor.support.errors import UserError


class Chased(BaseParallelWrapper):
    """simple_tag_v3 with a prey that a heuristic drives, with habits and slips of its own."""

    def __init__(self) -> None:
        super().__init__(make_multiagent_env("simple_tag_v3"))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.driver = make_driver("heuristic", self.env, np.random.default_rng(seed))
        return self.env.reset(seed=seed, options=options)

    def drive_others(self, observations: Any) -> dict[str, Any]:
        """Returns the action of the prey."""
        return self.driver({"agent_0": without_added(observations["agent_0"])})


def watched_tag(observe: str = "oracle") -> ForecastParallelEnv:
    """Returns the chase, ten steps ahead."""
    return ForecastParallelEnv(Chased(), "constant-velocity", horizon_steps=10, arm=Arm(observe))


def kept(env: ForecastParallelEnv, seen: Any, pushes: list[int]) -> dict[str, Any]:
    """Returns the actions of a step in which the three predators push as given."""
    return dict(zip(env.possible_agents[:3], pushes, strict=True)) | env.env.drive_others(seen)


@pytest.mark.parametrize("steps_before", [1, 6])
def test_the_oracle_is_what_then_happens(steps_before: int):
    """The predators repeat their last push; the prey decides, and slips, as it then does."""
    env = watched_tag()
    seen, _ = env.reset(seed=4)
    pushes = [0, 0, 0]
    for step in range(steps_before):
        pushes = [1 + step % 4, 2, 4]
        seen, *_ = env.step(kept(env, seen, pushes))
    scene, told = env.scene.scene, seen["adversary_1"]
    true = env.scene.true_xy
    assert true is not None and true.shape == (6, 10, 2)  # two are obstacles
    others = [place for place, agent in enumerate(scene.ids) if agent != scene.ids[env.scene.index_of["adversary_1"]]]
    relative = true[others] - scene.states[env.scene.index_of["adversary_1"], :2]
    shown = told["forecast"][told["valid"].astype(bool)]
    nearest = np.argsort(np.linalg.norm(scene.states[others, :2] - scene.states[1, :2], axis=1))
    np.testing.assert_allclose(shown, relative[nearest], atol=1e-6)
    for step in range(10):
        seen, *_ = env.step(kept(env, seen, pushes))
        np.testing.assert_allclose(env.scene.scene.states[:, :2], true[:, step], atol=1e-9)


class Seeing(Chased):
    """The prey's driver decides by its observation alone, as a trained one does."""

    def drive_others(self, observations: Any) -> dict[str, Any]:
        own = without_added(observations["agent_0"])
        return {"agent_0": 1 + int(np.argmax(np.abs(own[4:8])))}


def test_drivers_that_read_observations_see_those_of_each_step(monkeypatch: pytest.MonkeyPatch):
    """Not those of the moment at which the futures begin."""
    env = ForecastParallelEnv(Seeing(), "constant-velocity", horizon_steps=10, arm=Arm("oracle"))
    seen, _ = env.reset(seed=4)
    for _ in range(4):
        seen, *_ = env.step(kept(env, seen, [1, 2, 4]))
    true, decided = env.scene.true_xy, set()
    assert true is not None
    for step in range(10):
        chosen = kept(env, seen, [1, 2, 4])
        decided.add(chosen["agent_0"])
        seen, *_ = env.step(chosen)
        np.testing.assert_allclose(env.scene.scene.states[:, :2], true[:, step], atol=1e-9)
    assert len(decided) > 1


def test_before_the_first_action_all_go_on_at_their_velocities():
    """Actions of an episode before do not count."""
    env = watched_tag()
    seen, _ = env.reset(seed=1)
    env.step(kept(env, seen, [3, 3, 3]))
    env.reset(seed=4)
    start = env.scene.scene.states
    ahead_s = env.scene_spec.dt_s * np.arange(1, 11)
    expected = start[:, None, :2] + ahead_s[:, None] * start[:, None, 2:4]
    np.testing.assert_allclose(env.scene.true_xy, expected, atol=1e-9)
    env.close()


def test_other_pushes_have_other_futures_of_the_prey():
    env = watched_tag()
    futures = []
    for push in (1, 2):
        seen, _ = env.reset(seed=4)
        for _ in range(5):
            seen, *_ = env.step(kept(env, seen, [push] * 3))
        futures.append(env.scene.true_xy[3] - env.scene.scene.states[3, :2])
    assert np.abs(futures[0] - futures[1]).max() > 0.1
    env.close()


def test_the_environment_is_not_touched():
    """The prey's slips are drawn from the same stream, played ahead or not."""
    plain, watched = watched_tag("zeros"), watched_tag()
    seen, shown = (env.reset(seed=2)[0] for env in (plain, watched))
    for step in range(25):
        for agent in seen:
            np.testing.assert_array_equal(seen[agent]["observation"], shown[agent]["observation"])
        assert not seen["adversary_0"]["forecast"].any() and shown["adversary_0"]["forecast"].any()
        pushes = [1 + step % 4, 2, 4]
        seen, shown = (env.step(kept(env, last, pushes))[0] for env, last in ((plain, seen), (watched, shown)))
    assert not plain.agents and not watched.agents


def test_after_the_end_of_an_episode_agents_go_on_at_their_last_velocity():
    env = watched_tag()
    seen, _ = env.reset(seed=2)
    for _ in range(23):
        seen, *_ = env.step(kept(env, seen, [1, 2, 3]))
    true = env.scene.true_xy
    np.testing.assert_allclose(np.diff(true[:, 1:], n=2, axis=1), 0, atol=1e-9)  # two steps are left
    assert np.abs(np.diff(true[:, :3], n=2, axis=1)).max() > 1e-3
    env.close()


def test_a_scene_that_nobody_played_is_refused():
    env = watched_tag()
    env.reset(seed=0)
    with pytest.raises(UserError, match="an oracle needs scenes with true_xy, which ForecastParallelEnv adds"):
        env.stream.observe(replace(env.scene, true_xy=None))
    env.close()


def test_copies_that_share_a_forward_tell_what_each_would():
    def partner(env: Any, seen: Any, generator: np.random.Generator) -> Any:
        return env.drive_others(seen)

    predators = ["adversary_0", "adversary_1", "adversary_2"]
    venv = ParallelVecEnv([watched_tag] * 2, agents=predators, partner=partner)
    venv.seed(4)
    together = venv.reset()
    alone = [watched_tag() for _ in range(2)]
    seen = [env.reset(seed=4 + place)[0] for place, env in enumerate(alone)]
    for step in range(6):
        for row, (place, name) in enumerate(zip(venv.copies_of_envs, venv.agents_of_envs, strict=True)):
            np.testing.assert_array_equal(together["forecast"][row], seen[place][name]["forecast"])
        pushes = [1 + step % 4, 2, 4]
        together, *_ = venv.step(np.array(pushes * 2))
        seen = [env.step(kept(env, last, pushes))[0] for env, last in zip(alone, seen, strict=True)]
    assert together["forecast"].any()
    venv.close()


def test_where_no_driver_decides_all_agents_keep_on():
    env = ForecastParallelEnv(make_multiagent_env("simple_spread_v3"), "constant-velocity", arm=Arm("oracle"))
    env.reset(seed=0)
    pushes = dict.fromkeys(env.agents, 3)
    env.step(pushes)
    true = env.scene.true_xy
    for step in range(5):
        env.step(pushes)
        np.testing.assert_allclose(env.scene.scene.states[:, :2], true[:, step], atol=1e-9)
    env.close()


def test_the_oracle_keeps_to_the_actions_that_were_given_even_if_the_environment_changes_them(
    monkeypatch: pytest.MonkeyPatch,
):
    told: list[dict[str, Any]] = []
    original = parallel.all_keeping_on

    def noting(env: Any, reader: Any, scene: Any, observations: Any, actions: dict[str, Any], steps: int) -> Any:
        told.append({agent: np.copy(action) for agent, action in actions.items()})
        return original(env, reader, scene, observations, actions, steps)

    class Clips(BaseParallelWrapper):
        def step(self, actions: dict[str, Any]) -> Any:
            found = super().step({agent: action.copy() for agent, action in actions.items()})
            for action in actions.values():
                action *= 0
            return found

    monkeypatch.setattr(parallel, "all_keeping_on", noting)
    inner = Clips(make_multiagent_env("simple_spread_v3", continuous_actions=True))
    env = ForecastParallelEnv(inner, "constant-velocity", arm=Arm("oracle"))
    env.reset(seed=0)
    env.step({agent: np.full(5, 0.5, dtype=np.float32) for agent in env.agents})
    assert all((action == 0.5).all() for action in told[-1].values()) and len(told[-1]) == 3
