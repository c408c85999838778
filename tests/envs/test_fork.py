import subprocess
import sys

SCRIPT = """
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


def test_forecasters_run_in_forked_workers_of_a_threaded_parent():
    """Without the fork hook the workers wait for OpenMP threads that the fork did not bring along."""
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=90)
    assert done.returncode == 0, done.stderr
    assert "(2, 11, 5, 2)" in done.stdout
