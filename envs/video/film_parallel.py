"""Draws forecasts into the `render()` of a PettingZoo environment: `FilmParallelForecasts(ForecastParallelEnv(env))`.

Pictures are drawn from the scenes, as in `envs.video.multiagent`, but while the episode runs: what will happen is not
known, and the arena is a square that grows with the places where agents have been.
"""

from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from pettingzoo.utils import BaseParallelWrapper

from envs.parallel import ForecastParallelEnv
from envs.video.drawing import Arena, Color, Legend, Pen, page_width
from envs.video.multiagent import MultiagentRecorder, MultiagentRecording, MultiagentStyle
from predictor.support.errors import ProtocolError, UserError

_WIDEST_RETURN = -99_999.9
_WIDEST_TIME_S = 9_999.9


class FilmParallelForecasts(BaseParallelWrapper):
    """Gives pictures with the forecasts from now on, and the edges to one agent.

        >>> from mpe2 import simple_tag_v3
        >>> from envs import FilmParallelForecasts, ForecastParallelEnv
        >>> env = FilmParallelForecasts(ForecastParallelEnv(simple_tag_v3.parallel_env(), "constant-velocity"))
        >>> _ = env.reset(seed=0)
        >>> picture = env.render()  # height × width × 3
        >>> picture.dtype
        dtype('uint8')

    The environment needs no render mode. All pictures of an episode have one size; `envs.video.files.write_video`
    makes an MP4 of them. `envs.video.multiagent.record_multiagent_episode` films a whole episode with what then
    happened.

    Args:
        env: the environment with forecasts.
        focus: name of the agent whose incoming edges are drawn; None takes the first one that lives.
        num_samples: number of futures drawn for each agent; the likelier, the more opaque.
        style: colours and sizes of the drawing.

    Raises:
        UserError: no `ForecastParallelEnv`, or no agent is called `focus`.
    """

    def __init__(
        self,
        env: ForecastParallelEnv,
        *,
        focus: str | None = None,
        num_samples: int = 1,
        style: MultiagentStyle | None = None,
    ) -> None:
        """Draws nothing yet."""
        if not isinstance(env, ForecastParallelEnv):
            raise UserError(
                f"FilmParallelForecasts draws the forecasts of a ForecastParallelEnv, got {type(env).__name__}; wrap "
                "the env in one first (for one ego: FilmForecasts)"
            )
        super().__init__(env)
        self._options = (focus, num_samples, style or MultiagentStyle())
        self._recorder = self._new_recorder()

    @property
    def render_mode(self) -> str:
        """Always "rgb_array"."""
        return "rgb_array"

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Resets the environment and what is drawn."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._recorder = self._new_recorder()
        self._recorder.begin()
        return observations, infos

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Steps the environment; the legend counts what it gave."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        self._recorder.note(rewards)
        return observations, rewards, terminations, truncations, infos

    def render(self) -> UInt8[np.ndarray, "height width 3"]:
        """Returns the picture of now, with the forecasts from now on.

        Raises:
            ProtocolError: before the first reset.
        """
        recording = self._recorder.recording
        if not recording.started:
            raise ProtocolError("there is nothing to draw yet; call reset() first")
        return recording.draw(len(recording) - 1)

    def _new_recorder(self) -> MultiagentRecorder:
        return MultiagentRecorder(self.env, *self._options, LiveRecording)


class LiveRecording(MultiagentRecording):
    """Episode that is drawn while it runs."""

    @property
    def _arena(self) -> Arena:
        """Square that holds all places where agents have been."""
        low, high = self.extent_m
        middle, half = (low + high) / 2, (high - low).max() / 2
        return Arena.around(np.stack([middle - half, middle + half]), np.zeros(2), self.style.arena_px, self.y_up)

    @property
    def _colors(self) -> dict[str, Color]:
        """Colour of each role, of agents that have not come yet as well."""
        return self.colors_of(self.roles_seen | self.expected_roles)

    @cached_property
    def _width_px(self) -> int:
        """Width of all pictures, with room for longer numbers [px]."""
        caption = self._caption_at(_WIDEST_TIME_S)
        widest = self._roles(dict.fromkeys(self.returns.keys() | self.expected_roles, _WIDEST_RETURN))
        return page_width(self.style.arena_px, caption, [widest, self._legend], self.style.lines)

    @property
    def _legend(self) -> Legend:
        return tuple(entry for entry in super()._legend if entry[1] is not Pen.truth)

    def _truth_m(self, key: int, step: int) -> Float[np.ndarray, "points 2"]:
        """Returns nothing: the future is not known."""
        return np.empty((0, 2))
