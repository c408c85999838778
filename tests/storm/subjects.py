"""Commands that storms stop, with tiny sizes, and what must be equal at their ends."""

import hashlib
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from agents.runs import load_model
from predictor.checkpoint import BEST_OF_RUN
from predictor.data.springs import SpringsConfig, make
from predictor.data.store import read_store
from tests.agents.studies.helpers import SLOW_TOY, study_path, study_text
from tests.envs.misbehaving import env_id
from tests.predictor.helpers import write_circles

Results = Mapping[str, Any]


@dataclass(frozen=True)
class Subject:
    """Command that can be stopped and repeated."""

    words: Callable[[Path, Path], list[str]]
    """Function from a folder of inputs and one of outputs to the words of the command."""
    results: Callable[[Path], Results]
    """Function from the folder of outputs to what must be equal, however often the command was stopped."""
    is_over: Callable[[Path], bool] = lambda out: False
    """Function from the folder of outputs to whether the command refuses to run again, since all is there."""


def make_inputs(folder: Path) -> Path:
    """Writes what the commands read; returns the folder."""
    write_circles(folder / "circles")
    make(SpringsConfig(folder / "springs", train=20, val=6, test=12, ood=12))
    study_path(folder, study_text(SLOW_TOY))
    return folder


def differs(name: str, found: Results, expected: Results) -> bool:
    """Returns whether the results of a stopped command differ from those of the run in peace; prints which."""
    keys = [key for key in sorted({*found, *expected}) if found.get(key) != expected.get(key)]
    for key in keys:
        print(f"{name}: {key} is {found.get(key)}, in peace {expected.get(key)}", flush=True)
    return bool(keys)


def digest(content: bytes) -> str:
    """Returns a short hash."""
    return hashlib.sha256(content).hexdigest()[:16]


def _train(inputs: Path, out: Path) -> list[str]:
    return [
        *_module("predictor.train"), "--data", str(inputs / "circles"), "--out", str(out / "run"), "--resume",
        "--steps", "120", "--eval-every", "10", "--batch-size", "8", "--history-steps", "4", "--min-history-steps",
        "1", "--val-history-steps", "4", "--horizon-steps", "3", "--threads", "1", "--val-fraction", "0.3",
        "--patience", "1000", "--model", "lstm",
    ]  # fmt: skip


def _trained(out: Path) -> Results:
    state = torch.load(out / "run" / "train_state.pt", weights_only=True)
    weights = {name: digest(value.numpy().tobytes()) for name, value in state["model"].items()}
    best = out / "run" / BEST_OF_RUN / "model.safetensors"
    return {"step": state["step"], "best": digest(best.read_bytes())} | weights


def _policy(inputs: Path, out: Path) -> list[str]:
    return [
        sys.executable, "train_policy.py", "--env-id", SLOW_TOY, "--observe", "none", "--out", str(out / "run"),
        "--resume", "--steps", "1536", "--num-envs", "2", "--checkpoint-every", "256", "--selections", "3",
        "--selection-episodes", "3", "--eval-episodes", "4", "--no-video", "--set", "n_steps=64", "batch_size=64",
    ]  # fmt: skip


def _learned(out: Path) -> Results:
    """Episodes after a stop are new ones (docs/policies.md), so that weights differ; all steps were made."""
    steps = load_model(out / "run" / "checkpoint.zip", "ppo").num_timesteps
    load_model(out / "run" / "policy.zip", "ppo")
    summary = json.loads((out / "run" / "summary.json").read_text())
    names = sorted(path.name for path in (out / "run").iterdir())
    return {"steps": steps, "policies": sorted(policy["policy"] for policy in summary["policies"]), "files": names}


_OFTEN = """
from predictor.data.partial_store import PartialStore
PartialStore.__init__.__defaults__ = (False, 0.5)  # parts are written every half second
from envs import collect
from predictor.support.errors import run_entry_point
run_entry_point(collect.main)
"""


def _collect(inputs: Path, out: Path) -> list[str]:
    return [
        sys.executable, "-c", _OFTEN, "--env-id", env_id("Slow"), "--out", str(out / "store"), "--episodes", "24",
        "--driver", "random", "--workers", "2", "--seed", "10",
    ]  # fmt: skip


def _collected(out: Path) -> Results:
    store = read_store(out / "store")
    return {str(e.seed): digest(e.states.tobytes() + e.valid.tobytes() + e.ids.tobytes()) for e in store.episodes}


def _suite(inputs: Path, out: Path) -> list[str]:
    return [
        *_module("predictor.suite"), "--table", "springs", "--data", str(inputs), "--out", str(out / "suite"),
        "--budget", "smoke", "--steps", "6", "--lines", "constant-velocity", "lstm-joint", "--workers", "2",
    ]  # fmt: skip


def _measured(out: Path) -> Results:
    table = json.loads((out / "suite" / "springs-smoke" / "table.json").read_text())
    lines = {line["key"]: json.dumps(_without_costs(line), sort_keys=True) for line in table["rows"]}
    return {"failed": table["failed"]} | lines


def _without_costs(content: Any) -> Any:
    """Leaves out what differs between equal runs: times, memory, and how they were made."""
    costs = ("provenance", "seconds", "train_seconds", "measure_seconds", "peak_memory_mb")
    if isinstance(content, dict):
        return {key: _without_costs(value) for key, value in content.items() if key not in costs}
    return [_without_costs(value) for value in content] if isinstance(content, list) else content


def _study(inputs: Path, out: Path) -> list[str]:
    study = str(inputs / "corridor.toml")
    return [*_module("agents.study"), "--study", study, "--out", str(out / "study"), "--workers", "2"]


def _studied(out: Path) -> Results:
    report = (out / "study" / "report.md").read_text()
    episodes = (out / "study" / "episodes.parquet").read_bytes()
    return {"episodes": digest(episodes), "report": report[: report.index("## Time")]}


def _module(name: str) -> list[str]:
    return [sys.executable, "-m", name]


SUBJECTS = {
    "train": Subject(_train, _trained),
    "policy": Subject(_policy, _learned),
    "collect": Subject(_collect, _collected, lambda out: (out / "store").exists()),
    "suite": Subject(_suite, _measured),
    "study": Subject(_study, _studied),
}
"""Commands by name."""
