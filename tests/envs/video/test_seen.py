"""`draw_observation` shows the entries of an observation: every agent where it is, no padding, no other environment."""

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.quiver import Quiver
from stable_baselines3.common.vec_env import DummyVecEnv

from envs import ForecastObservation, VecForecast, draw_observation, make_env, unflatten
from envs.video import seen
from envs.wrappers import SceneObservation
from predictor.reports.looks import BLUE, ORANGE, PINK, SKY
from predictor.support.errors import UserError

AGENTS, SAMPLES, HORIZON, PLANS = 4, 3, 5, 2
SHOWN = (0, 2)


def entries(samples: int = SAMPLES) -> dict[str, np.ndarray]:
    """Agents in rows 0 and 2; rows 1 and 3 are padding, but hold numbers that would show if they were drawn."""
    rng = np.random.default_rng(0)
    futures = (AGENTS, samples, HORIZON, 2) if samples > 1 else (AGENTS, HORIZON, 2)
    valid = np.zeros(AGENTS, np.float32)
    valid[list(SHOWN)] = 1
    return {
        "observation": np.zeros((5, 5), np.float32),
        "agents": rng.normal(size=(AGENTS, 5)) * 10,
        "forecast": rng.normal(size=futures) * 10,
        "ego_path": np.stack([np.arange(1, HORIZON + 1), np.zeros(HORIZON)], -1),
        "closest": np.abs(rng.normal(size=(AGENTS, 2))),
        "edge_probs": np.array([[0.9, 0.2], [1, 1], [0.4, 0.6], [1, 1]]),
        "edge_features": rng.normal(size=(AGENTS, 16)),
        "valid": valid,
        **({"mode_probs": np.tile([0.7, 0.2, 0.1], (AGENTS, 1))} if samples > 1 else {}),
        **({"xy_scale": np.full((AGENTS, samples, HORIZON, 2), 1.5)} if samples > 1 else {}),
    }


def with_plans() -> dict[str, np.ndarray]:
    risk = np.zeros((AGENTS, PLANS))
    risk[2, 1] = 0.8
    gap_m = np.full((AGENTS, PLANS), 30.0)
    gap_m[2, 1] = -2
    return {**entries(), "what_if_risk": risk, "what_if_gap": gap_m, "what_if_contact": np.ones((AGENTS, PLANS))}


def scene_of(observation: dict[str, np.ndarray], y_down: bool = False) -> Any:
    return seen.plot_scene(Figure().subplots(), observation, y_down)


def lines(ax: Any, color: str) -> list[Any]:
    return [line for line in ax.lines if line.get_color() == color and len(line.get_xdata())]


def test_agents_stand_where_they_are_and_padding_nowhere():
    observation = entries()
    ax = scene_of(observation)
    dots = np.array([line.get_xydata()[0] for line in lines(ax, BLUE)])
    np.testing.assert_allclose(dots, observation["agents"][list(SHOWN), :2])
    assert [text.get_text() for text in ax.texts] == [str(row) for row in SHOWN]
    arrows = [(a.U[0], a.V[0]) for a in ax.collections if isinstance(a, Quiver)]
    np.testing.assert_allclose(arrows, observation["agents"][list(SHOWN), 2:4])


@pytest.mark.parametrize("samples", [1, SAMPLES])
def test_futures_begin_at_their_agent_and_the_likelier_is_more_opaque(samples: int):
    observation = entries(samples)
    drawn = lines(scene_of(observation), ORANGE)
    assert len(drawn) == len(SHOWN) * samples
    futures = observation["forecast"].reshape(AGENTS, samples, HORIZON, 2)
    for place, (row, sample) in enumerate((row, sample) for row in SHOWN for sample in range(samples)):
        expected = np.vstack([observation["agents"][row, :2], futures[row, sample]])
        np.testing.assert_allclose(drawn[place].get_xydata(), expected)
    opacity = [line.get_alpha() for line in drawn[:samples]]
    assert opacity == sorted(opacity, reverse=True) and len(set(opacity)) == samples


def test_the_scale_at_the_end_of_each_future():
    observation = entries()
    ovals = [patch for patch in scene_of(observation).patches if isinstance(patch, Ellipse)]
    assert [oval.width for oval in ovals] == [3.0] * len(SHOWN) * SAMPLES
    np.testing.assert_allclose(ovals[0].center, observation["forecast"][0, 0, -1])
    assert not [patch for patch in scene_of(entries(1)).patches if isinstance(patch, Ellipse)]


