import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from highway_env.envs.common.graphics import EnvViewer
from PIL import Image

from envs.drivers.ego import idle_action
from envs.registry import make_env
from envs.video.drawing import AgentOverlay, OverlayStyle, PlanOverlay, View, dashes, draw_overlay
from envs.video.highway import Recording, record_episode
from envs.wrappers import ForecastObservation
from predictor.support.errors import UserError

STEPS = 4
PLAIN = OverlayStyle(truth_color=(0, 255, 0), forecast_color=(255, 0, 0), edge_color=(0, 0, 255), edge_alpha=255)


@pytest.fixture
def env() -> Iterator[ForecastObservation]:
    made = ForecastObservation(make_env("highway-fast-v0", render_mode="rgb_array"), "constant-velocity")
    yield made
    made.close()


@pytest.fixture
def recording(env: ForecastObservation) -> Recording:
    action = idle_action(env)
    return record_episode(env, lambda obs: action, seed=1, max_steps=STEPS)


def decode(path: Path, height: int, width: int) -> np.ndarray:
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-i",
        str(path),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.slow
def test_video_has_every_simulated_picture(recording: Recording, tmp_path: Path):
    assert recording.num_steps == STEPS
    assert len(recording) == 1 + STEPS * recording.frames_per_step == 1 + STEPS * 5
    assert recording.fps == 10  # highway-env plays 5 Hz at twice real time
    path = tmp_path / "video.mp4"
    recording.write_video(str(path))
    frames = decode(path, 300, 1200)
    assert len(frames) == len(recording)
    error = np.abs(frames[7].astype(int) - recording.draw(7).astype(int)).mean()
    assert error < 3  # the picture that was drawn, up to compression
    assert [p.name for p in tmp_path.iterdir()] == ["video.mp4"]


def test_frame_is_saved_as_drawn(recording: Recording, tmp_path: Path):
    index = recording.frame_of_step(2)
    assert index == 2 * recording.frames_per_step
    recording.write_frame(str(tmp_path / "frame.png"), index)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "frame.png")), recording.draw(index))


def test_the_caption_tells_what_was_done_and_what_came_of_it(recording: Recording):
    first = recording._caption(0)
    gained = recording._steps[0].reward
    assert f"idle {gained:+.2f}   return 0.00" in first and gained > 0
    assert f"return {gained:.2f}" in recording._caption(recording.frame_of_step(1))
    last = recording._caption(len(recording) - 1)
    assert last.endswith(f"return {recording.total_reward:.2f}") and "idle" not in last, "nothing was done any more"
    crashed = replace(recording, crashed=True)
    assert crashed._caption(len(recording) - 1).endswith("crashed") and "crashed" not in crashed._caption(0)


def test_forecasts_and_truth_are_in_the_picture(recording: Recording):
    colors = recording.draw(2).reshape(-1, 3)
    style = recording.style
    assert (colors == style.forecast_color).all(-1).sum() > 50
    assert (colors == style.truth_color).all(-1).sum() > 50


def test_forecast_starts_where_the_agent_was_and_stays_there(recording: Recording):
    """Constant velocity on a straight road: the first forecast point is where the agent is one step later."""
    step, later = recording._steps[0], recording._frames[recording.frame_of_step(1)]
    common = [i for i, key in enumerate(step.keys) if key in later.positions_m]
    assert common
    for i in common:
        error_m = np.hypot(*(step.forecast_m[i, 0, 0] - later.positions_m[step.keys[i]]))
        assert error_m < 3.0  # accelerations are at most 5 m/s²


def test_same_seed_same_pictures(env: ForecastObservation, recording: Recording):
    action = idle_action(env)
    again = record_episode(env, lambda obs: action, seed=1, max_steps=STEPS)
    np.testing.assert_array_equal(again.draw(7), recording.draw(7))


def test_env_is_left_as_it_was(env: ForecastObservation, recording: Recording):
    assert env.unwrapped._record_video_wrapper is None  # type: ignore[attr-defined]
    assert env.unwrapped.viewer is None  # type: ignore[attr-defined]
    assert env.unwrapped.config["screen_width"] == 600  # type: ignore[attr-defined]
    assert EnvViewer.agent_display is None


def test_env_without_pictures_is_named():
    env = ForecastObservation(make_env("highway-fast-v0"), "constant-velocity")
    with pytest.raises(UserError, match="render_mode='rgb_array', got None"):
        record_episode(env, lambda obs: 0)
    env.close()


@pytest.mark.parametrize("step", [-1, STEPS + 1])
def test_step_outside_the_episode_is_named(recording: Recording, step: int):
    assert recording.frame_of_step(STEPS) == len(recording) - 1
    with pytest.raises(UserError, match=f"got {step}"):
        recording.frame_of_step(step)


def draw(agent: AgentOverlay) -> np.ndarray:
    picture = Image.new("RGB", (400, 200))
    return draw_overlay(picture, View((-10.0, -10.0), 10.0), (0.0, 0.0), [agent], "", PLAIN)


