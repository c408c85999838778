"""Streaming forecasts: one forecaster for many parallel environments, whose memory follows agents by id.

Between two observations agents may be re-sorted and may come and go: memory moves with an agent's id,
new agents start from zero, and the memory of agents that left is dropped. The cost of a step does not depend on the
length of the history. Nothing loops over scenes in Python; many scenes are taken in parts of `max_rows`, so that what a
forecaster needs for a moment does not grow with their number.
"""

import copy
import os
from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from predictor.forecaster import Belief, Forecaster, Memory
from predictor.forecaster_checks import check_empty, check_futures, check_observed, check_scale
from predictor.graph import NO_AGENT
from predictor.noise import Noise, check_noise
from predictor.scene import LARGEST, PADDING_ID, Forecast, SceneBatch
from predictor.scene_checks import (
    check_batch,
    check_ids,
    check_request,
    check_resolution,
    check_states,
    chosen_envs,
)
from predictor.support.errors import ProtocolError, UserError
from predictor.support.runtime import resolve_device
from predictor.what_if import check_plans, rollout_plans

Chosen = Int[np.ndarray, " some"] | Bool[np.ndarray, " envs"]
"""Some of the environments: their indices, or a mask."""
MAX_ROWS = 1024
"""Largest number of scenes in one call of a forecaster."""

_process = os.getpid()


def use_one_thread_after_fork() -> None:
    """Limits torch to one thread in a process that was forked from the one that imported this module.

    A forked worker (SubprocVecEnv or AsyncVectorEnv with "fork") inherits OpenMP's state without its threads and would
    wait for them forever; with one thread it does not use them. torch's DataLoader workers are limited the same way.
    Call it before a worker's first operation on tensors; from the second call on it changes nothing.
    """
    global _process
    if os.getpid() != _process:
        _process = os.getpid()
        torch.set_num_threads(1)


