"""What `predictor`, `envs` and `agents` export, and which packages each export needs."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("predictor", "envs", "agents")
SIMULATORS_AND_POLICIES = ("gymnasium", "highway_env", "pettingzoo", "mpe2", "stable_baselines3", "envpool", "tqdm")
NO_GYMNASIUM_WRAPPER_NEEDS = ("stable_baselines3", "pettingzoo", "mpe2", "envpool")


def run_without(blocked: tuple[str, ...], code: str) -> subprocess.CompletedProcess[str]:
    """Runs code in a process that cannot import the blocked modules."""
    hide = f"import sys\nfor name in {blocked!r}:\n    sys.modules[name] = None\n"
    command = [sys.executable, "-W", "ignore", "-c", hide + code]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_export_is_what_its_module_defines(package: str):
    exported = importlib.import_module(package)
    assert exported.__all__ == sorted(set(exported.__all__)) != []
    for name in exported.__all__:
        value = getattr(exported, name)
        assert value.__name__ == name if hasattr(value, "__name__") else value is not None


@pytest.mark.parametrize("name", ["envs.VecForecast", "agents.ForecastAttention", "dgvae_rl.load_policy"])
def test_a_missing_package_is_told_with_its_extra(name: str):
    package, _, export = name.partition(".")
    found = run_without(("stable_baselines3",), f"from {package} import {export}")
    sentence = f"'{export}' needs the package 'stable_baselines3', which is not installed; pip install 'dgvae-rl[rl]'"
    assert f"ModuleNotFoundError: {sentence}" in found.stderr


@pytest.mark.parametrize("package", PACKAGES)
def test_type_checkers_see_the_exports(package: str):
    tree = ast.parse((ROOT / package / "__init__.py").read_text())
    (guarded,) = [node for node in tree.body if isinstance(node, ast.If)]
    imports = [
        (node.module, name) for node in ast.walk(guarded) if isinstance(node, ast.ImportFrom) for name in node.names
    ]
    assert all(name.asname == name.name for _, name in imports)  # without it, mypy --strict has no export
    pairs = [(module, name.name) for module, name in imports]
    listed = next(node for node in ast.walk(tree) if isinstance(node, ast.Dict))
    assert sorted(pairs) == sorted(
        (module, name) for module, names in ast.literal_eval(listed).items() for name in names
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_an_unknown_name_is_an_attribute_error(package: str):
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'no_such_name'"):
        getattr(importlib.import_module(package), "no_such_name")  # noqa: B009


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_imports_nothing_heavy(package: str):
    done = run_without(("torch", "numpy", "matplotlib", *SIMULATORS_AND_POLICIES), f"import {package}")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("blocked", "statement"),
    [
        ((*SIMULATORS_AND_POLICIES, "matplotlib", "tensorboard"), "from predictor import *"),
        (NO_GYMNASIUM_WRAPPER_NEEDS, "from envs import VectorForecast, ForecastObservation, SceneObservation"),
        (NO_GYMNASIUM_WRAPPER_NEEDS, "from envs import EntityRowsReader, FunctionReader, Reader, reader_for"),
        (("pettingzoo", "mpe2", "envpool"), "from envs import VecForecast, EnvPoolVecEnv"),
        (("stable_baselines3", "envpool"), "from envs import ForecastParallelEnv, HighwayParallelEnv"),
        (("envpool", "imageio_ffmpeg"), "from envs import ParallelVecEnv, AgentMonitor"),
        (("envpool", "imageio_ffmpeg", "sb3_contrib", "optuna"), "from agents import *"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_export_needs_the_packages_of_its_kind_only(blocked: tuple[str, ...], statement: str):
    done = run_without(blocked, statement)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_gymnasium_users_wrap_an_env_without_the_other_packages():
    code = """
from envs import ForecastObservation, make_env
observation, _ = ForecastObservation(make_env("highway-fast-v0")).reset(seed=0)
print(observation["forecast"].shape)
"""
    done = run_without(NO_GYMNASIUM_WRAPPER_NEEDS, code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("(")
