import subprocess
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpe2 import simple_tag_v3
from pettingzoo import ParallelEnv
from PIL import Image

from envs.parallel import ForecastParallelEnv
from envs.readers.base import MultiagentScene, pad_multiagent_scene
from envs.simulators.highway_multiagent import HighwayParallelEnv
from envs.video.drawing import Arena
from envs.video.film_parallel import FilmParallelForecasts
from envs.video.multiagent import LANDMARK, MultiagentRecording, MultiagentStyle, record_multiagent_episode
from predictor.scene import KINEMATIC_FEATURES, Forecast, Scene, SceneSpec
from predictor.support.errors import UserError

DT_S = 0.5
HORIZON = 3
STEPS = 6
DIES = 3
JOINS = 2
RED, BLUE, GREY, VIOLET = (255, 0, 0), (0, 0, 255), (0, 255, 0), (255, 0, 255)
PLAIN = MultiagentStyle(
    arena_px=300,
    role_colors=(("adversary", RED), ("agent", BLUE), (LANDMARK, GREY)),
    other_colors=((0, 255, 255), (255, 255, 0)),
    disc_alpha=255,
    lines=replace(MultiagentStyle().lines, edge_color=VIOLET, edge_alpha=255),
)

# Where each begins, and its velocity; "agent_1" dies at step DIES, "adversary_1" joins at step JOINS.
BODIES: Mapping[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "adversary_0": ((0.0, 0.0), (2.0, 0.0)),
    "adversary_1": ((0.0, 6.0), (0.0, -1.0)),
    "agent_0": ((8.0, 2.0), (-1.0, 1.0)),
    "agent_1": ((3.0, 5.0), (0.0, 2.0)),
    "rock": ((7.0, 7.0), (0.0, 0.0)),
}
NUMBERS = {name: 10 + i for i, name in enumerate(BODIES)}
LEARNERS = tuple(name for name in BODIES if name != "rock")


class StraightEnv(ParallelEnv):
    """Everybody moves straight on, whatever they do; adversaries earn 1 per step, agents -2 and -4."""

    metadata: dict[str, Any] = {"name": "straight_v0"}

    def __init__(self) -> None:
        self.possible_agents = list(LEARNERS)
        self.agents: list[str] = []
        self.step_count = 0
        self.acted: list[set[str]] = []
        self.render_mode = None

    def observation_space(self, agent: str) -> gym.spaces.Box:
        return gym.spaces.Box(-100.0, 100.0, (1,), np.float32)

    def action_space(self, agent: str) -> gym.spaces.Discrete:
        return gym.spaces.Discrete(2)

    def present(self) -> list[str]:
        return [
            name
            for name in BODIES
            if not (name == "agent_1" and self.step_count >= DIES)
            and not (name == "adversary_1" and self.step_count < JOINS)
        ]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.step_count, self.acted = 0, []
        return self._living()

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        self.acted.append(set(actions))
        before = list(self.agents)
        self.step_count += 1
        observations, infos = self._living()
        names = sorted({*before, *self.agents})
        observations |= {name: np.zeros(1, np.float32) for name in names}
        rewards = {n: 1.0 if n.startswith("adv") else -2.0 if n == "agent_0" else -4.0 for n in before}
        over = self.step_count == STEPS
        if over:
            self.agents = []
        ended = {name: over or name not in self.agents for name in names}
        return observations, rewards, ended, dict.fromkeys(names, False), infos

    def _living(self) -> tuple[dict, dict]:
        self.agents = [name for name in self.present() if name in LEARNERS]
        return {name: np.zeros(1, np.float32) for name in self.agents}, {name: {} for name in self.agents}


def place(name: str, step: float) -> np.ndarray:
    start, velocity = BODIES[name]
    return np.array(start) + step * DT_S * np.array(velocity)


