"""SB3's environments in processes that raise, hang or die."""

import multiprocessing
import time
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from envs.sb3 import workers
from envs.sb3.workers import WorkerVecEnv
from envs.supervision import EnvironmentFailedError, SupervisedEnv
from predictor.support.errors import UserError
from tests.envs.misbehaving import NUM_STEPS, env_id


class Make:
    """Makes a supervised environment of a kind; can be pickled."""

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def __call__(self) -> gym.Env:
        return SupervisedEnv(gym.make(env_id(self.kind), disable_env_checker=True), "toy-v0")


MESSAGES = {
    "Raise": r"^toy-v0, seed 3, step 2: RuntimeError: the simulator broke \(.*misbehaving.py, line \d+\)$",
    "Exit": r"^toy-v0, environment 1, seed 3, step 2: its process ended with status 3$",
    "Kill": r"^toy-v0, environment 1, seed 3, step 2: its process was killed by SIGKILL",
    "Hang": r"^toy-v0, environment 1, seed 3, step 2: no answer for 2 s; it hangs, or --timeout-s is too short$",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", MESSAGES)
def test_an_environment_that_misbehaves_is_named_and_the_others_end(kind: str, capfd: pytest.CaptureFixture[str]):
    venv = WorkerVecEnv([Make("Fine"), Make(kind)], "toy-v0", timeout_s=2.0)
    try:
        venv.seed(2)  # the second gets 3
        venv.reset()
        venv.step(np.zeros(2, dtype=np.int64))
        with pytest.raises(EnvironmentFailedError, match=MESSAGES[kind]):
            venv.step(np.zeros(2, dtype=np.int64))
    finally:
        began = time.monotonic()
        venv.close()
    assert time.monotonic() - began < 10.0
    assert not multiprocessing.active_children()
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_an_environment_that_cannot_be_made_is_named():
    with pytest.raises(EnvironmentFailedError, match=r"^toy-v0, before its first reset: NameNotFound: "):
        WorkerVecEnv([Make("Unknown")], "toy-v0")
    assert not multiprocessing.active_children()


class Quiet(Connection):
    """A pipe through which nothing comes, or only after some looks at it."""

    def __init__(self, looks: float = float("inf")) -> None:
        self._handle = None  # of no file
        self.left, self.waited = looks, list[float]()

    def poll(self, timeout_s: float = 0.0) -> bool:
        self.waited.append(timeout_s)
        self.left -= 1
        return self.left < 0


def test_an_answer_is_waited_for_in_steps_so_that_a_pause_costs_one_of_them():
    pipe = Quiet()
    assert not workers._comes(pipe, 2.5)
    assert pipe.waited == [1.0, 1.0, 0.5]
    assert workers._comes(Quiet(looks=1), 2.5) and not workers._comes(Quiet(looks=3), 2.5)


@pytest.mark.slow
def test_all_processes_together_get_the_time_to_close(monkeypatch: pytest.MonkeyPatch):
    """Each takes all the time that it gets."""
    venv, clock = WorkerVecEnv([Make("Fine")] * 3, "toy-v0"), [100.0]

    def slow(join: Any) -> Any:
        def joining(timeout_s: float | None = None) -> None:
            clock.append(clock[-1] + (timeout_s or 0.0))
            join()

        return joining

    for process in venv.processes:
        monkeypatch.setattr(process, "join", slow(process.join))
    monkeypatch.setattr(workers, "time", SimpleNamespace(monotonic=lambda: clock[-1]))
    venv.close()
    assert clock[:4] == [100.0, *[100.0 + workers.CLOSE_S] * 3]  # before they are killed
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_a_slip_of_the_caller_leaves_the_processes_in_order():
    makers, actions = [Make("Fine"), Make("Fine")], np.array([0, 1])
    worker, own = WorkerVecEnv(makers, "toy-v0"), DummyVecEnv(makers)
    for venv in (worker, own):
        venv.seed(1)
        venv.reset()
    with pytest.raises(UserError, match="a step needs one action for each of 2 envs, got 1"):
        worker.step(actions[:1])
    with pytest.raises(AttributeError, match="the environments have no attribute 'nothing'"):
        worker.get_attr("nothing")
    np.testing.assert_array_equal(worker.step(actions)[0], own.step(actions)[0])
    assert worker.get_attr("render_mode") == own.get_attr("render_mode")
    worker.close()


@pytest.mark.slow
def test_episodes_are_those_of_one_process():
    """A second episode of a seed and its reset by SB3, too."""
    makers = [Make("Fine"), Make("Raise")]
    actions = np.array([0, 1])
    seen = []
    for venv in (WorkerVecEnv(makers, "toy-v0"), DummyVecEnv(makers)):
        venv.seed(1)  # neither 1 nor 2 misbehaves
        found = [venv.reset(), *(venv.step(actions) for _ in range(NUM_STEPS + 2))]
        seen.append(found)
        venv.close()
        venv.close()
    np.testing.assert_array_equal(seen[0][0], seen[1][0])
    for worker, own in zip(seen[0][1:], seen[1][1:], strict=True):
        for first, second in zip(worker[:3], own[:3], strict=True):
            np.testing.assert_array_equal(first, second)
