"""SB3's environments in processes, where one that raises, hangs or dies ends in one sentence and no process is left.

`SubprocVecEnv` prints the worker's traceback and raises EOFError here, waits forever for an environment that hangs, and
leaves its processes if this one is killed.
"""

import math
import multiprocessing
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper, VecEnvIndices
from stable_baselines3.common.vec_env.subproc_vec_env import _worker

from envs.supervision import NUMBERS, TIMEOUT_S, EnvironmentFailedError, Place, failure, share
from predictor.support.errors import UserError, reason_of
from predictor.support.processes import end, follow_parent, how_it_ended, start

CLOSE_S = 5.0
"""Time that an environment gets to close [s]."""


class WorkerVecEnv(SubprocVecEnv):
    """Runs each environment in a spawned process, which ends with this one.

    Each environment is best in a `SupervisedEnv`, so that its seed and step are known.

    Args:
        env_fns: functions that make one environment each.
        env_id: id in messages.
        timeout_s: largest time that a reset or a step may take [s].

    Raises:
        EnvironmentFailedError: an environment cannot be made; as every method, if one raised, hangs or died.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]], env_id: str, timeout_s: float = TIMEOUT_S) -> None:
        """Starts the processes."""
        self.waiting, self.closed = False, False
        context = multiprocessing.get_context("spawn")
        self.processes: list[Any] = []
        self.remotes: Any = ()
        try:
            for number, make in enumerate(env_fns):
                ours, theirs = context.Pipe()
                numbers: Any = context.RawArray("q", NUMBERS)
                wrapped = CloudpickleWrapper(make)
                process = context.Process(target=_work, args=(theirs, ours, wrapped, env_id, numbers), daemon=True)
                start(process)
                theirs.close()
                name = f"{env_id}, environment {number}"
                self.processes.append(process)
                self.remotes += (_WatchedRemote(ours, process, Place(numbers), name, timeout_s),)
            self.remotes[0].send(("get_spaces", None))
            observation_space, action_space = self.remotes[0].recv()
        except BaseException:
            self.close()
            raise
        VecEnv.__init__(self, len(env_fns), observation_space, action_space)

    def step_async(self, actions: np.ndarray) -> None:
        """Sends each process its action.

        Raises:
            UserError: not one action for each environment; nothing is sent then.
        """
        if len(actions) != self.num_envs:
            raise UserError(f"a step needs one action for each of {self.num_envs} envs, got {len(actions)}")
        super().step_async(actions)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Returns an attribute of environments.

        Raises:
            AttributeError: one of all environments does not have it; the processes go on.
        """
        if not self.has_attr(attr_name):
            raise AttributeError(f"the environments have no attribute '{attr_name}'")
        return super().get_attr(attr_name, indices)

    def close(self) -> None:
        """Ends the processes; those whose environments are in order close them first."""
        if self.closed:
            return
        self.closed = True
        in_order = not self.waiting and all(remote.is_in_order for remote in self.remotes)
        if in_order and all(remote.send_if_possible(("close", None)) for remote in self.remotes):
            deadline_s = time.monotonic() + CLOSE_S
            try:
                for process in self.processes:
                    process.join(max(deadline_s - time.monotonic(), 0.0))
            finally:
                end(self.processes)
        else:
            end(self.processes)
        for remote in self.remotes:
            remote.close()


class _Failure:
    """What a worker sends in place of an answer when its environment raised."""

    def __init__(self, text: str) -> None:
        self.text = text


class _WatchedRemote:
    """End of a worker's pipe that raises one sentence if no answer comes.

    Attributes:
        is_in_order: whether all answers have come so far.
    """

    def __init__(self, pipe: Connection, process: Any, place: Place, name: str, timeout_s: float) -> None:
        self._pipe, self._process, self._place, self._name = pipe, process, place, name
        self._timeout_s, self._has_answered = timeout_s, False
        self.is_in_order = True

    def send(self, content: Any) -> None:
        if not self.send_if_possible(content):
            self.recv()  # raises what ended the worker

    def send_if_possible(self, content: Any) -> bool:
        try:
            self._pipe.send(content)
        except OSError:
            return False
        return True

    def recv(self) -> Any:
        in_order, self.is_in_order = self.is_in_order, False
        patience_s = self._timeout_s if self._has_answered else max(self._timeout_s, TIMEOUT_S)
        try:
            if not _comes(self._pipe, patience_s):
                hint = "it hangs, or --timeout-s is too short"
                raise EnvironmentFailedError(f"{self._where()}: no answer for {patience_s:g} s; {hint}")
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            self._process.join(CLOSE_S)
            end([self._process])  # a thread of the environment may keep it alive
            raise EnvironmentFailedError(f"{self._where()}: {how_it_ended(self._process.exitcode)}") from error
        if isinstance(answer, _Failure):
            raise EnvironmentFailedError(answer.text)
        self.is_in_order, self._has_answered = in_order, True
        return answer

    def close(self) -> None:
        self._pipe.close()

    def _where(self) -> str:
        return f"{self._name}, {self._place}"


def _comes(pipe: Connection, patience_s: float) -> bool:
    """Returns whether an answer comes in time; a pause of the whole command counts for a second at most."""
    waits = math.ceil(patience_s)
    return any(pipe.poll(min(1.0, patience_s - second)) for second in range(waits))


def _work(remote: Connection, parent_remote: Connection, make: Any, env_id: str, numbers: Any) -> None:
    """Serves an environment as SB3 does; says why, in place of an answer, if it raises."""
    follow_parent()
    place = share(numbers)
    try:
        _worker(remote, parent_remote, make)
    except EnvironmentFailedError as error:
        _send(remote, str(error))
    except Exception as error:
        _send(remote, failure(env_id, place, reason_of(error)))


def _send(remote: Connection, text: str) -> None:
    try:
        remote.send(_Failure(text))
    except OSError:
        return  # nobody listens any more