class StraightReader:
    """Places in another order at each step; landmarks and, on request, sizes and headings."""

    def __init__(self, env: Any, headings: bool = False, sizes: bool = True) -> None:
        self._rng = np.random.default_rng(0)
        self._headings = headings
        extra = ("landmark", "radius_m") if sizes else ("landmark",)
        self.spec = SceneSpec(
            dt_s=DT_S,
            feature_names=(*KINEMATIC_FEATURES, *extra),
            feature_scales=(1.0,) * (4 + len(extra)),
            has_ego=False,
            max_agents=6,
            constant_features=extra,
        )

    def reset(self) -> None:
        pass

    def read(self, env: Any) -> MultiagentScene:
        base = env.unwrapped
        names = list(self._rng.permutation(base.present()))
        states = np.array([[*place(n, base.step_count), *BODIES[n][1], float(n == "rock"), 0.4] for n in names])
        scene = Scene(
            states[:, : self.spec.num_features], np.array([NUMBERS[n] for n in names]), np.ones(len(names)) > 0
        )
        index_of = {name: i for i, name in enumerate(names) if name in base.agents}
        return pad_multiagent_scene(scene, index_of, np.full(len(names), -np.pi / 2 * self._headings), self.spec)


class OneEdge(ForecastParallelEnv):
    """adversary_0 acts on agent_0 with probability `prob`, and no other agent on any."""

    prob = 1.0

    @property
    def forecast(self) -> Forecast:
        probs = np.zeros((1, 6, 6, 2), np.float32)
        probs[..., 0] = 1.0
        index_of = self.scene.index_of
        if {"agent_0", "adversary_0"} <= set(index_of):
            probs[0, index_of["agent_0"], index_of["adversary_0"]] = 1 - self.prob, self.prob
        forecast = super().forecast
        return replace(forecast, edge_probs=forecast.edge_probs.new_tensor(probs))


def wrapped(kind: type[ForecastParallelEnv] = ForecastParallelEnv, **reading: bool) -> ForecastParallelEnv:
    return kind(
        StraightEnv(), "constant-velocity", horizon_steps=HORIZON, reader=lambda env: StraightReader(env, **reading)
    )


def act(observations: dict[str, Any]) -> dict[str, Any]:
    return dict.fromkeys(observations, 0)


@pytest.fixture(scope="module")
def recording() -> MultiagentRecording:
    return record_multiagent_episode(wrapped(), act, style=PLAIN)


def count(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((picture == color).all(-1).sum())


def in_arena(recording: MultiagentRecording, index: int) -> np.ndarray:
    """The arena alone; it is as wide as the caption or narrower, and stands in the middle."""
    picture = recording.draw(index)
    width, height = recording._arena.size_px
    ground = (picture == PLAIN.ground_color).all(-1)
    top = int(np.flatnonzero(ground.any(axis=1))[0])
    left = (picture.shape[1] - width) // 2
    return picture[top : top + height, left : left + width]


def color_at(recording: MultiagentRecording, index: int, place_m: np.ndarray) -> tuple[int, ...]:
    x, y = recording._arena.view.pixels(place_m[None])[0]
    return tuple(in_arena(recording, index)[int(y), int(x)].tolist())


@pytest.mark.slow
def test_video_has_every_picture_and_its_size_is_even(recording: MultiagentRecording, tmp_path: Path):
    assert recording.num_steps == STEPS
    assert len(recording) == 1 + STEPS * recording.frames_per_step
    assert recording.frame_of_step(2) == 2 * recording.frames_per_step
    path = tmp_path / "video.mp4"
    recording.write_video(str(path))
    height, width, _ = recording.draw(0).shape
    assert height % 2 == width % 2 == 0
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path)]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    frames = np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)
    assert len(frames) == len(recording)
    assert np.abs(frames[7].astype(int) - recording.draw(7).astype(int)).mean() < 4
    assert [p.name for p in tmp_path.iterdir()] == ["video.mp4"]


def test_frame_is_saved_as_drawn(recording: MultiagentRecording, tmp_path: Path):
    recording.write_frame(str(tmp_path / "frame.png"), 9)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "frame.png")), recording.draw(9))


def test_no_agent_stands_outside_and_y_points_up(recording: MultiagentRecording):
    width, height = recording._arena.size_px
    for step in range(STEPS + 1):
        for body in recording._moments[step].bodies.values():
            x, y = recording._arena.view.pixels(body.now_m[None])[0]
            radius = body.radius_m * recording._arena.view.scaling
            assert radius < x < width - radius
            assert radius < y < height - radius
    low, high = recording._arena.view.pixels(np.array([[0.0, 0.0], [0.0, 6.0]]))
    assert low[1] > high[1]