def count(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((picture == color).all(-1).sum())


def test_world_positions_land_on_their_pixels():
    agent = AgentOverlay((5.0, 0.0), (np.array([[5.0, -5.0], [15.0, -5.0]]),), np.array([[5.0, 5.0], [15.0, 5.0]]), 1.0)
    picture = draw(agent)
    assert tuple(picture[100, 125]) == (0, 0, 255)  # half way from the ego (100, 100) to the agent (150, 100)
    assert tuple(picture[150, 200]) == (0, 255, 0)
    assert tuple(picture[50, 250]) == (255, 0, 0)  # the dot at the forecast's end


def test_edge_width_follows_its_probability():
    line = np.array([[5.0, 5.0]])
    widths = [count(draw(AgentOverlay((5.0, 0.0), (), line, p)), (0, 0, 255)) for p in (0.0, 0.5, 1.0)]
    legend = widths[0]
    assert widths[1] > legend
    assert widths[2] - legend == pytest.approx(2 * (widths[1] - legend), rel=0.2)


def test_dashes_alternate_and_keep_corners():
    box = (0.0, 0.0), (9.0, 9.0)
    pieces = dashes(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]), 2.0, *box)
    assert [p.tolist() for p in pieces] == [[[0, 0], [2, 0]], [[3, 1], [3, 3]]]
    assert dashes(np.array([[1.0, 1.0], [1.0, 1.0]]), 2.0, *box) == []
    assert dashes(np.array([[1.0, 1.0]]), 2.0, *box) == []


def test_dashes_that_reach_into_the_box_are_those_of_the_whole_line():
    low, high = (0.0, 0.0), (30.0, 20.0)
    rng = np.random.default_rng(0)
    some = 0
    for _ in range(50):
        line = np.concatenate([rng.uniform(-40, 60, (4, 2)), [[10.0, 70.0], [10.0, -70.0]]])
        whole = dashes(line, 3.0, (-1e3, -1e3), (1e3, 1e3))
        found = [piece.tolist() for piece in dashes(line, 3.0, low, high)]
        assert [piece for piece in (one.tolist() for one in whole) if piece in found] == found
        points = [(piece.tolist(), np.linspace(piece[:-1], piece[1:], 99)) for piece in whole]
        seen = [piece for piece, at in points if ((at >= low) & (at <= high)).all(axis=-1).any()]
        assert all(piece in found for piece in seen)
        some += len(seen)
    assert some > 200


def test_a_forecast_that_ends_far_away_is_as_quick_to_draw_as_any():
    far = np.array([[5.0, 5.0], [1e9, 1e9], [5.0, 9.0]])
    assert len(dashes(far, 7.0, (-2.0, -2.0), (602.0, 302.0))) < 100


# --- Plans of the ego -------------------------------------------------------------------------------------------------


def test_plans_are_drawn_in_the_colour_of_their_risk():
    env = ForecastObservation(
        make_env("highway-fast-v0", render_mode="rgb_array"), "constant-velocity", what_if=True, horizon_steps=3
    )
    action = idle_action(env)
    played = record_episode(env, lambda obs: action, seed=1, max_steps=2)
    style = played.style
    env.reset(seed=1)
    assert env.plans is not None and env.what_if is not None
    plans = played._steps[0].plans
    assert len(plans) == len(env.plan_model.names)  # type: ignore[union-attr]
    np.testing.assert_allclose(plans[1].path_m[1:], env.plans.states[1, :, :2])
    np.testing.assert_allclose(plans[1].path_m[0], env.scene.states[0, :2])
    agents = np.flatnonzero(env.scene.valid)[1:]
    assert len(plans[1].others_m) == len(agents)
    expected = env.what_if.xy[0, 1, 0, int(agents[0])].numpy() + env.scene.states[0, :2]
    np.testing.assert_allclose(plans[1].others_m[0][1:], expected, atol=1e-4)
    colors = played.draw(0).reshape(-1, 3)
    assert (colors == style.risk_color(min(plan.risk for plan in plans))).all(-1).sum() > 20
    assert (colors == style.forecast_color).all(-1).sum() == 0  # forecasts without a plan are not drawn
    env.close()


def test_a_risky_plan_is_red_and_a_safe_one_green():
    style = OverlayStyle()
    assert style.risk_color(0.0) == style.safe_color and style.risk_color(1.0) == style.risky_color
    half = style.risk_color(0.5)
    assert all(min(a, b) <= c <= max(a, b) for a, b, c in zip(style.safe_color, style.risky_color, half, strict=True))
    line = np.array([[0.0, 0.0], [150.0, 0.0]])
    plan = PlanOverlay(line, (line + (0.0, 20.0),), 1.0)
    blank = Image.new("RGB", (200, 100))
    drawn = draw_overlay(blank, View((0.0, -50.0), 1.0), (0.0, 0.0), [], "", style, [plan]).reshape(-1, 3)
    assert (drawn == style.risky_color).all(-1).sum() > 300


def test_wrappers_around_the_forecasts_are_no_matter(env: ForecastObservation, recording: Recording):
    action = idle_action(env)
    outside = gym.wrappers.TimeLimit(env, max_episode_steps=2)
    again = record_episode(outside, lambda obs: action, seed=1, max_steps=STEPS)
    assert again.num_steps == 2
    np.testing.assert_array_equal(again._steps[0].forecast_m, recording._steps[0].forecast_m)


def test_an_environment_without_forecasts_is_refused():
    env = make_env("highway-fast-v0", render_mode="rgb_array")
    with pytest.raises(UserError, match="record_episode draws the forecasts of a ForecastObservation; wrap the env"):
        record_episode(env, lambda obs: 0)
    env.close()
