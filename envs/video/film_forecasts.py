"""Draws forecasts into `env.render()`: `RecordVideo(FilmForecasts(ForecastObservation(env)), "films")`.

highway-env's environments are drawn by highway-env, larger than by itself. Any other one needs a function that says how
its pictures map the world: a `View`, of ten lines or less, given here or registered with `register_view`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import gymnasium as gym
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from envs.readers.highway import is_highway_env
from envs.readers.outcomes import outcome_keys
from envs.video.drawing import AgentOverlay, OverlayStyle, View, draw_overlay
from envs.video.files import decode_png, encode_png
from envs.video.film import Film
from envs.video.highway import forecast_shown, large_viewer, with_forecasts
from predictor.support.errors import UserError

Picture = UInt8[np.ndarray, "height width 3"]
Draw = Callable[[gym.Env], View | tuple[Picture, View]]
"""Takes the unwrapped environment; returns how `env.render()` maps the world, or a picture of its own with that."""
_REGISTERED: dict[type, Draw] = {}


def register_view(env_class: type, draw: Draw) -> None:
    """Registers how the pictures of an environment class map the world, for `FilmForecasts` and the commands that film.

    Args:
        env_class: class of the unwrapped environment.
        draw: takes the unwrapped environment and returns a `View` of what its `render()` shows, or a picture with its
            `View`, for an environment that draws nothing.
    """
    _REGISTERED[env_class] = draw


def view_of(env: gym.Env) -> Draw | None:
    """Returns the function registered for an environment's class, or for one that it derives from."""
    return next((_REGISTERED[kind] for kind in type(env.unwrapped).__mro__ if kind in _REGISTERED), None)


