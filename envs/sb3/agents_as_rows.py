"""One policy for all agents: copies of a PettingZoo parallel environment as an SB3 VecEnv with an env for each learner.

Unequal spaces are padded to the largest, and agents may die and join mid-episode. All copies run in this process. For
forecasts wrap the copies in `ForecastParallelEnv`: they then share one batched forward per step.

>>> from mpe2 import simple_tag_v3
>>> from stable_baselines3 import PPO
>>> venv = AgentMonitor(ParallelVecEnv([simple_tag_v3.parallel_env] * 4))
>>> venv.num_envs  # 4 copies of 3 adversaries and 1 prey
16
>>> model = PPO("MlpPolicy", venv)
"""

import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from envs.batched_forward import collected
from envs.parallel import batch_forwards, living
from envs.sb3.copies import with_notes, without_notes
from envs.sb3.padded_spaces import PaddedObservation, own_action, roles_of, shared_action
from envs.sb3.partners import Partner, chosen_partner
from envs.seeding import driver_rng
from predictor.support.errors import ProtocolError, UserError, short


class ParallelVecEnv(VecEnv):
    """Makes each learner of each copy of a PettingZoo environment one env of an SB3 VecEnv.

    Its envs are ordered by copy, then by agent. **Spaces** that differ are padded: Box observations (also within a
    Dict) with zeros at the end of each axis; Discrete actions to the largest n, an action beyond the agent's own n
    counting as its last; 1-D Box actions to the longest, cut and clipped to the agent's own bounds.

    **Episodes.** A copy is reset at the step that leaves it without living agents, or without a living learner once
    every learner has lived. When an agent dies, its env reports done=True with its last observation as
    `terminal_observation`, and `TimeLimit.truncated` if it was truncated (or dropped) and not terminated. Until its
    next life the env waits: zero observation (a Discrete entry: its first value), reward 0, action ignored,
    `info["alive"]` False. An agent that is absent at the reset waits in the same way until it joins. Each wait is
    an episode of its own, closed by done=True when the agent joins or the copy resets: so neither advantages nor
    recurrent states cross between lives, and the value of waiting is 0. SB3 does train on waits; their only effect is
    to dilute a batch and its normalisation of advantages.

    **Statistics.** VecMonitor counts each wait as an episode of return 0; `AgentMonitor` counts lives only. To drop
    waits from your own statistics, keep the transitions whose `info["alive"]` is True.

    Args:
        factories: functions that make one copy each.
        agents: names of the learners; None takes all possible agents.
        partner: driver of the agents that do not learn; a callable or a name of `PARTNERS`.
        agent_indicator: whether to append the one-hot of the agent's role to the 1-D observation (of a Dict, to its
            entry "observation"); zero while the env waits. None appends it if spaces are unequal and there is such a
            vector.

    Attributes:
        envs: copies of the PettingZoo environment, fewer than the VecEnv's `num_envs`.
        agents_of_envs: name of the agent of each env of the VecEnv.
        copies_of_envs: index of the copy of each env of the VecEnv.
        roles_of_envs: number of the role of each env of the VecEnv; agents have equal roles if their names differ in
            their number only and their spaces are equal.

    Raises:
        UserError: no copies, copies that differ, unknown agents, no partner where one is needed, or spaces that
            cannot be padded.
    """

    def __init__(
        self,
        factories: Sequence[Callable[[], ParallelEnv]],
        *,
        agents: Sequence[str] | None = None,
        partner: Partner | str | None = None,
        agent_indicator: bool | None = None,
    ) -> None:
        """Makes the copies and finds spaces that hold those of all learners."""
        self.envs = _make_copies(factories)
        self._forward = batch_forwards(self.envs)
        names = _choose_learners(self.envs[0].possible_agents, agents)
        drive = chosen_partner(self.envs[0].possible_agents, names, partner)
        self._copies = [_Copy(env, names, drive, self._forward is not None) for env in self.envs]
        observations = {name: self.envs[0].observation_space(name) for name in names}
        actions = {name: self.envs[0].action_space(name) for name in names}
        roles = roles_of(observations, actions)
        self._observation = PaddedObservation(observations, roles, agent_indicator)
        self._own_actions = actions
        self.agents_of_envs = names * len(self.envs)
        self.copies_of_envs = [copy for copy in range(len(self.envs)) for _ in names]
        self.roles_of_envs = [roles[name] for name in self.agents_of_envs]
        self._actions: NDArray[Any] | None = None
        super().__init__(len(self.agents_of_envs), self._observation.space, shared_action(actions))
        self.metadata = {**getattr(self.envs[0], "metadata", {}), **self.metadata}

    def seed(self, seed: int | Sequence[int] | None = None) -> Sequence[int | None]:
        """Seeds copy i with seed + i, or seed[i], at the next reset; later episodes go on from its own generator.

        Until it is called, the sampled futures of all copies have equal noise.

        Raises:
            UserError: a seed that is no whole number from 0 on, or another number of seeds than of copies.
        """
        copies = len(self._copies)
        given = np.asarray(np.random.default_rng().integers(2**31) if seed is None else seed)
        if given.dtype.kind not in "iu" or given.shape not in ((), (copies,)) or (given < 0).any():
            wanted = f"a whole number from 0 on, or one for each of {copies} copies"
            raise UserError(f"seed needs {wanted}, got {short(seed)}")
        own = given if given.ndim else given + np.arange(copies)
        self._seeds = [int(own[copy]) for copy in self.copies_of_envs]
        return self._seeds

    def reset(self) -> VecEnvObs:
        """Resets all copies."""
        with collected(self._forward):
            for i, copy in enumerate(self._copies):
                first = i * len(copy.learners)
                self._keep_infos(first, copy, copy.reset(self._seeds[first], self._options[first]))
        self._reset_seeds()
        self._reset_options()
        self._actions = None
        return self._observe()

    def step_async(self, actions: np.ndarray) -> None:
        """Takes one action per env, in the padded space."""
        if any(copy.living is None for copy in self._copies):
            raise ProtocolError("there is no episode to step; call reset() first")
        if len(actions) != self.num_envs:
            raise UserError(f"step needs one action per env ({self.num_envs}), got {len(actions)}")
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Steps all copies; resets those whose episode ended."""
        if self._actions is None:
            raise ProtocolError("step_wait() needs actions; call step_async() first")
        actions, self._actions = self._actions, None
        turns: list[_Turn] = []
        with collected(self._forward):
            for copy in self._copies:
                first = len(turns)
                own = {
                    agent: own_action(actions[first + i], self._own_actions[agent])
                    for i, agent in enumerate(copy.learners)
                    if copy.lives(agent)
                }
                turns += copy.step(own)
                if copy.ended:
                    self._keep_infos(first, copy, copy.reset())
        rewards = np.array([turn.reward for turn in turns], dtype=np.float32)
        dones = np.array([turn.done for turn in turns], dtype=np.bool_)
        infos = [self._info(agent, turn) for agent, turn in zip(self.agents_of_envs, turns, strict=True)]
        return self._observe(), rewards, dones, infos

    def close(self) -> None:
        """Closes all copies."""
        for env in self.envs:
            env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns one frame per copy."""
        return [env.render() for env in self.envs]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Returns the attribute of each env's copy; None for a copy without `render_mode`."""
        default = (None,) if attr_name == "render_mode" else ()
        return [getattr(self.envs[copy], attr_name, *default) for copy in self._copies_of(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets the attribute on the copies of these envs."""
        for copy in self._copies_of(indices):
            setattr(self.envs[copy], attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Calls the method once per copy of these envs; returns each env's result, which is its copy's."""
        copies = self._copies_of(indices)
        results = {
            copy: getattr(self.envs[copy], method_name)(*method_args, **kwargs) for copy in dict.fromkeys(copies)
        }
        return [results[copy] for copy in copies]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Returns whether each env's copy is wrapped in this class."""
        return [_is_wrapped(self.envs[copy], wrapper_class) for copy in self._copies_of(indices)]

    def _copies_of(self, indices: VecEnvIndices) -> list[int]:
        return [self.copies_of_envs[env] for env in self._get_indices(indices)]

    def _keep_infos(self, first: int, copy: "_Copy", infos: Mapping[str, Any]) -> None:
        """Keeps the infos that the reset of a copy returned for its learners; `first` is the copy's first env."""
        for i, agent in enumerate(copy.learners):
            self.reset_infos[first + i] = {**infos.get(agent, {}), "alive": copy.lives(agent)}

    def _observe(self) -> VecEnvObs:
        """Returns the observation of each env."""
        seen = [(copy.living or {}).get(agent) for copy in self._copies for agent in copy.learners]
        return self._observation.stack(list(zip(self.agents_of_envs, seen, strict=True)))

    def _info(self, agent: str, turn: "_Turn") -> dict[str, Any]:
        info = {**turn.info, "alive": turn.alive, "TimeLimit.truncated": turn.truncated}
        if turn.done:
            info["terminal_observation"] = self._observation.one(agent, turn.closing)
        return info


class AgentMonitor(VecMonitor):
    """VecMonitor that counts lives: an env's wait adds nothing to lengths and is no episode.

    It takes VecMonitor's arguments, and `evaluate_policy` uses its counts.
    """

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state of a copy or a pickle."""
        return without_notes(vars(self))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a copy or a pickle."""
        self.__dict__.update(with_notes(type(self), state))

    def step_wait(self) -> VecEnvStepReturn:
        """Steps; each life that ended gets `info["episode"]` with its return r, length l and time t [s]."""
        obs, rewards, dones, step_infos = self.venv.step_wait()
        infos = list(step_infos)
        alive = np.array([info.get("alive", True) for info in infos], dtype=np.bool_)
        self.episode_returns += rewards * alive
        self.episode_lengths += alive
        for env in np.flatnonzero(dones & alive):
            episode = {"r": float(self.episode_returns[env]), "l": int(self.episode_lengths[env])}
            episode["t"] = round(time.time() - self.t_start, 6)
            episode.update({key: infos[env][key] for key in self.info_keywords})
            infos[env] = {**infos[env], "episode": episode}
            self.episode_count += 1
            self.episode_returns[env], self.episode_lengths[env] = 0, 0
            if self.results_writer:
                self.results_writer.write_row(episode)
        return obs, rewards, dones, infos


@dataclass
class _Turn:
    """Outcome of one step for one learner."""

    alive: bool = False
    """Whether the agent lived and acted."""
    reward: float = 0.0
    """Reward of the agent; 0 while it waits."""
    done: bool = False
    """Whether a life or a wait ended."""
    truncated: bool = False
    """Whether the life ended, but not by termination."""
    closing: Any = None
    """Last observation of the life that ended; None at the end of a wait."""
    info: dict[str, Any] = field(default_factory=dict)
    """Info of the agent from the environment."""


class _Copy:
    """One copy of the environment, with the latest observations of the living agents and the partner's generator."""

    def __init__(self, env: ParallelEnv, learners: list[str], partner: Partner | None, filled_later: bool) -> None:
        self.env, self.learners, self.partner, self._filled_later = env, learners, partner, filled_later
        self.living: dict[str, Any] | None = None
        self._lived: set[str] = set()
        self._generator = np.random.default_rng()

    @property
    def ended(self) -> bool:
        """Whether the episode is over: no agent lives, or no learner does after all learners have lived."""
        return not self.living or (self._lived.issuperset(self.learners) and not any(map(self.lives, self.learners)))

    def lives(self, agent: str) -> bool:
        return agent in (self.living or {})

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Mapping[str, Any]:
        if seed is not None:
            self._generator = driver_rng(seed)
        observations, infos = self.env.reset(seed=seed, options=options or None)
        self._lived = set()
        self._enter(self.env.agents, observations)
        if not self.living:
            raise UserError("an episode needs agents, but reset() left env.agents empty; check the environment")
        return infos

    def step(self, actions: dict[str, Any]) -> list[_Turn]:
        """Steps the environment with actions of all living agents; returns one turn per learner."""
        before = self.living or {}
        others = {agent: seen for agent, seen in before.items() if agent not in self.learners}
        observations, rewards, terminated, truncated, infos = self.env.step({**actions, **self._act_for(others)})
        self._enter(living(self.env, terminated, truncated), observations)
        turns = []
        for agent in self.learners:
            lives = self.lives(agent)
            if agent not in before:
                turns.append(_Turn(done=lives or self.ended))
                continue
            turn = _Turn(True, float(rewards.get(agent, 0.0)), not lives, info=dict(infos.get(agent, {})))
            if turn.done:
                turn.truncated = not terminated.get(agent, False)
                last = observations.get(agent, before[agent])
                turn.closing = deepcopy(last)  # a reset may write into it
                if self._filled_later:  # the forecasts of all copies are put into the wrapper's own dict
                    last.update(turn.closing)
                    turn.closing = last
            turns.append(turn)
        return turns

    def _enter(self, names: Sequence[str], observations: Mapping[str, Any]) -> None:
        """Sets the living agents and their observations."""
        if unknown := [agent for agent in names if agent not in self.env.possible_agents]:
            raise UserError(f"every agent must be one of possible_agents, but {unknown} are not; add them there")
        if blind := [agent for agent in names if agent not in observations]:
            raise UserError(f"every living agent needs an observation, the environment gave none for {blind}")
        self.living = {agent: observations[agent] for agent in names}
        self._lived.update(names)

    def _act_for(self, others: dict[str, Any]) -> dict[str, Any]:
        if not others or self.partner is None:
            return {}
        chosen = self.partner(self.env, others, self._generator)
        if missing := [agent for agent in others if agent not in chosen]:
            raise UserError(f"partner must act for {list(others)}, but gave no action for {missing}")
        return {agent: chosen[agent] for agent in others}


def _make_copies(factories: Sequence[Callable[[], ParallelEnv]]) -> list[ParallelEnv]:
    """Makes distinct environments with equal agents and spaces."""
    if not isinstance(factories, Sequence) or not all(map(callable, factories)):
        raise UserError(f"ParallelVecEnv takes a list of functions that make a copy each, got {short(factories, 100)}")
    envs = [factory() for factory in factories]
    if not envs:
        raise UserError("at least one factory is needed, got none")
    for i, env in enumerate(envs):
        if not isinstance(env, ParallelEnv):
            raise UserError(
                f"factory {i} must make a PettingZoo ParallelEnv, it made {type(env).__name__}; "
                "pettingzoo.utils.aec_to_parallel converts an AECEnv"
            )
        if not getattr(env, "possible_agents", None):
            raise UserError(f"every copy must name all agents that may appear, but copy {i} has no possible_agents")
        if list(env.possible_agents) != list(envs[0].possible_agents):
            raise UserError(
                f"copies must have the same possible_agents; copy 0 has {envs[0].possible_agents}, "
                f"copy {i} has {env.possible_agents}"
            )
        for agent in env.possible_agents:
            for kind in ("observation_space", "action_space"):
                spaces = [getattr(copy, kind)(agent) for copy in (envs[0], env)]
                if spaces[0] != spaces[1]:
                    raise UserError(f"copies must have the same {kind}s; '{agent}' has {spaces[0]} and {spaces[1]}")
    if len({id(env.unwrapped) for env in envs}) < len(envs):
        raise UserError("each factory must make an environment of its own, but one was returned twice")
    return envs


def _choose_learners(possible: Sequence[str], agents: Sequence[str] | None) -> list[str]:
    names = list(possible if agents is None else agents)
    unknown = [name for name in names if name not in possible]
    if unknown or not names or len(set(names)) < len(names):
        raise UserError(f"agents must name some of {list(possible)}, each once; got {names}")
    return names


def _is_wrapped(env: Any, wrapper_class: type[Any]) -> bool:
    while env is not None and not isinstance(env, wrapper_class):
        env = vars(env).get("env")
    return env is not None
