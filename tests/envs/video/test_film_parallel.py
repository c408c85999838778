from typing import Any

import numpy as np
import pytest
from mpe2 import simple_tag_v3
from pettingzoo.utils import BaseParallelWrapper

from envs import FilmParallelForecasts, ForecastParallelEnv
from envs.video.files import write_video
from envs.video.multiagent import MultiagentStyle, record_multiagent_episode
from predictor.support.errors import ProtocolError, UserError

STYLE = MultiagentStyle(arena_px=200)
STEPS = 8


def tag(**options: Any) -> FilmParallelForecasts:
    env = ForecastParallelEnv(simple_tag_v3.parallel_env(max_cycles=STEPS), "constant-velocity")
    return FilmParallelForecasts(env, **{"style": STYLE, **options})


def away(env: Any) -> dict[str, int]:
    """Adversaries go left, the prey goes right: the arena has to grow."""
    return {agent: 1 if agent.startswith("adv") else 2 for agent in env.agents}


def played(env: FilmParallelForecasts, seed: int = 1) -> list[np.ndarray]:
    env.reset(seed=seed)
    pictures = [env.render()]
    while env.agents:
        env.step(away(env))
        pictures.append(env.render())
    return pictures


def test_all_pictures_of_an_episode_have_one_even_size_and_make_a_video(tmp_path: Any):
    pictures = played(tag())
    assert len(pictures) == STEPS + 1
    [shape] = {picture.shape for picture in pictures}
    assert shape[0] % 2 == shape[1] % 2 == 0 and shape[2] == 3
    assert all((one != other).any() for one, other in zip(pictures, pictures[1:], strict=False))
    write_video(tmp_path / "tag.mp4", pictures, fps=5)
    assert (tmp_path / "tag.mp4").stat().st_size > 1000


def test_the_arena_holds_everybody_and_what_happens_later_changes_no_picture():
    first, second = tag(), tag()
    first.reset(seed=1)
    second.reset(seed=1)
    for env in (first, second):
        env.step(away(env))
    before = first.render()
    second.step(away(second))
    first.step({agent: 0 for agent in first.agents})  # another future
    assert not np.array_equal(first.render(), before)
    again = tag()
    again.reset(seed=1)
    again.step(away(again))
    assert np.array_equal(again.render(), before)
    recording = second._recorder.recording
    low, high = recording.extent_m
    places_px = recording._arena.view.pixels(np.stack([low, high]))
    assert (places_px >= 0).all() and (places_px <= np.array(recording._arena.size_px)).all()
    assert recording._arena.size_px == (200, 200)


def test_the_future_is_in_no_picture_and_not_in_the_legend():
    env = tag()
    played(env)
    recording = env._recorder.recording
    assert [name for name, _ in recording._legend] == ["forecast", "acts on adversary_0 (probability)"]
    assert all(len(recording._truth_m(key, 0)) == 0 for key in recording._moments[0].bodies)
    whole = record_multiagent_episode(env.env, lambda seen: away(env.env), seed=1, style=STYLE)
    assert "what happened" in [name for name, _ in whole._legend]


def test_returns_are_counted_from_each_reset_on():
    env = tag(focus="agent_0", num_samples=2)
    played(env)
    recording = env._recorder.recording
    assert recording.focus == "agent_0" and recording.returns["agent"] != 0
    assert recording._moments[-1].bodies[recording._focus_id].forecast_m.shape[0] == 2
    env.reset(seed=2)
    assert env._recorder.recording.returns == {"adversary": 0.0, "agent": 0.0}
    assert len(env._recorder.recording) == 1


def test_it_is_a_wrapper_like_others():
    env = tag()
    assert isinstance(env, BaseParallelWrapper) and env.render_mode == "rgb_array"
    assert env.observation_space("agent_0") == env.env.observation_space("agent_0")
    observations, _ = env.reset(seed=0)
    assert set(observations) == set(env.possible_agents)


def test_what_cannot_be_drawn_is_one_sentence():
    with pytest.raises(ProtocolError, match=r"there is nothing to draw yet; call reset\(\) first"):
        tag().render()
    with pytest.raises(UserError, match="focus must be one of adversary_0, .*, got 'agent_7'"):
        tag(focus="agent_7")


@pytest.mark.unchecked
def test_an_environment_without_forecasts_is_one_sentence():
    plain: Any = simple_tag_v3.parallel_env()
    with pytest.raises(UserError, match="draws the forecasts of a ForecastParallelEnv, got aec_to_parallel_wrapper; "):
        FilmParallelForecasts(plain)
