"""Films an episode of a PettingZoo parallel environment with the forecast and the true future of each agent.

The picture is drawn from the scenes alone, in one way for all families of environments: agents are discs, and walls,
lanes and the simulator's own artwork, which readers do not report, are missing. The episode is played first and drawn
afterwards, when the true futures and the extent of the arena are known. `act` is any function from observations to
actions. `envs.video.highway` films highway-env with one ego.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from envs.parallel import ForecastParallelEnv, living
from envs.readers import multiagent_env_id
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
    fan,
    page_width,
)
from envs.video.film import Film
from envs.video.moments import Body, Moment, bodies_now
from envs.video.roles import LANDMARK, OTHER, mean_by_role, named_role
from predictor.support.errors import UserError

FPS = 20
"""Number of pictures per second."""
LENGTH_S = 8.0
"""Length of a video [s]; short episodes get more pictures between two steps."""
MAX_FRAMES_PER_STEP = 8
"""Largest number of pictures per policy step."""


@dataclass(frozen=True)
class MultiagentStyle:
    """Colours [RGB] and sizes [px of the picture] of a film without a simulator's picture."""

    arena_px: int = 600
    """Longer side of the arena [px]."""
    ground_color: Color = (243, 243, 240)
    """Colour of the arena."""
    grid_color: Color = (226, 226, 222)
    """Colour of the grid."""
    role_colors: tuple[tuple[str, Color], ...] = (
        ("adversary", (205, 70, 20)),
        ("agent", (0, 105, 180)),
        (LANDMARK, (185, 185, 185)),
        (OTHER, (90, 90, 90)),
    )
    """Colours of agents and their forecasts, by role: an agent's name without its number; without a name, its flag
    among the constant features ("landmark", "evader"), or "other"."""
    other_colors: tuple[Color, ...] = ((0, 140, 100), (190, 130, 0), (205, 80, 140), (110, 80, 55))
    """Colours of all other roles, in alphabetical order, repeated when used up."""
    disc_alpha: int = 120
    """Opacity of discs within their rim, 0–255."""
    radius: float = 0.012
    """Radius of a disc as a fraction of the arena's longer side, where scenes have no `radius_m`."""
    min_radius_px: float = 4.0
    """Smallest radius of a disc [px]."""
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
    """Style of edges, true futures, forecasts and text; a forecast has its role's colour (not in the legend)."""


@dataclass
class _Seen:
    """Extent and roles of the moments so far; each is looked at once, also in a film that is drawn while it runs."""

    count: int = 0
    extent_m: Float[np.ndarray, "2 axes"] | None = None
    roles: set[str] = field(default_factory=set)

    def after(self, moments: list[Moment]) -> "_Seen":
        bodies = [body for moment in moments[self.count :] for body in moment.bodies.values()]
        self.count = len(moments)
        self.roles |= {body.role for body in bodies}
        if bodies:
            places, radii = np.array([body.now_m for body in bodies]), np.array([[body.radius_m] for body in bodies])
            ends = [places - radii, places + radii, *([] if self.extent_m is None else self.extent_m[:, None])]
            found = np.concatenate(ends)
            self.extent_m = np.stack([found.min(axis=0), found.max(axis=0)])
        return self


