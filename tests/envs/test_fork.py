import subprocess
import sys

import pytest

WORKERS = """
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
from envs.wrappers import ForecastObservation

torch.set_num_threads(2)
torch.randn(600, 600) @ torch.randn(600, 600)  # the parent's OpenMP threads exist now
torch.nn.functional.elu(torch.randn(2_000_000))
venv = make_vec_env(
    "merge-v1", 2, seed=0, wrapper_class=ForecastObservation, vec_env_cls=SubprocVecEnv,
    vec_env_kwargs={"start_method": "fork"},
)
print(venv.reset()["forecast"].shape)
venv.close()
"""

USED_IN_A_CHILD = """
import os, sys, torch
from envs.wrappers import ForecastObservation
from envs.registry import make_env

torch.set_num_threads(3)
torch.nn.functional.elu(torch.randn(2_000_000))
env = ForecastObservation(make_env("merge-v1"))
env.reset(seed=0)
if child := os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
env.step(1)  # made in the parent, used in the child
torch.nn.functional.elu(torch.randn(2_000_000))
os._exit(0 if torch.get_num_threads() == 1 else 5)
"""

IMPORTED_ONLY = """
import os, sys, torch
registered = []
register = os.register_at_fork
def note(**hooks):
    registered.append(sys._getframe(1).f_globals["__name__"])
    register(**hooks)
os.register_at_fork = note
import envs.observation, envs.wrappers, envs.vector, envs.parallel, envs.multiagent_observation, envs.sb3.forecast
assert not [name for name in registered if name.split(".")[0] in ("envs", "predictor", "agents")], registered

torch.set_num_threads(3)
if child := os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
os._exit(0 if torch.get_num_threads() == 3 else 5)
"""


def run(script: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=90)


@pytest.mark.slow
def test_forecasters_run_in_forked_workers_of_a_threaded_parent():
    """Otherwise the workers wait for OpenMP threads that the fork did not bring along."""
    done = run(WORKERS)
    assert done.returncode == 0, done.stderr
    assert "(2, 11, 5, 2)" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("script", [USED_IN_A_CHILD, IMPORTED_ONLY], ids=["first use limits", "import leaves alone"])
def test_threads_of_a_forked_child_are_limited_at_the_first_forecast_and_not_by_an_import(script: str):
    done = run(script)
    assert done.returncode == 0, done.stderr
