"""True futures of environments with several learners: plays a copy in which each of them repeats its last action.

What `envs.plans.playing` does for the plans of one ego. What the learners will do is not known; what the others do, if
the learners keep on, is played exactly.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from envs.plans.playing import followed
from envs.readers.base import MultiagentReader
from envs.simulators.copies import RunningCopy, running_copy
from envs.simulators.interventions import simulator_of
from predictor.scene import Scene


class CopyableParallelEnv(RunningCopy, BaseParallelWrapper):
    """Wrapper whose copies go on exactly."""


def all_keeping_on(
    env: ParallelEnv,
    reader: MultiagentReader,
    scene: Scene,
    observations: Mapping[str, Any],
    last_actions: Mapping[str, Any],
    horizon_steps: int,
) -> Float[np.ndarray, "agents horizon 2"]:
    """Returns where all agents of a scene go if every learner repeats its last action [m], world frame.

    Agents for which the environment has a driver (`drive_others`) do what it then decides. While one of the living has
    not acted yet (at the start of an episode, or when one joins), all go on at their velocities; an agent that leaves
    goes on at its last one.

    Args:
        env: the environment, which is not changed.
        reader: its reader, which is not changed.
        scene: scene that the reader has just read.
        observations: latest observation of each living agent.
        last_actions: latest action of each agent.
        horizon_steps: number of steps to play.

    Raises:
        UserError: the environment cannot be copied.
    """
    copied: Any = CopyableParallelEnv(env)
    copied, reader = running_copy((copied, reader), simulator_of(env))
    drive_others = getattr(copied, "drive_others", _nobody)

    def moments(seen: Mapping[str, Any]) -> Iterator[Scene | None]:
        for _ in range(horizon_steps):
            if not copied.agents or not last_actions.keys() >= set(copied.agents):
                yield None
                continue
            kept = {agent: last_actions[agent] for agent in copied.agents}
            seen, *_ = copied.step(kept | drive_others(seen))
            yield reader.read(copied).scene

    return followed(scene, reader.spec.dt_s, moments(observations))


def _nobody(observations: Mapping[str, Any]) -> dict[str, Any]:
    return {}