@dataclass
class MultiagentRecording(Film):
    """Played episode, which can be drawn."""

    env_id: str
    """Id of the environment."""
    dt_s: float
    """Length of a policy step [s]."""
    focus: str
    """Name of the agent whose incoming edges are drawn."""
    style: MultiagentStyle
    """Colours and sizes of the drawing."""
    y_up: bool = True
    """Whether y points up in the picture."""
    fps: int = FPS
    """Number of pictures per second."""
    expected_roles: frozenset[str] = frozenset()
    """Roles of the environment's named agents, those that have not come yet included."""
    _focus_id: int = -1
    _moments: list[Moment] = field(default_factory=list)
    _seen: _Seen = field(default_factory=_Seen)

    def __len__(self) -> int:
        """Returns the number of pictures."""
        return 1 + self.num_steps * self.frames_per_step

    @property
    def num_steps(self) -> int:
        """Number of policy steps played."""
        return len(self._moments) - 1

    @property
    def frames_per_step(self) -> int:
        """Number of pictures per policy step, for a video of `LENGTH_S`; a long episode's video is longer."""
        return int(np.clip(round(LENGTH_S * self.fps / max(1, self.num_steps)), 1, MAX_FRAMES_PER_STEP))

    @property
    def started(self) -> bool:
        """Whether a step was recorded."""
        return bool(self._moments)

    @property
    def returns(self) -> dict[str, float]:
        """Mean return of each role's agents."""
        return dict(self._moments[-1].returns)

    def frame_of_step(self, step: int) -> int:
        """Returns the index of the picture at a policy step."""
        if not 0 <= step <= self.num_steps:
            raise UserError(f"step must lie in [0, {self.num_steps}], got {step}")
        return step * self.frames_per_step

    def draw(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """Returns the picture; positions between two policy steps are interpolated."""
        if not 0 <= index < len(self):
            raise UserError(f"index must lie in [0, {len(self) - 1}], got {index}")
        step, part = divmod(index, self.frames_per_step)
        arena = self._draw_arena(step, part / self.frames_per_step)
        above = self._roles(self._moments[step].returns)
        return draw_page(arena, self._caption(index), above, self._legend, self._width_px, self.style.lines)

    @property
    def extent_m(self) -> Float[np.ndarray, "2 axes"]:
        """Lowest and highest coordinates of all agents at all steps so far."""
        extent_m = self._seen.after(self._moments).extent_m
        return np.zeros((2, 2)) if extent_m is None else extent_m

    @cached_property
    def _arena(self) -> Arena:
        """Arena that holds all agents at all steps."""
        return Arena.around(self.extent_m, np.zeros(2), self.style.arena_px, self.y_up)

    @cached_property
    def _colors(self) -> dict[str, Color]:
        """Colour of each role of the episode."""
        return self.colors_of(self.roles_seen)

    @property
    def roles_seen(self) -> set[str]:
        """Roles of all agents at all steps so far."""
        return self._seen.after(self._moments).roles

    def colors_of(self, roles: set[str]) -> dict[str, Color]:
        """Returns the colour of each role."""
        known = {role: color for role, color in self.style.role_colors if role in roles}
        others = zip(sorted(roles - set(known)), itertools.cycle(self.style.other_colors), strict=False)
        return {**known, **dict(others)}

    @cached_property
    def _width_px(self) -> int:
        """Width of all pictures [px]."""
        legends = [self._roles(moment.returns) for moment in self._moments]
        return page_width(
            self._arena.size_px[0], self._caption(len(self) - 1), [*legends, self._legend], self.style.lines
        )

    def _caption(self, index: int) -> str:
        return self._caption_at(index / self.frames_per_step * self.dt_s)

    def _caption_at(self, time_s: float) -> str:
        return f"{self.env_id}    t = {time_s:.1f} s    grid {self._arena.grid_m:g} m"

    def _roles(self, returns: dict[str, float]) -> Legend:
        """Returns the legend of roles: colours, and mean returns so far."""

        def sample(role: str) -> Callable[[Pen, Polyline], None]:
            def draw(pen: Pen, line: Polyline) -> None:
                center = line[1] - (6.0, 0.0)
                if role != LANDMARK:
                    pen.forecast(line, self._colors[role])
                    center = line[0] + (6.0, 0.0)
                pen.disc(center, 6.0, (*self._colors[role], 255))

            return draw

        shown = {role: f": mean return {value:+.1f}" for role, value in returns.items()}
        return [(role + shown.get(role, ""), sample(role)) for role in self._colors]

    @property
    def _legend(self) -> Legend:
        return (
            ("forecast", Pen.forecast),
            ("what happened", Pen.truth),
            (f"acts on {self.focus} (probability)", lambda pen, line: pen.edge(line, 0.7)),
        )

    def _draw_arena(self, step: int, part: float) -> Image.Image:
        """Draws landmarks, edges, agents, true futures and forecasts, in this order; `SMOOTHING` times larger."""
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
            body = bodies[key]
            for sample, opacity in fan(body.forecast_m, body.shares):
                line = self._arena.view.pixels(np.vstack([body.now_m, sample]))
                pen.forecast(line, self._colors[body.role], opacity)
        return picture

    def _draw_disc(self, pen: Pen, body: Body, at: Float[np.ndarray, "2"], focused: bool = False) -> None:
        """Draws an agent, with a tick at its rim that points ahead."""
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
        """Returns an agent's position a part of a step later; unchanged in its last step."""
        here = self._moments[step].bodies[key].now_m
        if part == 0.0 or key not in self._moments[step + 1].bodies:
            return here
        return (1 - part) * here + part * self._moments[step + 1].bodies[key].now_m

    def _truth_m(self, key: int, step: int) -> Polyline:
        """Returns an agent's positions within the horizon of its forecast, until it left the scene."""
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
    num_samples: int = 1,
    style: MultiagentStyle | None = None,
) -> MultiagentRecording:
    """Plays one episode and records it for drawing.

    Args:
        env: the environment, wrapped; it needs no render mode.
        act: function from the observations of the living agents to their actions.
        seed: seed of the reset.
        max_steps: largest number of policy steps.
        focus: name of the agent whose incoming edges are drawn; None takes the first one that lives.
        num_samples: number of futures drawn for each agent, whatever the policy sees; the likelier, the more opaque.
        style: colours and sizes of the drawing.

    Raises:
        UserError: no agent is called `focus`, or the environment has no agents after its reset.
    """
    recorder = MultiagentRecorder(env, focus, num_samples, style or MultiagentStyle())
    observations, _ = env.reset(seed=seed)
    recorder.begin()
    left = list(env.agents)
    while left and recorder.recording.num_steps != max_steps:
        observations, rewards, terminated, truncated, _ = env.step(act({agent: observations[agent] for agent in left}))
        left = living(env, terminated, truncated)
        recorder.note(rewards)
    return recorder.recording