def test_agents_are_drawn_where_they_are_in_the_colour_of_their_role(recording: MultiagentRecording):
    off = np.array([0.2, -0.2])  # beside the lines that leave the centre
    assert color_at(recording, 0, place("agent_0", 0) + off) == BLUE
    assert color_at(recording, 0, place("adversary_0", 0) + off) == RED
    assert color_at(recording, 0, place("rock", 0)) == GREY
    half = recording.frames_per_step // 2
    assert recording.frames_per_step == 2 * half
    ahead = place("agent_0", 1.5) + (-0.05, 0.3)  # within its disc now, but not within that of step 1
    assert color_at(recording, recording.frame_of_step(1), ahead) == PLAIN.ground_color
    assert color_at(recording, recording.frame_of_step(1) + half, ahead) == BLUE
    np.testing.assert_allclose(recording._now_m(NUMBERS["agent_0"], 1, 0.25), place("agent_0", 1.25))


def test_the_dead_vanish_and_who_joins_appears(recording: MultiagentRecording):
    last = place("agent_1", DIES - 1)
    off = np.array([0.2, -0.2])
    before = recording.frame_of_step(DIES) - 1
    assert color_at(recording, before, last + off) == BLUE
    assert color_at(recording, before + 1, last + off) == PLAIN.ground_color
    joined = recording.frame_of_step(JOINS)
    assert color_at(recording, joined, place("adversary_1", JOINS) + off) == RED
    assert color_at(recording, joined - 1, place("adversary_1", JOINS) + off) == PLAIN.ground_color


def test_forecast_and_truth_of_straight_motion_coincide(recording: MultiagentRecording):
    """Although the places of the scene change places at each step."""
    for step, moment in enumerate(recording._moments):
        for name, key in NUMBERS.items():
            if key not in moment.bodies:
                continue
            truth = recording._truth_m(key, step)
            end = DIES if name == "agent_1" else STEPS + 1
            assert len(truth) == min(HORIZON + 1, end - step)
            expected = [place(name, step + ahead) for ahead in range(HORIZON + 1)]
            np.testing.assert_allclose(moment.bodies[key].forecast_m[0], expected[1:], atol=1e-5)
            np.testing.assert_allclose(truth, expected[: len(truth)], atol=1e-9)


def test_forecasts_are_dashed_in_their_roles_colour_and_landmarks_have_none(recording: MultiagentRecording):
    ahead = place("agent_0", HORIZON)
    assert color_at(recording, 0, ahead) == BLUE  # the dot of the last step
    alone = replace_bodies(recording, {NUMBERS["rock"]})
    pushed = replace_bodies(alone, {NUMBERS["rock"]}, forecast_m=np.full((1, HORIZON, 2), 3.0))
    np.testing.assert_array_equal(alone.draw(0), pushed.draw(0))


def replace_bodies(recording: MultiagentRecording, keep: set[int], **changes: Any) -> MultiagentRecording:
    """The same episode with fewer bodies, otherwise described; the arena stays."""
    moments = [
        replace(m, bodies={key: replace(body, **changes) for key, body in m.bodies.items() if key in keep})
        for m in recording._moments
    ]
    changed = replace(recording, _moments=moments)
    changed.__dict__["_arena"] = recording._arena
    return changed


@pytest.mark.parametrize(("focus", "drawn"), [("agent_0", True), ("adversary_0", False)])
def test_edges_are_those_that_act_on_the_focus_agent(focus: str, drawn: bool):
    recording = record_multiagent_episode(wrapped(OneEdge), act, focus=focus, style=PLAIN)
    between = 0.4 * place("adversary_0", 0) + 0.6 * place("agent_0", 0)
    assert (color_at(recording, 0, between) == VIOLET) == drawn
    assert recording.focus == focus


def test_edges_are_as_wide_as_they_are_likely():
    areas = []
    for prob in (0.0, 0.5, 1.0):
        env = wrapped(OneEdge)
        env.prob = prob  # type: ignore[attr-defined]
        recording = record_multiagent_episode(env, act, focus="agent_0", max_steps=1, style=PLAIN)
        areas.append(count(in_arena(recording, 0), VIOLET))
    assert areas[1] > areas[0] + 100
    assert areas[2] - areas[0] == pytest.approx(2 * (areas[1] - areas[0]), rel=0.25)


def test_edges_end_with_the_focus_agent():
    recording = record_multiagent_episode(wrapped(OneEdge), act, focus="agent_1", style=PLAIN)
    assert count(in_arena(recording, 0), VIOLET) > 0  # its ring
    assert count(in_arena(recording, recording.frame_of_step(DIES)), VIOLET) == 0