class FilmForecasts(gym.Wrapper[Any, Any, Any, Any]):
    """Gives pictures with the forecasts from now on, edges and the ego's plans drawn in.

        >>> import gymnasium as gym
        >>> import highway_env  # registers the ids
        >>> from envs import FilmForecasts, ForecastObservation
        >>> env = gym.make("highway-fast-v0", render_mode="rgb_array")
        >>> env = FilmForecasts(ForecastObservation(env, "constant-velocity"))
        >>> _ = env.reset(seed=0)
        >>> env.render().shape
        (300, 1200, 3)

    Args:
        env: environment with a `ForecastObservation` around it, made with `render_mode="rgb_array"`.
        draw: how its pictures map the world (see `register_view`); None takes what is registered, or highway-env's.
        num_samples: number of futures drawn for each agent; the likelier, the more opaque.
        style: colours and widths of the drawing.
        crash_key: key of the infos that says whether the ego has crashed; None takes the env's (`register_reader`).

    Raises:
        UserError: no `ForecastObservation`, no pictures, or no way to draw them.
    """

    def __init__(
        self,
        env: gym.Env,
        draw: Draw | None = None,
        num_samples: int = 1,
        style: OverlayStyle | None = None,
        crash_key: str | None = None,
    ) -> None:
        """Draws nothing yet."""
        super().__init__(env)
        self._forecasts = with_forecasts(env, "FilmForecasts draws")
        self._draw = draw or view_of(env)
        self._outcomes = outcome_keys(env, crash_key)
        if self._draw is None and not is_highway_env(env):
            raise UserError(
                f"nothing says where the world is in pictures of {type(env.unwrapped).__name__}; pass draw=, a "
                "function of the environment that returns a View, or register one with register_view"
            )
        if self._draw is None and env.render_mode != "rgb_array":
            raise UserError(f"films need an env made with render_mode='rgb_array', got {env.render_mode!r}")
        self._samples, self._style = num_samples, style or OverlayStyle()
        self._viewer: Any = None
        self._steps, self._return, self._reward, self._crashed = 0, 0.0, 0.0, False

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out highway-env's window, which cannot be copied; a copy opens its own."""
        return self.__dict__ | {"_viewer": None}

    @property
    def render_mode(self) -> str:  # type: ignore[override]  # gymnasium.Wrapper has a property, too
        """Always "rgb_array"."""
        return "rgb_array"

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the environment and what the caption says."""
        self._steps, self._return, self._reward, self._crashed = 0, 0.0, 0.0, False
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment; the caption says what it gave."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._steps, self._reward = self._steps + 1, float(cast(float, reward))
        self._return += self._reward
        self._crashed |= bool(self._outcomes.crashed(info))
        return observation, reward, terminated, truncated, info

    def render(self) -> Any:
        """Returns the picture of now, with the forecasts from now on."""
        picture, view = self._picture()
        env = self._forecasts
        shown = forecast_shown(env, self._samples, 0)
        places = zip(env.scene.ids.tolist(), env.scene.states[:, :2].tolist(), strict=True)
        now_m = {key: (x, y) for key, (x, y) in places}
        agents = [
            AgentOverlay(
                now_m=now_m[key],
                forecast_m=tuple(np.vstack([now_m[key], sample]) for sample in shown.forecast_m[i]),
                shares=tuple(shown.shares[i].tolist()),
                truth_m=np.empty((0, 2)),
                edge_prob=float(shown.edge_probs[i]),
            )
            for i, key in enumerate(shown.keys)
        ]
        ego = now_m[env.scene.ids.tolist()[0]]
        return draw_overlay(
            Image.fromarray(picture), view, ego, agents, self._caption(), self._style, shown.plans, future_known=False
        )

    def _picture(self) -> tuple[Picture, View]:
        base: Any = self.env.unwrapped
        if self._draw is None:
            if base.viewer is None or base.viewer is not self._viewer:
                base.viewer = self._viewer = large_viewer(base)
            rendered: Any = self.env.render()
            surface = base.viewer.sim_surface
            # a reader may count positions from elsewhere; the ego is at one place in the picture and in the scene
            origin_m = np.asarray(surface.origin) + self._forecasts.scene.states[0, :2] - base.vehicle.position
            return np.ascontiguousarray(rendered), View((float(origin_m[0]), float(origin_m[1])), surface.scaling)
        drawn = self._draw(base)
        picture: Any
        picture, view = (self.env.render(), drawn) if isinstance(drawn, View) else drawn
        array = np.asarray(picture)
        if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8:
            got = "nothing" if picture is None else f"shape {array.shape} of {array.dtype}"
            raise UserError(
                f"a picture must be an array of uint8 (height, width, 3), got {got}; make the env with "
                "render_mode='rgb_array', or let draw return a picture with its View"
            )
        even = array[: array.shape[0] // 2 * 2, : array.shape[1] // 2 * 2]  # H.264 needs even sizes
        return np.ascontiguousarray(even), view

    def _caption(self) -> str:
        name = self.env.spec.id if self.env.spec is not None else type(self.env.unwrapped).__name__
        time_s = self._steps * float(self.get_wrapper_attr("scene_spec").dt_s)
        text = f"{name}   t = {time_s:.1f} s   reward {self._reward:+.2f}   return {self._return:.2f}"
        return text + ("   crashed" if self._crashed else "")


@dataclass
class PictureRecording(Film):
    """Pictures of a played episode, one for each step."""

    fps: int
    """Number of pictures per second."""
    total_reward: float = 0.0
    """Return of the episode."""
    _pngs: list[bytes] = field(default_factory=list)

    def __len__(self) -> int:
        """Returns the number of pictures."""
        return len(self._pngs)

    def draw(self, index: int) -> Picture:
        """Returns a picture."""
        return np.asarray(decode_png(self._pngs[index]))


def record_pictures(
    env: FilmForecasts, act: Callable[[Any], Any], *, seed: int = 0, max_steps: int | None = None
) -> PictureRecording:
    """Plays one episode and keeps its pictures.

    Args:
        env: environment whose pictures are kept.
        act: function from its observation to an action.
        seed: seed of the reset.
        max_steps: largest number of policy steps.
    """
    recording = PictureRecording(max(1, round(1 / env.get_wrapper_attr("scene_spec").dt_s)))
    observation, _ = env.reset(seed=seed)
    recording._pngs.append(encode_png(env.render()))
    ended, steps = False, 0
    while not ended and steps != max_steps:
        observation, reward, terminated, truncated, _ = env.step(act(observation))
        recording.total_reward += float(cast(float, reward))
        recording._pngs.append(encode_png(env.render()))
        ended, steps = terminated or truncated, steps + 1
    return recording