def test_edges_are_as_wide_as_they_are_likely_and_end_at_their_receiver():
    observation = entries()
    ax = scene_of(observation)
    to_ego, from_ego = lines(ax, PINK), lines(ax, SKY)
    for edges, probs in ((to_ego, (0.9, 0.4)), (from_ego, (0.2, 0.6))):
        widths = np.array([edge.get_linewidth() for edge in edges])
        np.testing.assert_allclose(widths / widths.max(), np.array(probs) / max(probs))
    np.testing.assert_allclose([edge.get_xydata()[1] for edge in to_ego], np.zeros((2, 2)))
    np.testing.assert_allclose([e.get_xydata()[1] for e in from_ego], observation["agents"][list(SHOWN), :2])


def test_everything_drawn_is_inside_and_y_may_point_down():
    observation = entries()
    for y_down in (False, True):
        ax = scene_of(observation, y_down)
        points = np.vstack([line.get_xydata() for line in ax.lines if len(line.get_xdata())])
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        assert (bottom > top) == y_down and left < right
        low, high = np.array([left, min(bottom, top)]), np.array([right, max(bottom, top)])
        assert (points > low).all() and (points < high).all()
        assert np.isclose((right - left) / abs(top - bottom), 3)


def test_closest_of_each_agent():
    observation = entries()
    ax = seen.plot_closest(Figure().subplots(), observation)
    np.testing.assert_allclose([bar.get_width() for bar in ax.patches], observation["closest"][list(SHOWN), 0])
    when = [f" {gap:.1f} m at {100 * share:.0f} %" for gap, share in observation["closest"][list(SHOWN)]]
    assert [text.get_text() for text in ax.texts] == when


@pytest.mark.slow
def test_a_picture_shows_every_entry():
    """Each entry, once it is changed for one agent that is there, changes the picture; those of padding change none."""
    observation = with_plans()
    whole = np.asarray(draw_observation(observation))
    assert whole.shape == (700, 1100, 3)
    unseen = {"observation", "what_if_contact"}
    for key in observation.keys() - unseen - {"valid", "ego_path"}:
        for row, differs in ((2, True), (3, False)):
            changed = {name: value.copy() for name, value in observation.items()}
            changed[key][row] = 0.5 * changed[key][row] + 0.25
            assert np.any(np.asarray(draw_observation(changed)) != whole) == differs, (key, row)
    longer = {**observation, "ego_path": 2 * observation["ego_path"]}
    assert np.any(np.asarray(draw_observation(longer)) != whole)


def test_a_road_without_others_is_drawn():
    observation = with_plans()
    observation["valid"][:] = 0
    assert draw_observation(observation).size == (1100, 700)


@pytest.mark.slow
def test_of_a_wrapper_dict_or_flat():
    env, flat = (ForecastObservation(make_env("highway-fast-v0"), "highway", flatten=f) for f in (False, True))
    observation, row = env.reset(seed=1)[0], flat.reset(seed=1)[0]
    picture = draw_observation(observation, y_down=True)
    assert np.array_equal(np.asarray(draw_observation(unflatten(flat, row), y_down=True)), np.asarray(picture))


@pytest.mark.unchecked
def test_a_flat_observation_ends_in_one_line():
    with pytest.raises(UserError, match=r"got ndarray; unflatten\(env, observation\) makes them of a flat one"):
        draw_observation(np.zeros(420, dtype=np.float32))


def test_observations_that_it_cannot_draw_end_in_one_line():
    with pytest.raises(UserError, match="forecast, closest are missing; got observation, agents, ego_path"):
        draw_observation({key: value for key, value in entries().items() if key not in ("forecast", "closest")})
    with pytest.raises(UserError, match=r"got adversary_0; of a PettingZoo environment take one agent's"):
        draw_observation({"adversary_0": entries()})
    with pytest.raises(UserError, match="agents, forecast, .* are missing; got no entries"):
        draw_observation({})


def test_many_environments_are_refused_and_one_of_them_drawn():
    venv = VecForecast(DummyVecEnv([lambda: SceneObservation(make_env("highway-fast-v0"))] * 2), "constant-velocity")
    observations: Any = venv.reset()
    with pytest.raises(UserError, match="draws one observation, got those of 2 environments; take one"):
        draw_observation(observations)
    assert draw_observation({key: value[1] for key, value in observations.items()}).size == (1100, 700)