def test_rewards_of_agents_that_have_ended_do_not_count(
    recording: MultiagentRecording, monkeypatch: pytest.MonkeyPatch
):
    plain = StraightEnv.step

    def generous(env: StraightEnv, actions: dict[str, Any]) -> Any:
        observations, rewards, *rest = plain(env, actions)
        return observations, dict.fromkeys(LEARNERS, 7.0) | rewards, *rest

    monkeypatch.setattr(StraightEnv, "step", generous)
    assert record_multiagent_episode(wrapped(), act, style=PLAIN).returns == recording.returns


def test_returns_are_means_over_each_roles_agents(recording: MultiagentRecording):
    first, second = float(STEPS), float(STEPS - JOINS)  # who joins at a step earns from the next on
    agents = -2.0 * STEPS, -4.0 * DIES
    assert recording.returns == {"adversary": (first + second) / 2, "agent": sum(agents) / 2}
    assert recording._moments[0].returns == {"adversary": 0.0, "agent": 0.0}
    assert recording._moments[1].returns == {"adversary": 1.0, "agent": -3.0}


def test_only_the_living_act_and_an_episode_may_be_cut_short():
    env = wrapped()
    recording = record_multiagent_episode(env, act, max_steps=DIES + 1)
    assert recording.num_steps == DIES + 1
    assert [sorted(names) for names in env.unwrapped.acted] == [
        ["adversary_0", "agent_0", "agent_1"],
        ["adversary_0", "agent_0", "agent_1"],
        ["adversary_0", "adversary_1", "agent_0", "agent_1"],
        ["adversary_0", "adversary_1", "agent_0"],
    ]


