"""Forecasts many copies of a PettingZoo environment in one batch.

A vector environment needs no forecast before its last copy has stepped: within `collected`, copies that are attached to
a `BatchedForward` return observations without forecast entries, and at the end of the block these are added to all of
them in one batch. A copy that is stepped outside of it gets its forecast at once. Either way, each copy's observations
are those that it would return by itself.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import nn

from envs.multiagent_observation import AgentEntries, MultiagentStream
from envs.readers.base import MultiagentScene
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.forecaster import Forecaster
from predictor.scene import Forecast


@dataclass(frozen=True)
class _Moment:
    """Scene of one environment, and its agents' observations, to which forecast entries are to be added."""

    scene: MultiagentScene
    observations: Mapping[str, dict[str, Any]]


class BatchedForward:
    """Forecasts the scenes of several environments, which arrive one by one, in one batch.

    Args:
        streams: stream of each environment, equal except for their noise, which is continued here.

    Attributes:
        stream: history and noise of all environments.
        collecting: whether observations wait for `fill`; otherwise each scene is forecast when it arrives.
    """

    def __init__(self, streams: Sequence[MultiagentStream]) -> None:
        """Starts with empty memory."""
        self.collecting = False
        first = streams[0]
        view = first.view_spec
        self.stream = MultiagentStream(
            first.forecaster, first.scene_spec, first.config, view.perception_m, view.max_agents, len(streams)
        )
        self.stream.continue_noise(streams)
        self._stepped: dict[int, _Moment] = {}
        self._opened: dict[int, _Moment] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state of a copy or a pickle, which collects nothing: its owner may be one environment alone."""
        return self.__dict__ | {"collecting": False}

    def begin(
        self, env: int, scene: MultiagentScene, observations: Mapping[str, dict[str, Any]], seed: int | None = None
    ) -> None:
        """Takes in the first scene of an environment's episode; a seed restarts its noise."""
        if env in self._opened or seed is not None:
            self.fill()
        if seed is not None:
            self.stream.seed([seed if i == env else None for i in range(self.stream.num_envs)])
        self._opened[env] = _Moment(scene, observations)
        if not self.collecting:
            self.fill()

    def go_on(self, env: int, scene: MultiagentScene, observations: Mapping[str, dict[str, Any]]) -> None:
        """Takes in the next scene of an environment's episode."""
        if env in self._stepped or env in self._opened:
            self.fill()
        self._stepped[env] = _Moment(scene, observations)
        if not self.collecting:
            self.fill()

    def fill(self) -> None:
        """Adds the forecast entries to all waiting observations; zeros for an agent that is not in the scene."""
        stepped, opened = self._stepped, self._opened
        self._stepped, self._opened = {}, {}
        if opened.keys() <= stepped.keys() and len(stepped) == self.stream.num_envs:
            moments = [*(stepped[env] for env in sorted(stepped)), *opened.values()]
            self._put(moments, self._over_boundary(moments, np.array(list(opened), dtype=np.int64)))
            return
        for moments_of, opening in ((stepped, False), (opened, True)):
            if moments_of:
                envs = np.array(list(moments_of), dtype=np.int64)
                if opening:
                    self.stream.reset(envs)
                moments = list(moments_of.values())
                self._put(moments, self.stream.observe_each([moment.scene for moment in moments], envs))

    def forecast_of(self, env: int) -> Forecast | None:
        """Returns the latest forecast of an environment, a batch of one."""
        self.fill()
        return self.stream.forecast_of(env)

    def _over_boundary(self, moments: list[_Moment], ended: np.ndarray) -> list[AgentEntries]:
        scenes, envs = [moment.scene for moment in moments], self.stream.num_envs
        if not len(ended):
            return self.stream.observe_each(scenes)
        return self.stream.observe_boundary(scenes[:envs], ended, scenes[envs:])

    def _put(self, moments: list[_Moment], entries: list[AgentEntries]) -> None:
        for moment, seen in zip(moments, entries, strict=True):
            for agent, observation in moment.observations.items():
                observation.update(seen[agent] if agent in seen else self.stream.nothing_seen())


@contextmanager
def collected(forward: BatchedForward | None) -> Iterator[None]:
    """Forecasts all scenes that arrive within the block in one batch, at its end; does nothing for None."""
    if forward is None:
        yield
        return
    forward.collecting = True
    try:
        yield
        forward.fill()
    finally:
        forward.collecting = False


def can_share(streams: Sequence[MultiagentStream]) -> bool:
    """Returns whether the streams can use one `BatchedForward`: equal views, settings and networks."""
    first = streams[0]
    return all(
        (one.scene_spec, one.view_spec, replace(one.config, seed=0))
        == (first.scene_spec, first.view_spec, replace(first.config, seed=0))
        and _equal(one.forecaster, first.forecaster)
        for one in streams
    )


def _equal(one: Forecaster, other: Forecaster) -> bool:
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, ConstantVelocity):
        return vars(one) == vars(other)
    if not isinstance(one, nn.Module) or not isinstance(other, nn.Module):
        return False
    settings = [(f.spec, f.horizon_steps, getattr(f, "config", None)) for f in (one, other)]
    weights, others = one.state_dict(), other.state_dict()
    return (
        settings[0] == settings[1]
        and bool(weights)
        and weights.keys() == others.keys()
        and all(torch.equal(tensor, others[name]) for name, tensor in weights.items())
    )