class OnlineForecaster:
    """Keeps the memory of a forecaster for `envs` parallel scenes.

    A deep copy continues on its own and shares the forecaster, which no step changes.

    Args:
        forecaster: any `Forecaster`.
        envs: number of parallel scenes, one for each environment.
        agents: number of agents of each scene, padding included.
        device: device of the forecaster: cpu, cuda or auto.
        max_rows: largest number of scenes in one call of the forecaster.
    """

    def __init__(
        self, forecaster: Forecaster, envs: int, agents: int, device: str = "cpu", max_rows: int = MAX_ROWS
    ) -> None:
        """Starts with empty memory for every environment.

        Raises:
            UserError: a number of environments, agents or scenes that is no whole number from 1 on.
        """
        for name, number in (("envs", envs), ("agents", agents), ("max_rows", max_rows)):
            if not isinstance(number, int | np.integer) or number < 1:
                raise UserError(f"{name} must be a whole number of at least 1, got {number!r}")
        use_one_thread_after_fork()
        self.forecaster, self._max_rows = forecaster, max_rows
        self.device = torch.device(resolve_device(device))
        self._memory = forecaster.empty_memory(envs, agents)
        check_empty(self._memory, envs, agents)
        self._fresh = forecaster.empty_memory(1, agents)
        self._ids: Int[np.ndarray, "envs agents"] = np.full((envs, agents), PADDING_ID, dtype=np.int64)
        self._ego_axes = np.array([f == "ego" for f in forecaster.spec.frame], dtype=np.float64)
        self._beliefs: list[Belief] = []  # one for each part of the latest scenes
        self._origins: Float[np.ndarray, "scenes axes"] = np.zeros((0, len(self._ego_axes)))

    def __deepcopy__(self, memo: dict[int, Any]) -> "OnlineForecaster":
        """Returns an independent copy; memory and belief are replaced at each step, never written to."""
        twin = copy.copy(self)
        memo[id(self)] = twin
        twin._ids = self._ids.copy()
        return twin

    def reset(self, envs: Chosen | None = None) -> None:
        """Clears the history of some environments (all, if None); the others keep theirs.

        Raises:
            UserError: an environment that is not there, or one twice.
        """
        use_one_thread_after_fork()
        chosen = np.arange(len(self._ids)) if envs is None else chosen_envs(envs, len(self._ids))
        if not len(chosen):
            return
        self._beliefs = []  # a forecast of what is forgotten would have no meaning
        self._ids[chosen] = PADDING_ID
        index = torch.from_numpy(chosen).to(self.device)
        fresh = self._fresh.select(torch.zeros(len(chosen), dtype=torch.long, device=self.device))
        self._memory = self._memory.replace_envs(index, fresh)

    @torch.inference_mode()
    def observe(self, scenes: SceneBatch, envs: Chosen | None = None) -> None:
        """Observes one scene per environment, or one for each of `envs`; the next `forecast` has as many entries.

        Raises:
            UserError: the batch has another shape or type, states that are not finite or too far from zero for float32,
                or an id twice in a scene; an environment that is not there, or one twice.
        """
        use_one_thread_after_fork()
        envs = None if envs is None else chosen_envs(envs, len(self._ids))
        self._check(scenes, len(self._ids) if envs is None else len(envs))
        if envs is None:
            self._memory, self._ids = self._take(scenes, self._ids, self._memory)
            return
        index = torch.from_numpy(envs).to(self.device)
        memory, self._ids[envs] = self._take(scenes, self._ids[envs], self._memory.select(index))
        self._memory = self._memory.replace_envs(index, memory)

    @torch.inference_mode()
    def observe_boundary(self, scenes: SceneBatch, ended: Int[np.ndarray, " ended"], successors: SceneBatch) -> None:
        """Observes one scene per environment, some the last of their episode, together with their successors.

        One batched step serves both: `scenes` continue their histories; for each environment in `ended`, the first
        scene of its next episode starts with an empty history and is what stays in memory. The next `forecast`
        has `len(scenes) + len(ended)` entries, the successors last.
        """
        use_one_thread_after_fork()
        envs = len(self._ids)
        ended = chosen_envs(ended, envs)
        self._check(scenes, envs)
        self._check(successors, len(ended))
        fresh = self._fresh.select(torch.zeros(len(ended), dtype=torch.long, device=self.device))
        no_ids = np.full((len(ended), self._ids.shape[1]), PADDING_ID, dtype=np.int64)
        memory, ids = self._take(
            SceneBatch.concatenate(scenes, successors),
            np.concatenate([self._ids, no_ids]),
            Memory.concatenate(self._memory, fresh),
        )
        kept = np.arange(envs)
        kept[ended] = envs + np.arange(len(ended))
        self._memory = memory.select(torch.from_numpy(kept).to(self.device))
        self._ids = ids[kept]

    def forecast(
        self,
        horizon_steps: int | None = None,
        num_samples: int = 1,
        generator: Noise | None = None,
        ego_plan: Float[np.ndarray, "..."] | None = None,
    ) -> Forecast:
        """Forecasts from the latest observation; sample 0 is the single forecast.

        No gradient flows through a forecast; its tensors may be inputs of networks that are trained.

        Args:
            horizon_steps: number of steps; None takes the forecaster's.
            num_samples: number of futures per agent.
            generator: source of the samples' noise: one of torch for all scenes of the latest observation, or a list of
                NumPy's, one for each.
            ego_plan: plans of the ego, (scenes, plans, steps, features): its state at each step, in the world frame and
                the spec's units. The ego follows them, the others react; the forecast has an axis for the plans.

        Raises:
            ProtocolError: nothing was observed yet.
            UserError: steps or samples are no whole numbers from 1 on; another kind of generator; the spec has no ego,
                the ego is absent, or the plans are of another shape, not finite or too large.
        """
        use_one_thread_after_fork()
        with torch.inference_mode():
            made = self._forecast(horizon_steps, num_samples, generator, ego_plan)
        # tensors made in inference mode are refused by autograd and cannot be written to
        own: Any = {f.name: None if (of := getattr(made, f.name)) is None else of.clone() for f in fields(Forecast)}
        return Forecast(**own)

    def _forecast(
        self,
        horizon_steps: int | None,
        num_samples: int,
        generator: Noise | None,
        ego_plan: Float[np.ndarray, "..."] | None,
    ) -> Forecast:
        if not self._beliefs:
            raise ProtocolError("forecast() needs an observation; call observe() first")
        steps = self.forecaster.horizon_steps if horizon_steps is None else horizon_steps
        agents = sum(belief.valid.shape[0] * belief.valid.shape[1] for belief in self._beliefs)
        check_request(steps, num_samples, agents * len(self._ego_axes))
        check_noise(generator)
        plans = None if ego_plan is None else self._local_plans(ego_plan, steps)
        if plans is not None:
            check_request(steps, num_samples, agents * len(self._ego_axes) * plans.shape[1])
        if len(self._beliefs) == 1:
            return self._forecast_part(self._beliefs[0], steps, num_samples, generator, plans)
        scenes = sum(len(belief.valid) for belief in self._beliefs)
        if isinstance(generator, Sequence) and len(generator) != scenes:
            raise UserError(
                f"samples need one generator per scene, got {len(generator)} generators for {scenes} scenes"
            )
        return _joined(
            [
                self._forecast_part(
                    belief,
                    steps,
                    num_samples,
                    generator[part] if isinstance(generator, Sequence) else generator,
                    None if plans is None else plans[part],
                )
                for belief, part in zip(self._beliefs, self._parts(scenes), strict=True)
            ]
        )

    def _forecast_part(
        self,
        belief: Belief,
        steps: int,
        num_samples: int,
        generator: Noise | None,
        plans: Float[Tensor, "batch plans horizon state"] | None,
    ) -> Forecast:
        """Forecasts one part of the latest scenes."""
        if plans is None:
            futures = self.forecaster.rollout(belief, steps, num_samples, generator)
            check_futures(futures, steps, num_samples, belief.states, self.forecaster.spec.position_dim)
        else:
            futures = rollout_plans(self.forecaster, belief, plans, num_samples, generator)
        check_scale(futures, self.forecaster)
        # float32 relative to the ego: the origin that observe() removed is the ego's own position on "ego" axes
        axes = self.forecaster.spec.position_dim
        ego_now = belief.states[:, None, :1, None, :axes] * float(self.forecaster.spec.has_ego)
        absent = ~belief.valid[:, None, :, None, None]
        if plans is not None:  # the axis of plans
            ego_now, absent = ego_now[:, None], absent[:, None]
        xy = (futures.states[..., :axes] - ego_now).masked_fill(absent, 0.0)
        finite = xy.isfinite().all()
        for rest in (futures.mode_probs, futures.scale):
            if rest is not None:
                shape = (*absent.shape[: absent.ndim - 2], *(1,) * (rest.ndim - absent.ndim + 2))
                finite = finite & (rest.isfinite() | absent.reshape(shape)).all()
        if not finite:
            raise UserError("the forecaster forecasts numbers that are not finite; its weights are damaged or diverged")
        missing = self._ids.shape[1] - belief.valid.shape[1]
        senders = belief.senders
        pairs = (0, 0, 0, missing if senders is None else 0, 0, missing)
        probs = functional.pad(belief.edge_probs, pairs)
        if missing:
            probs[..., 0] = 1 - probs[..., 1:].sum(-1)  # padded pairs have no edge, as other absent ones
        return Forecast(
            functional.pad(xy, (0, 0, 0, 0, 0, missing)),
            probs,
            functional.pad(belief.edge_features, pairs),
            functional.pad(belief.valid, (0, missing)),
            None if senders is None else functional.pad(senders, (0, 0, 0, missing), value=NO_AGENT),
            None
            if futures.mode_probs is None
            else functional.pad(futures.mode_probs, (0, missing), value=1 / num_samples),
            None if futures.scale is None else functional.pad(futures.scale, (0, 0, 0, 0, 0, missing)),
        )

    def _local_plans(
        self, ego_plan: Float[np.ndarray, "..."], horizon_steps: int
    ) -> Float[Tensor, "batch plans horizon state"]:
        """Returns plans in the axes of the beliefs' states; raises a `UserError` if they do not fit the scenes."""
        try:
            plans = np.array(ego_plan, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise UserError(f"ego_plan must be numbers: {error}") from error
        within = bool((np.abs(plans) <= LARGEST).all())
        there = torch.cat([belief.valid[:, 0] for belief in self._beliefs])
        check_plans(self.forecaster.spec, there, plans.shape, within, horizon_steps)
        plans[..., : self._origins.shape[-1]] -= self._origins[:, None, None]
        return torch.from_numpy(plans.astype(np.float32)).to(self.device)

    def _check(self, scenes: SceneBatch, envs: int) -> None:
        """Raises a `UserError` if a batch does not have the shape of what is observed."""
        check_batch(scenes, envs, self._ids.shape[1], self.forecaster.spec.num_features)

    def _parts(self, scenes: int) -> Iterator[slice]:
        """Yields the parts of a batch of scenes, each of at most `max_rows`; one even if there is no scene."""
        for start in range(0, max(1, scenes), self._max_rows):
            yield slice(start, min(start + self._max_rows, scenes))

    def _take(
        self, scenes: SceneBatch, old_ids: Int[np.ndarray, "envs agents"], memory: Memory
    ) -> tuple[Memory, Int[np.ndarray, "envs agents"]]:
        # Columns beyond the last agent of any scene cost nothing: pairs grow with the square of the columns.
        agents = 1 + int(np.flatnonzero(scenes.valid.any(axis=0)).max(initial=0))
        taken = [
            self._take_part(scenes[part], old_ids[part], memory.select(part), agents)
            for part in self._parts(len(scenes))
        ]
        self._beliefs = [part.belief for part in taken]
        self._origins = np.concatenate([part.origins for part in taken])
        return Memory.concatenate(*(part.memory for part in taken)), np.concatenate([part.ids for part in taken])

    def _take_part(
        self, scenes: SceneBatch, old_ids: Int[np.ndarray, "envs agents"], memory: Memory, agents: int
    ) -> "_Taken":
        """Observes scenes whose agents stand in the first `agents` columns."""
        valid = scenes.valid[:, :agents].copy()  # the simulator may write its next step into its array
        ids = np.where(scenes.valid, scenes.ids.astype(np.int64, copy=False), PADDING_ID)
        if agents < ids.shape[1] or not np.array_equal(old_ids, ids) or (ids[scenes.valid] < 0).any():
            check_ids(ids, scenes.valid)
            source, known = _match(old_ids, ids[:, :agents])
            memory = memory.reorder(torch.from_numpy(source).to(self.device), torch.from_numpy(known).to(self.device))
        # values in padding, not-a-number for example, must not reach any agent
        local = np.where(valid[..., None], scenes.states[:, :agents], 0.0)
        # float64 until the ego's position is subtracted: a scene 10 km down the road loses no precision
        local = local.astype(np.float64, copy=False)
        check_states(local)
        axes = len(self._ego_axes)
        if self._ego_axes.any() and (valid.any(axis=1) & ~valid[:, 0]).any():
            raise UserError(
                "a forecaster with the frame 'ego' needs the ego, agent 0, in every scene that has agents, but it is "
                "not valid; take a forecaster with another frame where there is no ego"
            )
        origins = local[:, 0, :axes] * self._ego_axes
        local[..., :axes] -= origins[:, None]
        local = np.where(valid[..., None], local, 0.0)
        check_resolution(local, self.forecaster.spec, "states of scenes")
        states = torch.from_numpy(local.astype(np.float32)).to(self.device)
        observed: Any = self.forecaster.observe(memory, states, torch.from_numpy(valid).to(self.device))
        check_observed(observed, states, self.forecaster)
        memory, belief = observed
        return _Taken(memory.padded(ids.shape[1]), ids, belief, origins)


class _Taken(NamedTuple):
    """Outcome of observing one part of the scenes."""

    memory: Memory
    ids: Int[np.ndarray, "envs agents"]
    belief: Belief
    origins: Float[np.ndarray, "envs axes"]


def _joined(forecasts: list[Forecast]) -> Forecast:
    """Returns the forecasts of all parts as one."""
    parts: dict[str, list[Tensor | None]] = {
        f.name: [getattr(one, f.name) for one in forecasts] for f in fields(Forecast)
    }
    joined: Any = {name: None if of[0] is None else torch.cat(of) for name, of in parts.items()}  # type: ignore[arg-type]
    return Forecast(**joined)


def _match(
    old_ids: Int[np.ndarray, "envs before"], new_ids: Int[np.ndarray, "envs agents"]
) -> tuple[Int[np.ndarray, "envs agents"], Bool[np.ndarray, "envs agents"]]:
    """Returns, for each place of each new scene, the previous place of its id, and whether there was one."""
    same = (new_ids[:, :, None] == old_ids[:, None, :]) & (new_ids[:, :, None] != PADDING_ID)
    return same.argmax(axis=2), same.any(axis=2)
