"""A user's own `envs/`, `agents/`, `predictor/` hide nothing of ours, and we hide nothing of theirs."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
THEIRS = {
    "envs/__init__.py": "from envs.wrappers import Mine\n",
    "envs/wrappers.py": "class Mine: ...\n",  # these are called as some of ours, which import each other
    "envs/registry.py": "class Mine: ...\n",
    "envs/arms.py": "class Mine: ...\n",
    "agents/__init__.py": "MINE = 'theirs'\n",
}
OURS = """
from dgvae_rl import ForecastObservation, SceneObservation, VectorForecast, make_env, make_multiagent_env, UserError
import dgvae_rl.envs.wrappers
assert dgvae_rl.envs.wrappers.ForecastObservation is ForecastObservation
"""


def run(code: str, folder: Path) -> str:
    """Runs code in a process whose working folder is `folder`, with this tree behind it on the search path."""
    script = folder / "script.py"
    script.write_text(code)
    done = subprocess.run(
        [sys.executable, str(script)], cwd=folder, env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for name, text in THEIRS.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_without_the_package_a_users_folder_hides_ours(project: Path):
    """What there is to protect against; if Python ever changes this, all here can go."""
    code = "try:\n    from envs import ForecastObservation\nexcept ImportError:\n    print('hidden')\n"
    assert run(code, project) == "hidden\n"


@pytest.mark.slow
@pytest.mark.parametrize("first", ["theirs", "ours"])
def test_both_are_there_whoever_is_imported_first(project: Path, first: str):
    theirs = "import envs, agents\nfrom envs.wrappers import Mine\nassert agents.MINE == 'theirs'\n"
    before, after = (theirs, OURS) if first == "theirs" else (OURS, theirs)
    code = f"""
{before}
env = ForecastObservation(make_env("highway-fast-v0", config={{"vehicles_count": 5}}), "highway")
print(env.reset(seed=0)[0]["forecast"].shape)
{after}
assert envs.wrappers.Mine is envs.Mine and not hasattr(envs, "ForecastObservation")
from dgvae_rl.predictor.scene import SceneSpec
try:
    SceneSpec(dt_s=-1)
except UserError as error:
    print(error)
"""
    code = code if first == "ours" else f"{OURS}\n{code}"
    assert run(code, project) == "(11, 5, 2)\ndt_s must be positive, got -1\n"


@pytest.mark.slow
def test_what_the_user_does_not_have_leads_to_ours(project: Path):
    """Trained policies name the classes of their networks, `agents.features` for example."""
    code = """
import dgvae_rl.agents.features, dgvae_rl.predictor
import agents.features, envs.readers, predictor
assert agents.MINE == "theirs"
assert agents.features is dgvae_rl.agents.features and predictor is dgvae_rl.predictor
assert envs.readers.__name__ == "dgvae_rl.envs.readers"
"""
    run(code, project)


def test_policies_load_beside_a_users_modules_of_the_same_names(project: Path):
    """Their pickles name our classes as a checkout does; the user's modules are as they were afterwards."""
    for name in ("features", "plan_scores"):
        (project / "agents" / f"{name}.py").write_text("MINE = 'theirs'\n")
    code = """
import sys
import agents.features, envs
from dgvae_rl import load_policy
theirs = sys.modules["agents.features"]
policy, env = load_policy("roundabout")
assert sys.modules["agents.features"] is theirs
print(policy(env.reset(seed=0)[0]), agents.features.MINE)
import agents.plan_scores, envs.wrappers
print(agents.plan_scores.MINE, agents.MINE, envs.wrappers.Mine is envs.Mine)
"""
    first, second = run(code, project).splitlines()
    assert first.split()[1] == "theirs" and second == "theirs theirs True"


@pytest.mark.slow
def test_names_of_modules_in_strings_lead_to_ours(project: Path):
    """PettingZoo factories, ids that are registered with gymnasium, lazy exports."""
    code = f"""
{OURS}
import gymnasium as gym
env = make_multiagent_env("intersection-multi-agent-v2")
print(type(env).__module__)
from dgvae_rl import ForecastParallelEnv
ForecastParallelEnv(env).reset(seed=0)
print(type(make_env("highway-mixed-v0").unwrapped).__module__)
from dgvae_rl.envs.sb3.forecast import VecForecast
from dgvae_rl.envs.simulators.envpool import register_envpool_ids
register_envpool_ids()
print(gym.spec("envpool/HighwayFast-v0").entry_point)
"""
    assert run(code, project).split() == [
        "dgvae_rl.envs.simulators.highway_multiagent",
        "dgvae_rl.envs.simulators.mixed_traffic",
        "dgvae_rl.envs.simulators.envpool:EnvPoolEnv",
    ]


@pytest.mark.slow
def test_processes_and_pickles_find_ours(project: Path):
    code = f"""
{OURS}
import pickle
from functools import partial
from stable_baselines3.common.vec_env import SubprocVecEnv
from dgvae_rl import VecForecast
import envs

def make():
    return SceneObservation(make_env("highway-fast-v0", config={{"vehicles_count": 5}}))

if __name__ == "__main__":
    venv = VecForecast(SubprocVecEnv([make], start_method="spawn"), "constant-velocity")
    print(venv.reset()["forecast"].shape, envs.Mine.__module__)
    venv.close()
    assert pickle.loads(pickle.dumps(SceneObservation)) is SceneObservation
"""
    assert run(code, project) == "(1, 11, 5, 2) envs.wrappers\n"


@pytest.mark.slow
def test_where_nothing_hides_them_both_names_are_one_module(tmp_path: Path):
    code = f"""
{OURS}
import sys
import envs, predictor.scene, dgvae_rl.predictor.scene
assert envs.ForecastObservation is ForecastObservation
assert sys.modules["dgvae_rl.predictor.scene"] is predictor.scene
assert predictor.scene.__spec__.name == "predictor.scene"
import importlib
try:
    importlib.import_module("dgvae_rl.envs.absent")
except ModuleNotFoundError as error:
    print(error)
"""
    assert run(code, tmp_path) == "No module named 'envs.absent'\n"


@pytest.mark.parametrize("hidden", [False, True])
def test_modules_run_by_their_path_below_the_package(
    project: Path, tmp_path_factory: pytest.TempPathFactory, hidden: bool
):
    """With folders of the user's own in the way, and without."""
    folder = project if hidden else tmp_path_factory.mktemp("empty")
    done = subprocess.run(
        [sys.executable, "-m", "dgvae_rl.predictor.evaluate", "--help"],
        cwd=folder, env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "--checkpoint" in done.stdout, done.stderr[-1000:]
