"""Film an episode of a PettingZoo parallel environment, with each agent's forecast and what then happened drawn in.

The picture is drawn from the scenes alone, so it is the same for every family of environments: agents are discs, and
what no reader reports (walls, lanes, the simulator's own artwork) is not there. The episode is played first and drawn
afterwards, when the truth and the room it took are known. Knows nothing of policies: `act` is any function from
observations to actions. highway-env with one ego is filmed by `envs.video.highway`.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from envs.parallel import ForecastParallelEnv
from envs.readers import multiagent_env_id
from envs.readers.base import role_of
from envs.readers.pursuit import is_pursuit_env
from envs.simulators.highway_multiagent import HighwayParallelEnv
from envs.video.drawing import (
    Arena,
    Color,
    Legend,
    OverlayStyle,
    Pen,
    Polyline,
    blank,
    draw_page,
    page_width,
    write_picture,
    write_video,
)
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

FPS = 20
"""Pictures per second."""
LENGTH_S = 8.0
"""How long a video should be; short episodes get more pictures between two steps."""
MAX_FRAMES_PER_STEP = 8
"""Slower than this is tedious."""

LANDMARK = "landmark"
"""Role of what stands on the ground: drawn below everybody, without forecast."""
OTHER = "other"
"""Role of whom nothing names."""
_AT_REST_MPS = 1e-3


@dataclass(frozen=True)
class MultiagentStyle:
    """Colours [RGB] and sizes [px of the picture] of a film without a simulator's picture."""

    arena_px: int = 600
    """Longer side of the arena."""
    ground_color: Color = (243, 243, 240)
    """Of the arena."""
    grid_color: Color = (226, 226, 222)
    """Of the lines that tell the scale."""
    role_colors: tuple[tuple[str, Color], ...] = (
        ("adversary", (205, 70, 20)),
        ("agent", (0, 105, 180)),
        (LANDMARK, (185, 185, 185)),
        (OTHER, (90, 90, 90)),
    )
    """Of agents and their forecasts, by role: an agent's name without its number; who has no name goes by a flag among
    the constant features ("landmark", "evader"), or is "other"."""
    other_colors: tuple[Color, ...] = ((0, 140, 100), (190, 130, 0), (205, 80, 140), (110, 80, 55))
    """Of all other roles, in alphabetical order, begun anew when used up."""
    disc_alpha: int = 120
    """Opacity of discs within their rim, 0–255."""
    radius: float = 0.012
    """Radius of a disc as a fraction of the arena's longer side, where scenes have no `radius_m`."""
    min_radius_px: float = 4.0
    """No disc is smaller."""
    lines: OverlayStyle = OverlayStyle(
        forecast_color=(90, 90, 90),
        forecast_width_px=1.6,
        dash_px=5.0,
        truth_width_px=1.1,
        edge_color=(120, 60, 190),
        edge_width_px=6.0,
        edge_alpha=90,
        text_color=(30, 30, 30),
    )
    """Of edges, truth, forecasts and text; a forecast takes its role's colour (not in the legend)."""


@dataclass(frozen=True)
class _Body:
    """One agent at one policy step."""

    now_m: Float[np.ndarray, "2"]
    """Where it is."""
    tick: Float[np.ndarray, "2"]
    """Unit vector along its heading, or its velocity where agents have no heading; zeros at rest."""
    radius_m: float
    """0 where scenes do not tell."""
    role: str
    """What it is coloured by."""
    forecast_m: Float[np.ndarray, "samples horizon 2"]
    """Where it was expected to go."""
    acts: float
    """Probability that it acts on the focus agent."""


@dataclass(frozen=True)
class _Moment:
    """One policy step."""

    bodies: dict[int, _Body]
    """By id."""
    returns: dict[str, float]
    """Mean return so far of each role's agents."""


