"""Films an episode: draws forecasts, edge probabilities and true futures into highway-env's own pictures.

The episode is played first and drawn afterwards, when the true futures are known. Forecasts stay where they were made
(anchored in the world) until the next policy step replaces them. Pictures come from highway-env's viewer, made larger;
its agent-display hook is not used, because every env of a process shares it. `act` is any function from an observation
to an action.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import gymnasium as gym
import numpy as np
from highway_env.envs.common.graphics import EnvViewer
from jaxtyping import Float, UInt8

from envs.drivers.ego import constant_actions
from envs.plans.contact import contacts
from envs.readers.base import policy_step_s
from envs.readers.highway import HighwayReader, is_highway_env
from envs.video.drawing import (
    AgentOverlay,
    OverlayStyle,
    PlanOverlay,
    View,
    draw_overlay,
)
from envs.video.files import decode_png, encode_png
from envs.video.film import Film
from envs.wrappers import ForecastObservation
from predictor.scene import SceneBatch
from predictor.support.errors import UserError

ENLARGE = 2.0
"""Size of the picture relative to highway-env's."""
WIDEN = 1.25
"""Length of road in the picture relative to highway-env's; larger, since forecasts reach far ahead."""


@dataclass(frozen=True)
class _Frame:
    """One picture and the simulator's state, to draw on it."""

    png: bytes
    view: View
    positions_m: dict[int, tuple[float, float]]
    speed_mps: float
    step: int


@dataclass(frozen=True)
class _Step:
    """Forecasts of one policy step, and what was done then."""

    frame: int
    keys: tuple[int, ...]
    forecast_m: Float[np.ndarray, "agents samples horizon 2"]
    shares: Float[np.ndarray, "agents samples"]
    edge_probs: Float[np.ndarray, " agents"]
    plans: tuple[PlanOverlay, ...] = ()
    action: str = ""
    reward: float = 0.0