class MultiagentRecorder:
    """Records an episode; keeps the agents' names, also after the environment has dropped them.

    Args:
        env: the environment.
        focus: name of the agent whose incoming edges are drawn; None takes the first one that lives.
        num_samples: number of futures drawn for each agent.
        style: colours and sizes of the drawing.
        kind: class of the recording.

    Raises:
        UserError: no agent is called `focus`.
    """

    def __init__(
        self,
        env: ForecastParallelEnv,
        focus: str | None,
        num_samples: int,
        style: MultiagentStyle,
        kind: "type[MultiagentRecording]" = MultiagentRecording,
    ) -> None:
        """Records nothing yet."""
        if focus is not None and focus not in env.possible_agents:
            raise UserError(f"focus must be one of {', '.join(env.possible_agents)}, got '{focus}'")
        self._env = env
        self._focus = focus
        self._samples = num_samples
        # y points as in the simulators' own pictures.
        y_up = not (isinstance(env.unwrapped, HighwayParallelEnv) or is_pursuit_env(env))
        roles = frozenset(map(named_role, env.possible_agents))
        self.recording = kind(multiagent_env_id(env), env.scene_spec.dt_s, "", style, y_up, expected_roles=roles)
        self._names: dict[int, str] = {}
        self._returns: dict[str, float] = {}
        self._acting: list[str] = []

    def begin(self) -> None:
        """Records the first step, after the reset."""
        if not self._env.agents:
            raise UserError(f"{self.recording.env_id} has no agents after its reset, so there is nothing to film")
        self.recording.focus = self._focus or self._env.agents[0]
        self.note({})

    def note(self, rewards: dict[str, float]) -> None:
        """Records a step, with the rewards that led to it."""
        scene = self._env.scene
        for agent in self._acting:  # some environments go on rewarding agents that have ended
            self._returns[agent] += float(rewards.get(agent, 0.0))
        self._acting = list(self._env.agents)
        self._returns.update({agent: 0.0 for agent in self._acting if agent not in self._returns})
        for name, index in scene.index_of.items():
            self._names[int(scene.scene.ids[index])] = name
        focus = scene.index_of.get(self.recording.focus)
        if focus is not None:
            self.recording._focus_id = int(scene.scene.ids[focus])
        self.recording._moments.append(
            Moment(bodies_now(self._env, focus, self._names, self._samples), mean_by_role(self._returns))
        )
