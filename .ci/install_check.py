"""Builds the wheel and tries each extra in a fresh virtual environment: `python .ci/install_check.py`.

Every environment gets the wheel with one extra, at the versions of constraints.txt, and runs that extra's commands in
an empty folder, where the repository cannot be imported. It also checks that an extra does not install certain modules,
which a command could otherwise use without declaring them. `--only core envs` tries some of them.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SPRINGS = "predictor.data.springs --out springs --train 40 --val 8 --test 8 --ood 4"
TRAIN = "predictor.train --data springs/train --out run --steps 4 --eval-every 2 --batch-size 4 --val-windows 8"
EVALUATE = "predictor.evaluate --checkpoint run/checkpoint --data springs/test --out report --max-windows 16"
WRAPPED = """
from envs import ForecastObservation, make_env
observation, _ = ForecastObservation(make_env("{env_id}")).reset(seed=0)
assert observation["forecast"].shape[-1] == 2
"""
OWN_FOLDER = """
from pathlib import Path
Path("envs").mkdir()
Path("envs/__init__.py").write_text("MINE = 1")
import envs
from dgvae_rl import ForecastObservation, make_env
observation, _ = ForecastObservation(make_env("highway-fast-v0")).reset(seed=0)
assert observation["forecast"].shape[-1] == 2 and envs.MINE == 1
import shutil
shutil.rmtree("envs")
"""
COMMAND = """
import subprocess, sys
from pathlib import Path
done = subprocess.run([Path(sys.executable).parent / "dgvae", "--help"], capture_output=True, text=True, check=True)
assert "train-predictor" in done.stdout, done.stdout
"""
WITHOUT_ENVPOOL = """
from envs import make_env
from predictor import UserError
try:
    make_env("envpool/HighwayFast-v0")
except UserError as error:
    assert "pip install" in str(error), error
else:
    raise SystemExit("made an environment of EnvPool, which is not installed")
"""
WITHOUT_CONTRIB = """
from agents import Task, TrainingPlan
from predictor import UserError
try:
    TrainingPlan(Task("highway-fast-v0", "none"), "qrdqn", steps=1, num_envs=1, seed=0)
except UserError as error:
    assert "pip install 'dgvae-rl[contrib]'" in str(error), error
else:
    raise SystemExit("planned a training with sb3-contrib, which is not installed")
"""
ON_A_CLUSTER = """
import ray
from predictor.support.cluster import connected
ray.init(num_cpus=1, include_dashboard=False, object_store_memory=80_000_000)
with connected("auto", ("numpy", "torch")) as cluster:
    found = sorted(cluster.results(bool, [0, 1, 2]))