@dataclass
class Recording(Film):
    """Played episode, which can be drawn."""

    env_id: str
    """Gymnasium id."""
    fps: int
    """Number of pictures per second, as in highway-env: twice real time."""
    frames_per_step: int
    """Number of pictures per policy step."""
    dt_s: float
    """Length of a policy step [s]."""
    style: OverlayStyle
    """Colours and widths of the drawing."""
    total_reward: float = 0.0
    """Return of the episode."""
    crashed: bool = False
    """Whether the ego crashed."""
    _ego: int = -1
    _frames: list[_Frame] = field(default_factory=list)
    _steps: list[_Step] = field(default_factory=list)

    def __len__(self) -> int:
        """Returns the number of pictures."""
        return len(self._frames)

    @property
    def num_steps(self) -> int:
        """Number of policy steps played."""
        return len(self._steps) - 1

    def frame_of_step(self, step: int) -> int:
        """Returns the index of the picture at a policy step."""
        if not 0 <= step < len(self._steps):
            raise UserError(f"step must lie in [0, {len(self._steps)}), got {step}")
        return self._steps[step].frame

    def draw(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """Returns the annotated picture."""
        frame = self._frames[index]
        step = self._steps[frame.step]
        start = self._frames[step.frame]
        agents = [
            AgentOverlay(
                now_m=frame.positions_m[key],
                forecast_m=tuple(np.vstack([start.positions_m[key], sample]) for sample in step.forecast_m[i]),
                shares=tuple(step.shares[i].tolist()),
                truth_m=self._truth(key, step),
                edge_prob=float(step.edge_probs[i]),
            )
            for i, key in enumerate(step.keys)
            if key in frame.positions_m
        ]
        return draw_overlay(
            decode_png(frame.png), frame.view, frame.positions_m[self._ego], agents, self._caption(index), self.style,
            step.plans,
        )  # fmt: skip

    def _caption(self, index: int) -> str:
        """Returns time, speed, the action of the step with its reward, the return up to then, and a crash."""
        frame, at_end = self._frames[index], index == len(self) - 1
        step, gained = self._steps[frame.step], sum(one.reward for one in self._steps[: frame.step])
        words = [self.env_id, f"t = {index / self.frames_per_step * self.dt_s:.1f} s", f"{frame.speed_mps:.1f} m/s"]
        if step.action:
            words.append(f"{step.action} {step.reward:+.2f}")
        words.append(f"return {gained:.2f}")
        return "   ".join([*words, "crashed"] if at_end and self.crashed else words)

    def _truth(self, key: int, step: _Step) -> Float[np.ndarray, "points 2"]:
        """Returns an agent's positions within the horizon of a forecast, one per picture, while it was on the road."""
        last = step.frame + step.forecast_m.shape[2] * self.frames_per_step
        seen = [f.positions_m[key] for f in self._frames[step.frame : last + 1] if key in f.positions_m]
        return np.array(seen)


def record_episode(
    env: gym.Env,
    act: Callable[[Any], Any],
    *,
    seed: int = 0,
    max_steps: int | None = None,
    num_samples: int = 1,
) -> Recording:
    """Plays one episode and records it for drawing.

    Args:
        env: a highway-env environment made with `render_mode="rgb_array"`, wrapped in `ForecastObservation` and, as
            one likes, in other wrappers around it; with `what_if`, the plans of the ego and the forecasts for each are
            drawn instead of those without a plan.
        act: function from its observation to an action.
        seed: seed of the reset.
        max_steps: largest number of policy steps.
        num_samples: number of futures drawn for each agent, whatever the policy sees; the likelier, the more opaque.

    Raises:
        UserError: not a highway-env environment, one without a `ForecastObservation`, or one that cannot be rendered
            to arrays.
    """
    if not is_highway_env(env):
        raise UserError(f"videos need a highway-env environment, got {env.unwrapped.__class__.__name__}")
    if env.render_mode != "rgb_array":
        raise UserError(f"videos need an env made with render_mode='rgb_array', got {env.render_mode!r}")
    recorder = _Recorder(with_forecasts(env, "record_episode draws"), num_samples, OverlayStyle())
    try:
        obs, _ = env.reset(seed=seed)
        recorder.begin()
        ended = False
        while not ended and recorder.recording.num_steps != max_steps:
            action = act(obs)
            obs, reward, terminated, truncated, info = env.step(action)
            recorder.note_step(action, float(reward), bool(info.get("crashed", False)))
            ended = terminated or truncated
    finally:
        recorder.end()
    return recorder.recording


class _Recorder:
    """Records an episode; takes the place of highway-env's video wrapper, to get the pictures between two steps."""

    frames_per_sec: int = 0  # set by highway-env

    def __init__(self, env: ForecastObservation, num_samples: int, style: OverlayStyle) -> None:
        self._env = env
        self._samples = num_samples
        self._base = cast(Any, env.unwrapped)
        config: dict[str, Any] = self._base.config
        self.recording = Recording(
            env_id=env.spec.id if env.spec is not None else type(self._base).__name__,
            fps=0,
            frames_per_step=int(config["simulation_frequency"] // config["policy_frequency"]),
            dt_s=policy_step_s(config),
            style=style,
        )
        reader = env.get_wrapper_attr("reader")
        if not isinstance(reader, HighwayReader):
            raise UserError(
                "films with the pictures between two steps need highway-env's own reader, got "
                f"{type(reader).__name__}; film with FilmForecasts and record_pictures"
            )
        self._reader: HighwayReader = reader
        self._action_names = {number: name for name, number in constant_actions(env).items()}

    def begin(self) -> None:
        """Records the first picture, after the reset."""
        base = self._base
        base.viewer = large_viewer(base)
        base.set_record_video_wrapper(self)
        self.recording.fps = int(self.frames_per_sec)
        self.recording._ego = int(self._env.scene.ids[0])
        self._note_forecast()
        self._capture_frame()

    def note_step(self, action: Any, reward: float, crashed: bool) -> None:
        """Records the end of a policy step: its last picture shows the new forecast."""
        self.recording.total_reward += reward
        self.recording.crashed |= crashed
        numbers = " ".join(f"{value:+.2f}" for value in np.ravel(action))
        name = self._action_names.get(int(action), str(action)) if self._action_names else numbers
        self.recording._steps[-1] = replace(self.recording._steps[-1], action=name, reward=reward)
        self._note_forecast()
        self._capture_frame()

    def end(self) -> None:
        """Removes the recorder and its viewer from the env."""
        self._base._record_video_wrapper = None
        if self._base.viewer is not None:
            self._base.viewer.close()
            self._base.viewer = None

    def _capture_frame(self) -> None:
        """Records a picture; called by highway-env for each picture within a step, by `note_step` for the last."""
        pixels = np.ascontiguousarray(self._base.render())
        surface = self._base.viewer.sim_surface
        full = self._reader.read_all(self._env)
        places = zip(full.ids.tolist(), full.states[:, :2].tolist(), strict=True)
        positions = {key: (x, y) for key, (x, y) in places}
        view = View((float(surface.origin[0]), float(surface.origin[1])), float(surface.scaling))
        step = len(self.recording._steps) - 1
        frame = _Frame(encode_png(pixels), view, positions, float(self._base.vehicle.speed), step)
        self.recording._frames.append(frame)

    def _note_forecast(self) -> None:
        frame = len(self.recording._frames)
        self.recording._steps.append(forecast_shown(self._env, self._samples, frame))


def with_forecasts(env: gym.Env, draws: str) -> ForecastObservation:
    """Returns the `ForecastObservation` among the wrappers of an environment.

    Args:
        env: the environment.
        draws: name of what draws and "draws", for the message.

    Raises:
        UserError: there is none.
    """
    found: Any = env
    while not isinstance(found, ForecastObservation):
        if not isinstance(found, gym.Wrapper):
            raise UserError(f"{draws} the forecasts of a ForecastObservation; wrap the env in one first")
        found = found.env
    return found


def forecast_shown(env: ForecastObservation, num_samples: int, frame: int) -> _Step:
    """Returns what is drawn of the forecasts of now, and of the plans of the ego.

    Args:
        env: environment whose latest forecast is drawn.
        num_samples: number of futures for each agent.
        frame: index of the picture in which the forecast was made.
    """
    scene = env.scene
    has_as_many = env.forecast.xy.shape[1] == num_samples
    forecast = env.forecast if has_as_many else env.stream.pictured(num_samples)
    others = np.flatnonzero(scene.valid)[1:]  # without the ego
    keys = tuple(scene.ids[others].tolist())
    xy_m = forecast.xy[0].double().cpu().numpy() + scene.states[0, :2]
    probs = 1 - forecast.ego_edges()[0][0, :, 0, 0].double().cpu().numpy()  # agent → ego
    shares = forecast.sample_probs()[0].double().cpu().numpy()[:, others].T
    return _Step(frame, keys, xy_m[:, others].swapaxes(0, 1), shares, probs[others], plans_shown(env))


def plans_shown(env: ForecastObservation) -> tuple[PlanOverlay, ...]:
    """Returns the plans of now with the single forecast of each other agent; none without `what_if`."""
    if env.plans is None or env.what_if is None:
        return ()
    scene, plans = env.scene, env.plans
    others = np.flatnonzero(scene.valid)[1:]
    now_m = scene.states[:, :2]
    futures_m = env.what_if.xy[0, :, 0].double().cpu().numpy() + now_m[0]
    dt_s = env.get_wrapper_attr("scene_spec").dt_s
    safe = contacts(env.what_if, SceneBatch.stack([scene]), plans.size_m, dt_s).survival()[0, :, -1]
    if plans.crashed is not None:
        safe = safe * ~plans.crashed[:, -1]
    return tuple(
        PlanOverlay(
            np.vstack([now_m[:1], path[:, :2]]),
            tuple(np.vstack([now_m[agent : agent + 1], future[agent]]) for agent in others),
            1.0 - float(survived),
        )
        for path, future, survived in zip(plans.states, futures_m, safe, strict=True)
    )


def large_viewer(base: Any) -> EnvViewer:
    """Makes a viewer of a highway-env environment that draws to memory, `ENLARGE` times as large as its own."""
    config = dict(base.config)
    for name in ("screen_width", "screen_height"):
        config[name] = 2 * round(config[name] * ENLARGE / 2)  # H.264 needs even sizes
    config["scaling"] = config["scaling"] * ENLARGE / WIDEN
    return _make_viewer(base, config)


def _make_viewer(base: Any, config: dict[str, Any]) -> EnvViewer:
    """Makes a viewer that draws to memory and needs no display.

    SDL fails without a screen unless its dummy driver is chosen. highway-env disables drawing for that driver, so it is
    enabled again.
    """
    before = os.environ.get("SDL_VIDEODRIVER")
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    try:
        viewer = EnvViewer(base, config)
    finally:
        if before is None:
            del os.environ["SDL_VIDEODRIVER"]
        else:
            os.environ["SDL_VIDEODRIVER"] = before
    viewer.enabled = True
    return viewer