@dataclass
class MultiagentRecording:
    """A played episode, ready to be drawn."""

    env_id: str
    """Which environment."""
    dt_s: float
    """Length of a policy step [s]."""
    focus: str
    """The agent whose incoming edges are drawn."""
    style: MultiagentStyle
    """How it will look."""
    y_up: bool = True
    """Whether y points up in the picture."""
    fps: int = FPS
    """Pictures per second."""
    _focus_id: int = -1
    _moments: list[_Moment] = field(default_factory=list)

    def __len__(self) -> int:
        """Number of pictures."""
        return 1 + self.num_steps * self.frames_per_step

    @property
    def num_steps(self) -> int:
        """Policy steps played."""
        return len(self._moments) - 1

    @property
    def frames_per_step(self) -> int:
        """Pictures per policy step, for a video of about `LENGTH_S`; that of a long episode is longer."""
        return int(np.clip(round(LENGTH_S * self.fps / max(1, self.num_steps)), 1, MAX_FRAMES_PER_STEP))

    @property
    def returns(self) -> dict[str, float]:
        """Mean return of each role's agents."""
        return dict(self._moments[-1].returns)

    def frame_of_step(self, step: int) -> int:
        """Index of the picture at the moment of a policy step."""
        if not 0 <= step <= self.num_steps:
            raise UserError(f"step must lie in [0, {self.num_steps}], got {step}")
        return step * self.frames_per_step

    def draw(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """The picture; positions between two policy steps are interpolated."""
        if not 0 <= index < len(self):
            raise UserError(f"index must lie in [0, {len(self) - 1}], got {index}")
        step, part = divmod(index, self.frames_per_step)
        arena = self._draw_arena(step, part / self.frames_per_step)
        above = self._roles(self._moments[step])
        return draw_page(arena, self._caption(index), above, self._legend, self._width_px, self.style.lines)

    def write_video(self, path: str | Path) -> None:
        """Encode as MP4 (H.264, yuv420p); `path` is always a whole file."""
        write_video(path, (self.draw(index) for index in range(len(self))), self.fps)

    def write_frame(self, path: str | Path, index: int) -> None:
        """Save one picture as PNG."""
        write_picture(path, self.draw(index))

    @cached_property
    def _arena(self) -> Arena:
        """Holds everybody at every step."""
        bodies = [body for moment in self._moments for body in moment.bodies.values()]
        places = np.array([body.now_m for body in bodies])
        return Arena.around(places, np.array([body.radius_m for body in bodies]), self.style.arena_px, self.y_up)

    @cached_property
    def _colors(self) -> dict[str, Color]:
        """Of each role of the episode."""
        seen = {body.role for moment in self._moments for body in moment.bodies.values()}
        known = {role: color for role, color in self.style.role_colors if role in seen}
        others = zip(sorted(seen - set(known)), itertools.cycle(self.style.other_colors), strict=False)
        return {**known, **dict(others)}

    @cached_property
    def _width_px(self) -> int:
        """Of every picture."""
        legends = [self._roles(moment) for moment in self._moments]
        return page_width(
            self._arena.size_px[0], self._caption(len(self) - 1), [*legends, self._legend], self.style.lines
        )

    def _caption(self, index: int) -> str:
        time_s = index / self.frames_per_step * self.dt_s
        return f"{self.env_id}    t = {time_s:.1f} s    grid {self._arena.grid_m:g} m"

    def _roles(self, moment: _Moment) -> Legend:
        """Colours, and mean returns so far."""

        def sample(role: str) -> Callable[[Pen, Polyline], None]:
            def draw(pen: Pen, line: Polyline) -> None:
                center = line[1] - (6.0, 0.0)
                if role != LANDMARK:
                    pen.forecast(line, self._colors[role])
                    center = line[0] + (6.0, 0.0)
                pen.disc(center, 6.0, (*self._colors[role], 255))

            return draw

        returns = {role: f": mean return {value:+.1f}" for role, value in moment.returns.items()}
        return [(role + returns.get(role, ""), sample(role)) for role in self._colors]

    @property
    def _legend(self) -> Legend:
        return (
            ("forecast", Pen.forecast),
            ("what happened", Pen.truth),
            (f"acts on {self.focus} (probability)", lambda pen, line: pen.edge(line, 0.7)),
        )

    def _draw_arena(self, step: int, part: float) -> Image.Image:
        """Landmarks on the ground, agents on edges, what they will do over them; `SMOOTHING` times larger."""
        bodies, lines = self._moments[step].bodies, self.style.lines
        picture, pen = blank(self._arena.size_px, self.style.ground_color, lines)
        for line in self._arena.grid():
            pen.line(line, 1.0, (*self.style.grid_color, 255))
        at = {key: self._arena.view.pixels(self._now_m(key, step, part)[None])[0] for key in bodies}
        moving = [key for key, body in bodies.items() if body.role != LANDMARK]
        for key, body in bodies.items():
            if body.role == LANDMARK:
                self._draw_disc(pen, body, at[key])
        for key, body in bodies.items():
            if self._focus_id in at and key != self._focus_id and body.acts >= lines.min_edge_prob:
                pen.edge(np.stack([at[self._focus_id], at[key]]), body.acts)
        for key in moving:
            self._draw_disc(pen, bodies[key], at[key], focused=key == self._focus_id)
        for key in moving:
            pen.truth(self._arena.view.pixels(self._truth_m(key, step)))
        for key in moving:
            for sample in bodies[key].forecast_m:
                line = self._arena.view.pixels(np.vstack([bodies[key].now_m, sample]))
                pen.forecast(line, self._colors[bodies[key].role])
        return picture

    def _draw_disc(self, pen: Pen, body: _Body, at: Float[np.ndarray, "2"], focused: bool = False) -> None:
        """An agent; a tick at its rim points ahead."""
        shown_m = body.radius_m or self.style.radius * max(self._arena.size_px) / self._arena.view.scaling
        radius = max(self.style.min_radius_px, shown_m * self._arena.view.scaling)
        color = self._colors[body.role]
        pen.disc(at, radius, (*self.style.ground_color, 255))  # edges end at the rim
        pen.disc(at, radius, (*color, self.style.disc_alpha))
        pen.ring(at, radius, 1.5, (*color, 255))
        if focused:
            pen.ring(at, radius + 4.0, 2.0, (*self.style.lines.edge_color, 255))
        forward = body.tick * (1.0, -1.0 if self.y_up else 1.0)
        pen.line(np.stack([at + radius * forward, at + (radius + 6.0) * forward]), 3.0, (*color, 255))

    def _now_m(self, key: int, step: int, part: float) -> Float[np.ndarray, "2"]:
        """Where an agent is, a part of a step later; one that is about to vanish stays."""
        here = self._moments[step].bodies[key].now_m
        if part == 0.0 or key not in self._moments[step + 1].bodies:
            return here
        return (1 - part) * here + part * self._moments[step + 1].bodies[key].now_m

    def _truth_m(self, key: int, step: int) -> Polyline:
        """Where an agent went within the horizon of its forecast, until it vanished."""
        horizon = self._moments[step].bodies[key].forecast_m.shape[1]
        ahead = self._moments[step : step + horizon + 1]
        there = itertools.takewhile(lambda moment: key in moment.bodies, ahead)
        return np.array([moment.bodies[key].now_m for moment in there])


def record_multiagent_episode(
    env: ForecastParallelEnv,
    act: Callable[[dict[str, Any]], dict[str, Any]],
    *,
    seed: int = 0,
    max_steps: int | None = None,
    focus: str | None = None,
    style: MultiagentStyle | None = None,
) -> MultiagentRecording:
    """Play one episode and keep what is needed to draw it.

    Args:
        env: the environment, wrapped; it need not be able to render.
        act: from the observations of the living agents to their actions.
        seed: the episode is reset with it.
        max_steps: stop after so many policy steps.
        focus: the agent whose incoming edges are drawn; None takes the first one that lives.
        style: how it will look.

    Raises:
        UserError: nobody is called like `focus`, or nobody is there to be filmed.
    """
    recorder = _Recorder(env, focus, style or MultiagentStyle())
    observations, _ = env.reset(seed=seed)
    recorder.begin()
    while env.agents and recorder.recording.num_steps != max_steps:
        living = {agent: observations[agent] for agent in env.agents}
        observations, rewards, _, _, _ = env.step(act(living))
        recorder.note(rewards)
    return recorder.recording


class _Recorder:
    """Follows an episode; remembers who is who, also when the environment no longer counts them."""

    def __init__(self, env: ForecastParallelEnv, focus: str | None, style: MultiagentStyle) -> None:
        if focus is not None and focus not in env.possible_agents:
            raise UserError(f"focus must be one of {', '.join(env.possible_agents)}, got '{focus}'")
        self._env = env
        self._focus = focus
        # Drawn as their own pictures are.
        y_up = not (isinstance(env.unwrapped, HighwayParallelEnv) or is_pursuit_env(env))
        self.recording = MultiagentRecording(multiagent_env_id(env), env.scene_spec.dt_s, "", style, y_up)
        self._names: dict[int, str] = {}
        self._returns: dict[str, float] = {}

    def begin(self) -> None:
        """The first moment, just after the reset."""
        if not self._env.agents:
            raise UserError(f"{self.recording.env_id} has no agents after its reset, so there is nothing to film")
        self.recording.focus = self._focus or self._env.agents[0]
        self.note({})

    def note(self, rewards: dict[str, float]) -> None:
        """Another moment, with the rewards that led to it."""
        shared = self._env.scene
        self._returns.update({agent: 0.0 for agent in self._env.agents if agent not in self._returns})
        for agent, reward in rewards.items():
            self._returns[agent] = self._returns.get(agent, 0.0) + float(reward)
        for name, row in shared.rows.items():
            self._names[int(shared.scene.ids[row])] = name
        focus_row = shared.rows.get(self.recording.focus)
        if focus_row is not None:
            self.recording._focus_id = int(shared.scene.ids[focus_row])
        self.recording._moments.append(_Moment(self._bodies(focus_row), _mean_by_role(self._returns)))

    def _bodies(self, focus_row: int | None) -> dict[int, _Body]:
        shared, forecast, spec = self._env.scene, self._env.forecast, self._env.scene_spec
        states = shared.scene.states
        xy_m = forecast.xy[0].double().cpu().numpy().swapaxes(0, 1)
        probs = 1 - forecast.edge_probs[0, :, :, 0].double().cpu().numpy()  # receiver first
        has_heading = bool(shared.heading_rad.any())
        sizes = spec.feature_names.index("radius_m") if "radius_m" in spec.feature_names else None
        bodies = {}
        for row in np.flatnonzero(shared.scene.valid):
            key = int(shared.scene.ids[row])
            bodies[key] = _Body(
                now_m=states[row, :2].copy(),
                tick=_tick(states[row, 2:4], float(shared.heading_rad[row]) if has_heading else None),
                radius_m=0.0 if sizes is None else float(states[row, sizes]),
                role=_role(self._names[key]) if key in self._names else _unnamed_role(states[row], spec),
                forecast_m=xy_m[row],
                acts=0.0 if focus_row is None else float(probs[focus_row, row]),
            )
        return bodies


def _tick(velocity_mps: Float[np.ndarray, "2"], heading_rad: float | None) -> Float[np.ndarray, "2"]:
    """Unit vector along the heading; without one, along the velocity, zeros at rest."""
    if heading_rad is not None:
        return np.array([np.cos(heading_rad), np.sin(heading_rad)])
    speed_mps = float(np.hypot(*velocity_mps))
    return velocity_mps / speed_mps if speed_mps > _AT_REST_MPS else np.zeros(2)


def _role(name: str) -> str:
    """An agent's name without its number."""
    role = role_of(name)
    return OTHER if role.isdigit() else role


def _unnamed_role(state: Float[np.ndarray, " features"], spec: SceneSpec) -> str:
    """The first flag that is set among the constant features ("landmark", "evader")."""
    flags = [name for name in spec.constant_features if not name.endswith("_m")]
    return next((name for name in flags if state[spec.feature_names.index(name)] == 1.0), OTHER)


def _mean_by_role(returns: dict[str, float]) -> dict[str, float]:
    """Mean over each role's agents."""
    grouped: dict[str, list[float]] = {}
    for name, value in returns.items():
        grouped.setdefault(_role(name), []).append(value)
    return {role: float(np.mean(values)) for role, values in grouped.items()}