def test_ticks_follow_the_velocity_or_the_heading_where_there_is_one():
    moving = record_multiagent_episode(wrapped(), act, max_steps=1)._moments[0].bodies
    np.testing.assert_allclose(moving[NUMBERS["agent_0"]].tick, [-np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_array_equal(moving[NUMBERS["rock"]].tick, [0.0, 0.0])
    heading = record_multiagent_episode(wrapped(headings=True), act, max_steps=1)._moments[0].bodies
    np.testing.assert_allclose(heading[NUMBERS["rock"]].tick, [0.0, -1.0], atol=1e-12)


def test_agents_of_unknown_size_are_seen():
    style = replace(PLAIN, radius=0.05)
    small, large = (record_multiagent_episode(wrapped(sizes=False), act, max_steps=1, style=s) for s in (PLAIN, style))
    areas = [count(in_arena(recording, 0), GREY) for recording in (small, large)]
    assert areas[0] == pytest.approx(np.pi * PLAIN.min_radius_px**2, rel=0.4)
    assert areas[1] == pytest.approx(np.pi * (0.05 * 300) ** 2, rel=0.15)


def test_roles_without_a_colour_get_one_each():
    recording = record_multiagent_episode(wrapped(), act, style=replace(PLAIN, role_colors=(("agent", BLUE),)))
    assert recording._colors == {"agent": BLUE, "adversary": (0, 255, 255), LANDMARK: (255, 255, 0)}


@pytest.mark.parametrize(("steps", "frames"), [(1, 8), (25, 6), (60, 3), (100, 2), (500, 1)])
def test_videos_are_long_enough_to_watch(recording: MultiagentRecording, steps: int, frames: int):
    stretched = replace(recording, _moments=recording._moments[:1] * (steps + 1))
    assert stretched.frames_per_step == frames
    assert steps == 1 or len(stretched) / stretched.fps > 5


def test_pictures_are_equally_large_whatever_the_returns(recording: MultiagentRecording):
    rich = replace(recording._moments[-1], returns={"adversary": 1e9, "agent": -1e9})
    changed = replace(recording, _moments=[*recording._moments[:-1], rich])
    assert changed.draw(0).shape == changed.draw(len(changed) - 1).shape
    assert changed.draw(0).shape[1] > recording.draw(0).shape[1]


@settings(deadline=None)
@given(
    places=st.lists(st.tuples(*[st.floats(-1e4, 1e4)] * 2), min_size=1, max_size=5),
    y_up=st.booleans(),
)
def test_arenas_hold_all_agents_at_equal_aspect(places: list[tuple[float, float]], y_up: bool):
    places_m = np.array(places)
    arena = Arena.around(places_m, np.zeros(len(places)), 400, y_up)
    assert max(arena.size_px) == 400
    assert min(arena.size_px) >= 0.4 * 400
    pixels = arena.view.pixels(places_m)
    assert (pixels > 0).all()
    assert (pixels < arena.size_px).all()
    longest_m = max(float(np.ptp(places_m, axis=0).max()), 1e-3)
    assert longest_m / 16 < arena.grid_m <= longest_m / 6 * (1 + 1e-9)


def test_grid_lines_lie_at_round_coordinates():
    arena = Arena.around(np.array([[-1.0, 0.0], [1.0, 1.0]]), np.zeros(2), 448, True)
    assert arena.grid_m == pytest.approx(0.2)
    assert arena.size_px == (448, 248)  # 2.24 m by 1.24 m at 200 pixels per metre
    lines = arena.grid()
    xs = sorted(float(line[0, 0]) for line in lines if line[0, 0] == line[1, 0])
    ys = sorted(float(line[0, 1]) for line in lines if line[0, 1] == line[1, 1])
    np.testing.assert_allclose(xs, 24 + 40 * np.arange(11))
    np.testing.assert_allclose(ys, 24 + 40 * np.arange(6))


def test_grid_is_round_when_the_arena_is_too():
    arena = Arena.around(np.array([[0.0, 0.0], [0.6, 0.0]]), np.zeros(2), 400, True)
    assert 0.6 / 6 < 0.1  # in floating point
    assert arena.grid_m == pytest.approx(0.1)


def test_particle_worlds_are_filmed_to_the_last_step():
    env = ForecastParallelEnv(simple_tag_v3.parallel_env(max_cycles=4), "constant-velocity")
    recording = record_multiagent_episode(env, act, seed=3)
    assert (recording.env_id, recording.dt_s, recording.focus) == ("simple_tag_v3", 0.1, "adversary_0")
    assert recording.num_steps == 4
    assert all(len(moment.bodies) == 6 for moment in recording._moments)  # four agents, two obstacles
    assert set(recording.returns) == {"adversary", "agent"}
    again = record_multiagent_episode(env, act, seed=3)
    np.testing.assert_array_equal(again.draw(9), recording.draw(9))
    env.close()


def test_roads_are_shown_as_highway_env_shows_them():
    env = ForecastParallelEnv(HighwayParallelEnv(), "constant-velocity")
    recording = record_multiagent_episode(env, act, max_steps=1)
    assert not recording.y_up
    bodies = recording._moments[0].bodies.values()
    assert {body.role for body in bodies} == {"vehicle", "other"}
    env.close()


def test_unknown_focus_is_named():
    with pytest.raises(UserError, match="focus must be one of adversary_0, .*, got 'prey'"):
        record_multiagent_episode(wrapped(), act, focus="prey")


def test_empty_environment_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(StraightEnv, "present", lambda self: ["rock"])
    with pytest.raises(UserError, match="straight_v0 has no agents after its reset"):
        record_multiagent_episode(wrapped(), act)


@pytest.mark.parametrize("index", [-1, 1 + STEPS * 8])
def test_pictures_and_steps_outside_the_episode_are_named(recording: MultiagentRecording, index: int):
    assert len(recording) == 1 + STEPS * 8
    with pytest.raises(UserError, match=f"got {index}"):
        recording.draw(index)
    with pytest.raises(UserError, match=f"got {index}"):
        recording.frame_of_step(index)


def test_a_live_film_has_room_and_colours_for_agents_that_come_later():
    class LateAgents(StraightEnv):
        def present(self) -> list[str]:
            return [name for name in super().present() if not name.startswith("agent") or self.step_count >= JOINS]

    env = ForecastParallelEnv(
        LateAgents(), "constant-velocity", horizon_steps=HORIZON, reader=lambda env: StraightReader(env)
    )
    film = FilmParallelForecasts(env, style=PLAIN)
    film.reset()
    pictures = [film.render()]
    while film.agents:
        film.step(act(dict.fromkeys(film.agents)))
        pictures.append(film.render())
    assert len({picture.shape for picture in pictures}) == 1
    assert count(pictures[0], BLUE) > 0  # the legend of a role that nobody has yet