assert found == [(0, False), (1, True), (2, True)], found
"""


@dataclass(frozen=True)
class Extra:
    """Extra of the package, with the commands that must work after installing it."""

    commands: Sequence[str]
    """Commands to run one after the other in one folder: "module --option", or Python code if it has several lines."""
    absent: Sequence[str] = ()
    """Modules that this extra must not install."""


EXTRAS: dict[str, Extra] = {
    "core": Extra(
        (
            *(f"predictor.{door} --help" for door in ("train", "evaluate", "suite", "interpret", "card")),
            "\nfrom predictor import *\n",
            "\nfrom dgvae_rl.testing import check_forecaster\nfrom dgvae_rl import Forecaster, __version__\n",
            COMMAND,
            SPRINGS,
            TRAIN,
            EVALUATE,
        ),
        absent=("gymnasium", "pettingzoo", "highway_env", "stable_baselines3", "envpool"),
    ),
    "scores": Extra(
        ("\nfrom predictor.evaluation.disentanglement import dci\nimport sklearn\n",), absent=("gymnasium",)
    ),
    "envs": Extra(
        (
            WRAPPED.format(env_id="highway-fast-v0"),
            WITHOUT_ENVPOOL,
            OWN_FOLDER,
            "envs.collect --env-id highway-fast-v0 --out data --episodes 2 --max-steps 12 --workers 1",
            "envs.evaluate --env-ids highway-fast-v0 --checkpoint highway --episodes 1 --max-steps 8 --workers 1",
        ),
        absent=("stable_baselines3", "envpool"),
    ),
    "rl": Extra(
        (
            "\nfrom agents import *\nfrom envs import VecForecast, ParallelVecEnv\n",
            "train_policy --steps 128 --selections 1 --selection-episodes 1 --eval-episodes 2",
            WITHOUT_CONTRIB,
        ),
        absent=("envpool", "sb3_contrib", "optuna"),
    ),
    "study": Extra(
        (
            "agents.study --list",
            "\nfrom agents.studies.report import write_report\n",
            "agents.evaluate --policy idle --env-id highway-fast-v0 --episodes 2 --num-envs 1 --out study",
            "\nimport pyarrow.parquet\nassert pyarrow.parquet.read_table('study/episodes.parquet').num_rows == 12\n",
        ),
        absent=("envpool",),
    ),
    "contrib": Extra(
        (
            "train_policy --algorithm qrdqn --steps 128 --selections 1 --selection-episodes 1 --eval-episodes 2",
            "agents.evaluate --run-dir runs/highway-fast-v0-qrdqn-forecast-0 --episodes 2 --num-envs 1",
        ),
        absent=("envpool", "optuna"),
    ),
    "tune": Extra(
        (
            "agents.tune --trials 2 --steps 128 --num-envs 1 --episodes 1 --selections 1 --selection-episodes 1",
            "train_policy --preset runs/tune-highway-fast-v0-ppo/best.toml --steps 128 --selections 1 "
            "--selection-episodes 1 --eval-episodes 2 --no-video",
        ),
        absent=("envpool", "sb3_contrib"),
    ),
    "hub": Extra(
        (
            "\nimport os\n\nos.environ['HF_ENDPOINT'] = 'http://127.0.0.1:9'\n"
            "from predictor import UserError, from_hub\n"
            "try:\n    from_hub('owner/name')\nexcept UserError as error:\n    assert 'cannot reach' in str(error)\n"
            "else:\n    raise SystemExit('reached a hub that is not there')\n",
        ),
        absent=("gymnasium", "stable_baselines3"),
    ),
    "ray": Extra((ON_A_CLUSTER,), absent=("gymnasium",)),
    "envpool": Extra((WRAPPED.format(env_id="envpool/HighwayFast-v0"), "\nfrom envs import EnvPoolVecEnv\n")),
}
"""Extras by name; "core" is the package alone."""


def run(command: Sequence[str | Path], folder: Path) -> None:
    """Runs a command in a folder.

    Raises:
        RuntimeError: the command failed; the message ends with the last lines of its output.
    """
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
    )  # fmt: skip
    if done.returncode:
        tail = "\n".join(done.stdout.splitlines()[-25:])
        raise RuntimeError(f"{' '.join(map(str, command[1:]))}\nended with status {done.returncode}:\n{tail}")


def build_wheel(folder: Path) -> Path:
    """Builds the wheel of this tree into a folder, from a copy: an old build/ would add modules that were deleted."""
    listed = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in filter(None, subprocess.check_output(listed, text=True).split("\0")):
        if (ROOT / name).is_file():  # a file may be deleted and not committed yet
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / "source" / name)
    run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, folder / "source"], folder
    )
    (wheel,) = folder.glob("*.whl")
    return wheel


def try_extra(name: str, wheel: Path, folder: Path) -> None:
    """Installs the wheel with an extra into a new environment below `folder` and runs the extra's commands.

    Raises:
        RuntimeError: the installation or a command fails, or a module is installed that must be absent.
    """
    extra, python, work = EXTRAS[name], folder / "venv" / "bin" / "python", folder / "work"
    work.mkdir()
    venv.create(folder / "venv", with_pip=True)
    target = str(wheel) if name == "core" else f"{wheel}[{name}]"
    run([python, "-m", "pip", "install", "--quiet", "-c", ROOT / "constraints.txt", target], work)
    for module in extra.absent:
        code = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({module!r}) is not None)"
        try:
            run([python, "-c", code], work)
        except RuntimeError:
            raise RuntimeError(f"'{name}' installs {module}, which it must not") from None
    for command in extra.commands:
        run([python, "-c", command] if "\n" in command else [python, "-m", *command.split()], work)


def main() -> int:
    """Runs the command; returns the number of extras that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(EXTRAS), default=list(EXTRAS), help="extras to try")
    names, failed = parser.parse_args().only, 0
    with tempfile.TemporaryDirectory() as built:
        wheel = build_wheel(Path(built))
        for name in names:
            began = time.monotonic()
            with tempfile.TemporaryDirectory() as folder:
                try:
                    try_extra(name, wheel, Path(folder))
                    verdict = "ok"
                except RuntimeError as error:
                    verdict, failed = f"FAILED: {error}", failed + 1
            print(f"{name:8} {time.monotonic() - began:5.0f} s  {verdict}", flush=True)
    print(f"{len(names) - failed} of {len(names)} installations work")
    return failed


if __name__ == "__main__":
    sys.exit(main())
