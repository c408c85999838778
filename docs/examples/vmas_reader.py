"""VMAS 1.5.2: one copy of a scenario as a PettingZoo environment, who is there, and a driver of our own.

pip install vmas==1.5.2
"""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import vmas
from pettingzoo import ParallelEnv

from dgvae_rl import MultiagentScene, Scene, SceneSpec, pad_multiagent_scene, register_reader

DT_S = 0.1


class VmasEnv(ParallelEnv):
    """One copy of a VMAS scenario: arrays in place of batches of tensors."""

    metadata = {"name": "vmas", "render_modes": []}

    def __init__(self, scenario: str = "navigation", max_steps: int = 100, **kwargs: Any) -> None:
        """Make the scenario."""
        self.metadata = {**self.metadata, "name": f"vmas_{scenario}"}
        options = {"dict_spaces": True, "terminated_truncated": True, "max_steps": max_steps, **kwargs}
        self.vmas = vmas.make_env(scenario, num_envs=1, **options)
        self.possible_agents, self.agents = [agent.name for agent in self.vmas.agents], []
        self._seen, self._pushes = (_spaces(s) for s in (self.vmas.observation_space, self.vmas.action_space))

    def observation_space(self, agent: str) -> gym.Space:
        """VMAS's own space of the agent, which is one of gym, as one of gymnasium."""
        return self._seen[agent]

    def action_space(self, agent: str) -> gym.Space:
        """The same of its actions."""
        return self._pushes[agent]

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict, dict]:
        """Begin an episode."""
        if seed is not None:
            self.vmas.seed(seed)
        self.agents = list(self.possible_agents)
        return self._arrays(self.vmas.reset()), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """Let all agents act."""
        pushes = {agent: torch.as_tensor(np.asarray(push))[None] for agent, push in actions.items()}
        seen, rewards, *ends, _ = self.vmas.step(pushes)  # at the goals, at the limit of steps
        ended, over = (dict.fromkeys(self.agents, bool(end[0])) for end in ends)
        infos: dict[str, dict] = {agent: {} for agent in self.agents}
        self.agents = [] if any(end[0] for end in ends) else self.agents
        return self._arrays(seen), {a: float(r[0]) for a, r in rewards.items()}, ended, over, infos

    def _arrays(self, seen: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
        return {agent: rows[0].numpy().astype(np.float32) for agent, rows in seen.items()}


def _spaces(of_gym: Any) -> dict[str, gym.Space]:
    return {agent: gym.spaces.Box(s.low, s.high, dtype=np.float32) for agent, s in of_gym.items()}


class VmasReader:
    """All agents in their order; each looks where it moves."""

    def __init__(self, env: Any) -> None:
        """Say what a scene holds."""
        count = len(env.possible_agents)
        self.spec = SceneSpec(
            dt_s=DT_S, feature_scales=(1.0, 1.0, 0.5, 0.5), has_ego=False, perception_m=3.0, max_agents=count
        )

    def reset(self) -> None:
        """Forget nothing: agents keep their places in the list."""

    def read(self, env: Any) -> MultiagentScene:
        """Return all agents."""
        bodies = env.unwrapped.vmas.agents
        states = np.array([[*body.state.pos[0].tolist(), *body.state.vel[0].tolist()] for body in bodies])
        scene = Scene(states, np.arange(len(bodies)), np.ones(len(bodies), dtype=bool))
        index_of = {body.name: i for i, body in enumerate(bodies)}
        return pad_multiagent_scene(scene, index_of, np.arctan2(states[:, 3], states[:, 2]), self.spec)


register_reader(VmasEnv, VmasReader)


def make_navigation(**kwargs: Any) -> VmasEnv:
    """Makes the environment, for commands: --env-id vmas_reader:make_navigation."""
    return VmasEnv("navigation", **kwargs)


def to_goals(env: Any, rng: np.random.Generator) -> Callable[[dict], dict]:
    """A driver: each agent steers to its goal in its own haste, for --driver own:vmas_reader:to_goals."""
    bodies = {body.name: body for body in env.unwrapped.vmas.agents}
    haste = {name: rng.uniform(0.5, 3.0) for name in bodies}

    def act(observations: dict) -> dict:
        pushes = {}
        for name in observations:
            state = bodies[name].state
            wish = haste[name] * (bodies[name].goal.state.pos - state.pos) - state.vel
            pushes[name] = np.clip(wish[0].numpy() + rng.normal(0.0, 0.1, 2), -1.0, 1.0).astype(np.float32)
        return pushes

    return act
