"""Every command: bad values end in one line, options have one name, and devices are called the same everywhere."""

import importlib
import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import gymnasium as gym
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv

from envs.parallel import ForecastParallelEnv
from envs.registry import make_env, make_multiagent_env
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.data.store import StoreInfo, write_store
from predictor.support.command_line import parse
from predictor.support.config_checks import check_choices
from predictor.support.errors import UserError, run_entry_point
from tests.predictor.helpers import circling_episode, spec

ROOT = Path(__file__).resolve().parents[1]

FOLDER = ". is a folder; name a file"

REFUSED: dict[str, list[tuple[str, str]]] = {
    "predictor.train": [
        ("--data absent --out new", "no episode store at absent"),
        ("--data absent --out file", "file is a file; choose another --out"),
        ("--data absent --out new --steps -1", "steps must be at least 1, got -1"),
        ("--data absent --out new --likelihood gausian", "invalid choice 'gausian' for argument '--likelihood'"),
        ("--data absent --out new --device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
        ("--data absent --out new --seed 1.5", "--seed must be a whole number, got '1.5'"),
    ],
    "predictor.evaluate": [
        ("--checkpoint absent --data absent", "no checkpoint 'absent'"),
        ("--checkpoint highway --data absent", "no episode store at absent"),
        ("--checkpoint highway --data absent --out file", "file is a file; choose another --out"),
        ("--checkpoint highway --data absent --num-samples 0", "num_samples must be at least 1, got 0"),
        ("--checkpoint highway --data absent --num-samples 1000000000000", "num_samples=1,000,000,000,000 needs"),
        ("--checkpoint highway --data absent --seed -1", "seed must not be negative, got -1"),
        ("--checkpoint highway --data absent --device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
    ],
    "predictor.suite": [
        ("--table springs --data absent", "no store at absent/springs/train; make the stores of this table with"),
        ("--table springs --data absent --lines mlp", "no store at absent/springs/train"),
        ("--table spring", "invalid choice 'spring' for argument '--table'"),
        ("--table springs --workers -1", "workers must not be negative, got -1"),
        ("--table springs --cluster head", "cluster must be auto or HOST:PORT (as in 10.0.0.1:6379), got 'head'"),
        ("--table springs --seeds 0", "seeds must be at least 1, got 0"),
        ("--table springs --precision tf32", "precision 'tf32' needs a CUDA device"),
        ("--table springs --device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
    ],
    "predictor.interpret": [
        ("--checkpoint absent --data absent --out new", "no checkpoint 'absent'"),
        ("--checkpoint highway --data absent --out file", "file is a file; choose another --out"),
        ("--checkpoint highway --data absent --out new --burn-in-steps 0", "burn_in_steps must be at least 1, got 0"),
        ("--checkpoint highway --data absent --out new --device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
        ("--checkpoint highway --data a --out new --num-samples 1000000000000", "num_samples=1,000,000,000,000 needs"),
        (
            "--checkpoint highway --data a --out new --num-samples 1000000 --horizon-steps 100000000",
            "horizon_steps times num_samples=100,000,000,000,000 needs",
        ),
    ],
    "predictor.nba_score": [
        ("--data absent", "no episode store at absent"),
        ("--data absent --checkpoint absent", "no checkpoint 'absent'"),
        ("--data absent --out file", "file is a file; choose another --out"),
        ("--data absent --num-samples 0", "num_samples must be at least 1, got 0"),
        ("--data absent --num-samples 1000000000000", "num_samples=1,000,000,000,000 needs"),
        ("--data absent --batch-size 1000000000000", "batch_size=1,000,000,000,000 needs"),
        ("--data absent --device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
    ],
    "docs.draw_pictures": [
        (
            "--only film",
            "only must be among highway, what_if, seen, braking_leader, causal_graph, calibration, fans_roundabout, "
            "fans_intersection, got film",
        )
    ],
    "predictor.card": [("--checkpoint absent --data absent --accuracy absent", "no checkpoint 'absent'")],
    "predictor.data.springs": [
        ("--out file", "file is a file; choose another --out"),
        ("--out new --train -1", "train must not be negative, got -1"),
        ("--out new --physics.num-agents 0", "num_agents must be positive, got 0"),
        ("--out new --physics.kind spring", "invalid choice 'spring' for argument '--physics.kind'"),
    ],
    "predictor.data.nri": [
        ("--out file", "file is a file; choose another --out"),
        ("--out new --test -1", "test must not be negative, got -1"),
        ("--out new --num-agents 1", "num_agents must be at least 2, got 1"),
        ("--out new --law spring", "invalid choice 'spring' for argument '--law'"),
        ("--out new --train 0 --val 0 --test 0", "nothing to simulate: train, val and test are all 0"),
    ],
    "predictor.data.crowd": [
        ("--source absent --out new", "no episode store at absent"),
        ("--source absent --out new --num-agents 3 0", "num_agents must be at least 1, got (3, 0)"),
    ],
    "predictor.data.nba": [
        ("--source absent --out new", "no source at absent"),
        ("--source absent --out new --episode-steps 1", "episode_steps must be 0 or at least 2, got 1"),
        ("--source absent --out new --split tset", "invalid choice 'tset' for argument '--split'"),
    ],
    "predictor.data.levelx": [
        ("--source absent --out new", "no source at absent"),
        ("--source absent --out new --dt-s 0", "dt_s must be positive, got 0.0"),
    ],
    "predictor.data.mocap": [
        ("--source file --out new", "source must be one subject's folder, got the file file"),
        ("--source absent --out new --stride 0", "stride must be at least 1, got 0"),
    ],
    "predictor.data.sdd": [
        ("--source absent --out new", "no source at absent"),
        ("--source absent --out new --episode-steps 1", "episode_steps must be at least 2, got 1"),
    ],
    "predictor.data.tracks": [
        ("--source absent --out new", "no source at absent"),
        ("--source file --out file", "file exists; choose another path or pass --overwrite"),
        (
            "--source file --out new",
            "file, line 1: expected at least 4 columns (frame, id, x, y are (1, 2, 3, 4)), got 1",
        ),
        ("--source absent --out new --frame-step -1", "frame_step must not be negative, got -1"),
    ],
    "envs.collect": [
        ("--env-id nope-v0 --out new", "cannot make env 'nope-v0'"),
        ("--env-id merge-v1 --out new --episodes 0", "episodes must be at least 1, got 0"),
        ("--env-id merge-v1 --out new --cluster 10.0.0.1", "cluster must be auto or HOST:PORT (as in 10.0.0.1:6379)"),
        ("--env-id merge-v1 --out file", "file exists; choose another path or pass --overwrite"),
    ],
    "envs.check": [
        ("--env-id nope-v0", "cannot make env 'nope-v0'"),
        ("--env-id merge-v1 --episodes 0", "episodes must be at least 1, got 0"),
        ("--env-id merge-v1 --reader absent:read", "cannot import 'absent' for 'absent:read'"),
        ("--env-id merge-v1 --env-kwargs 3", "env_kwargs must be a JSON object, got '3'"),
    ],
    "envs.evaluate": [
        ("--checkpoint absent --env-ids merge-v1", "no checkpoint 'absent'"),
        ("--workers 0", "workers must be at least 1, got 0"),
        ("--memory-steps 3 0", "memory_steps must be at least 1, got (3, 0)"),
        ("--env-ids merge-v1 --out file", "file is a file; choose another --out"),
        ("--checkpoint runs/a/checkpoint runs/a", "each checkpoint is given once, got runs/a/checkpoint, runs/a"),
        ("--reactions --perturbations 0", "perturbations must be at least 1, got 0"),
        ("--graph --env-ids pursuit_v5", "raw_env cannot be perturbed; use an environment of highway-env"),
        ("--reactions --env-ids pursuit_v5", "raw_env cannot be perturbed; use an environment of highway-env"),
    ],
    "envs.export_levelx": [
        ("--env-id nope-v0 --out new", "cannot make env 'nope-v0'"),
        ("--env-id merge-v1 --out new --max-steps 0", "max_steps must be at least 1, got 0"),
        ("--env-id merge-v1 --out file", "file is a file; choose another --out"),
        (
            "--env-id merge-v1 --out new --driver policy.zip",
            "driver must be one of random, idle, varied, keep-lane, got",
        ),
    ],
    "agents.evaluate": [
        ("--run-dir absent --out file", "file is a file; choose another --out"),
        ("--run-dir absent", "no policy at absent: neither a run folder nor a .zip nor one that ships (highway-fast,"),
        ("--run-dir .", ". holds no training run (config.json is missing)"),
        ("--run-dir hub:me/fast", "hub:me/fast is no run folder; say with --out where the results go"),
        ("--run-dir absent --num-envs 0", "num_envs must be at least 1, got 0"),
        ("--run-dir absent --device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
        ("", "give either --run-dir (a training run) or --policy"),
        ("--run-dir absent --policy planner", "give either --run-dir (a training run) or --policy"),
        ("--policy planner --out new", "--policy and --env-id go together"),
        ("--policy planner --env-id merge-v1", "--policy has no run folder; say with --out where the results go"),
        ("--policy nobody --env-id merge-v1 --out new", "driver must be one of random, idle, varied, keep-lane"),
        (
            "--policy constant-actions --env-id merge-v1 --out new",
            "constant-actions stands for several drivers; give it to --drivers, and one to --policy",
        ),
        ("--policy planner --env-id simple_tag_v3 --out new", "drivers of an ego need an environment with one ego"),
        ("--policy idle --env-id merge-v1 --out new --films", "--films are of a trained policy; leave it out with"),
        ("--run-dir absent --films --episodes 2", "--films needs at least 3 --episodes, got 2"),
        ("--policy idle --env-id merge-v1 --out new --drivers none slower", "--drivers none adds no line and stands"),
    ],
    "agents.watch": [
        ("absent", "no policy at absent: neither a run folder nor a .zip"),
        (".", ". holds no training run (config.json is missing)"),
        ("absent --out film.gif", "--out is a film and ends in .mp4, got film.gif"),
        ("absent --window --out film.mp4", "--window writes no film; leave out --out or --window"),
        ("absent --seed -1", "seed must not be negative, got -1"),
        ("absent --device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
    ],
    "agents.study": [
        (
            "--study absent",
            "no study 'absent': neither a file nor one that ships (costly, crossing, foresight, foresight-fast, ",
        ),
        ("--study file", "file is not valid TOML: "),
        ("--workers -1", "workers must not be negative, got -1"),
        ("--seeds 0", "seeds must be at least 1, got 0"),
        ("--scenarios merge nowhere", "study quick has no scenario 'nowhere'; it has merge"),
        ("--out file", "file is a file; choose another --out"),
        ("--out .", ". holds file but no study (study.toml); choose another --out"),
    ],
    "agents.push": [
        ("absent me/name", "no checkpoint 'absent'"),
        ("absent.zip me/name", "no policy at absent.zip: neither a run folder nor a .zip"),
        ("merge name", "'hub:name' names nothing on a hub; write hub:owner/name"),
    ],
    "agents.report": [
        ("absent", "no run folder at absent; give the --out of train_policy.py or of predictor.train"),
        (".", ". holds no training run (config.json is missing)"),
        (". --accuracy absent", "no accuracy.json in absent; --accuracy takes the --out of envs.evaluate"),
    ],
    "agents.tune": [
        ("--env-id nope-v0", "cannot make env 'nope-v0'"),
        ("--algorithm sac", "sac needs a continuous action space, highway-fast-v0 has Discrete(5); use ppo"),
        ("--algorithm sarsa", "invalid choice 'sarsa' for argument '--algorithm'"),
        ("--num-envs 100000000000", "num_envs=100,000,000,000 needs at least "),
        ("--episodes 1000000000000", "episodes=1,000,000,000,000 needs at least "),
        ("--trials 0", "trials must be at least 1, got 0"),
        ("--seed -1", "seed must lie in [0, 1000000), got -1"),
        ("--trainings 101", "trainings must be at most 100, got 101"),
        ("--checkpoint absent", "no checkpoint 'absent'"),
        ("--out file", "file is a file; choose another --out"),
        ("--out .", ". holds file but no tuning (tuning.json); choose another --out"),
    ],
    "train_policy": [
        ("--env-id nope-v0 --observe none", "cannot make env 'nope-v0'"),
        ("--num-envs 0", "num_envs must be at least 1, got 0"),
        ("--seed -1", "seed must lie in [0, 1000000000), got -1"),
        ("--algorithm sarsa", "invalid choice 'sarsa' for argument '--algorithm'"),
        ("--algorithm sac --observe none", "sac needs a continuous action space, highway-fast-v0 has Discrete(5); use"),
        (
            "--set lerning_rate=1",
            "--set: ppo has no hyperparameter 'lerning_rate'; there are learning_rate, gamma, net_",
        ),
        ("--set learning_rate", "--set takes NAME=VALUE with hyperparameters of ppo (learning_rate, gamma, net_arch, "),
        ("--set n_steps=3.5", "--set: n_steps must be a whole number, got 3.5"),
        ("--algorithm tqc --set ent_coef=some", "--set: ent_coef must be a number or one of auto, got 'some'"),
        ("--set gamma=2", "ppo: gamma must lie in [0, 1], got 2.0"),
        ("--preset absent", "no preset at absent; give a TOML file with lines such as learning_rate = 3e-4"),
        ("--preset file", "file is not valid TOML: "),
        ("--env-id simple_tag_v3 --driver nobody", "driver must be one of random, idle, varied, heuristic, mixed"),
        ("--checkpoint absent", "no checkpoint 'absent'"),
        ("--device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
    ],
    "benchmarks.__main__": [
        ("--threads 0", "threads must be at least 1, got 0"),
        ("--only forcast", "there is no section forcast"),
        ("--out .", ". is a folder; name a file"),
    ],
    "benchmarks.wrapper_overhead": [
        ("--num-envs 0", "num_envs must be at least 1, got 0"),
        ("--vec thread", "invalid choice 'thread' for argument '--vec'"),
        ("--out .", FOLDER),
        ("--env-id racetrack-v1 --num-envs 1", "blocks are of random discrete actions, the environment has Box("),
    ],
    "benchmarks.copies": [
        ("--copies 1", "copies must be at least 2, got 1"),
        ("--out .", FOLDER),
        ("--env-id highway-fast-v0", "unknown multiagent env 'highway-fast-v0'; known: "),
    ],
    "benchmarks.joint_futures": [
        ("--agents 0", "agents must be at least 1, got (0,)"),
        ("--agents --", "agents needs at least one value, got none"),
        ("--env-ids --", "env_ids needs at least one value, got none"),
        ("--env-ids absent-v0", "no checkpoint ships for env 'absent-v0'"),
        ("--env-ids merge-v1 merge-v1", "env_ids must differ, got merge-v1, merge-v1"),
        ("--out .", FOLDER),
    ],
    "benchmarks.foreseeable": [
        ("--draws 0", "draws must be at least 1, got 0"),
        ("--policy absent", "no policy"),
        ("--policy roundabout", "policy 'roundabout' must see forecasts of simple_tag_v3"),
        ("--checkpoint roundabout", "checkpoint 'roundabout' must be a network of simple_tag_v3 whose agents react"),
        ("--out .", FOLDER),
    ],
    "benchmarks.rows": [
        ("--num-envs 0", "num_envs needs numbers of at least 1, got (0,)"),
        ("--max-rows 0", "max_rows must be at least 1, got 0"),
        ("--seconds 0", "seconds must be positive, got 0.0"),
        ("--out .", FOLDER),
        ("--checkpoint absent", "no checkpoint 'absent'"),
        ("--device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
    ],
    "benchmarks.cluster": [("--episodes 1", "episodes must be at least 2, got 1"), ("--out .", FOLDER)],
    "benchmarks.graph_accuracy": [
        ("--checkpoint absent --data absent", "no episode store at absent"),
        ("--checkpoint absent --data absent --neighbours 0", "neighbours must be at least 1, got (0,)"),
        ("--checkpoint highway --data store --out .", FOLDER),
    ],
    "benchmarks.gpu_springs": [
        ("--steps -1", "steps must not be negative, got -1"),
        ("--device tpu", "device must be cpu, cuda or auto, got 'tpu'"),
    ],
    "benchmarks.envpool_identity": [("--num-envs 0", "num_envs must be at least 1, got 0")],
    "benchmarks.envpool_parity": [
        ("--task-ids Nope-v0", "cannot compare Nope-v0: unknown"),
        ("--out .", FOLDER),
        ("--policy absent.zip", "no policy at absent.zip"),
        ("--task-ids HighwayFast-v0 Intersection-v1", "cannot compare Intersection-v1: its actions are continuous"),
    ],
    "benchmarks.envpool_training": [
        ("--num-envpool-envs 0", "num_envpool_envs must be at least 1, got 0"),
        ("--out .", FOLDER),
    ],
}
"""Words of a command line → how the one line begins after "error: ", for each command."""

REQUIRED: dict[str, list[str]] = {
    "predictor.train": ["--data", "store", "--out", "run"],
    "predictor.evaluate": ["--checkpoint", "highway", "--data", "store"],
    "predictor.suite": ["--table", "springs"],
    "predictor.interpret": ["--checkpoint", "highway", "--data", "store", "--out", "new"],
    "predictor.nba_score": ["--data", "store"],
    "predictor.card": ["--checkpoint", "highway", "--data", "store", "--accuracy", "accuracy.json"],
    "predictor.data.springs": ["--out", "new"],
    "predictor.data.nri": ["--out", "new"],
    "predictor.data.crowd": ["--source", "store", "--out", "new"],
    **{
        f"predictor.data.{name}": ["--source", "files", "--out", "new"]
        for name in ("nba", "levelx", "mocap", "sdd", "tracks")
    },
    "envs.check": ["--env-id", "merge-v1"],
    "envs.collect": ["--env-id", "merge-v1", "--out", "new"],
    "envs.export_levelx": ["--env-id", "merge-v1", "--out", "new"],
    "agents.evaluate": ["--run-dir", "run"],
    "agents.watch": ["run"],
    "agents.report": ["run"],
    "agents.push": ["what", "owner/name"],
    "benchmarks.graph_accuracy": ["--checkpoint", "highway", "--data", "store"],
    "benchmarks.gpu_springs": ["--device", "cpu"],
}
"""Required options of a command."""


def source_of(command: str) -> str:
    return (ROOT / f"{command.replace('.', '/')}.py").read_text()


def config_of(command: str) -> type:
    """Returns the dataclass that a command's `main` reads."""
    (name,) = re.findall(r"parse\((\w+), __doc__\)", source_of(command))
    found = getattr(importlib.import_module(command), name)
    assert is_dataclass(found)
    return found


def all_configs() -> list[type]:
    """Returns the commands' dataclasses and those inside of them."""
    found = [config_of(command) for command in REFUSED]
    for config in found:
        found += [kind for kind in get_type_hints(config).values() if is_dataclass(kind)]
    return found


def test_every_command_is_here():
    """Whatever reads a command line does it by `parse`."""
    listed = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True)
    sources = {name: (ROOT / name).read_text() for name in listed.stdout.split() if not name.startswith("tests/")}
    reading = {name for name, text in sources.items() if re.search(r"\bparse\(\w+, __doc__\)", text)}
    assert reading == {f"{command.replace('.', '/')}.py" for command in REFUSED}
    assert [name for name, text in sources.items() if "tyro.cli(" in text] == ["predictor/support/command_line.py"]


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [(command, words, message) for command, cases in REFUSED.items() for words, message in cases],
)
def test_bad_values_end_in_one_line(
    command: str,
    words: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    module = importlib.import_module(command)
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("mine")
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    monkeypatch.setattr(sys, "argv", ["command", *words.split()])
    with pytest.raises(SystemExit) as stop:
        run_entry_point(module.main)
    errors = capsys.readouterr().err
    assert stop.value.code == 2
    assert errors.startswith(f"error: {message}") and errors.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# --- Names of options -------------------------------------------------------------------------------------------------


def test_no_option_has_a_name_that_was_given_up():
    """One word for one thing; `run_dir` is the folder that `agents.evaluate` reads."""
    given_up = {"jobs", "envs", "samples", "ego", "egos", "partner", "rows", "only_row", "rows_at_once", "stores"}
    given_up |= {"checkpoints"}
    for config in all_configs():
        assert not given_up & {field.name for field in fields(config)}, config
    with_history = {c for c in REFUSED if "history_steps" in {f.name for f in fields(config_of(c))}}
    assert with_history == {"predictor.train", "predictor.evaluate"}  # steps fed to the model
    assert [c for c in REFUSED if "run_dir" in {f.name for f in fields(config_of(c))}] == ["agents.evaluate"]


def test_everyday_options_are_options():
    for command in REFUSED:
        config = config_of(command)
        assert set(getattr(config, "EVERYDAY", ())) <= {field.name for field in fields(config)}, command
        required = {field.name for field in fields(config) if field.default is MISSING}
        assert required <= set(getattr(config, "EVERYDAY", required)), command


@pytest.mark.parametrize("command", REFUSED)
def test_help_is_whole_phrases(command: str, capsys: pytest.CaptureFixture[str]):
    """Every option is explained, by a phrase that does not need the name of its option."""
    with pytest.raises(SystemExit) as stop:
        parse(config_of(command), "Description.", args=["--help-all"])
    assert stop.value.code == 0
    out = " ".join(re.sub(r"[│╭╮╰╯─|]", " ", capsys.readouterr().out).split())
    source = inspect.getsource(config_of(command))
    strings = re.findall(r'^    \w+: [^\n]+\n    """(.+?)"""$', source, flags=re.MULTILINE | re.DOTALL)
    assert strings
    for string in strings:
        assert not string.startswith(("Of ", "The same", "Whose ", "Which ")), string
        assert string.endswith("."), string
    for field in fields(config_of(command)):
        if not is_dataclass(get_type_hints(config_of(command))[field.name]):
            positional = field.default is MISSING and command in ("agents.watch", "agents.report", "agents.push")
            kind = "STR" if command == "agents.push" else "PATH"
            assert (kind if positional else f"--{field.name.replace('_', '-')}") in out, field.name


# --- Configs made from Python -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", all_configs(), ids=lambda config: f"{config.__module__}.{config.__name__}")
def test_closed_choices_are_checked_from_python(config: type):
    """Whatever makes a config: a value that a `Literal` does not list is refused by `__post_init__`."""
    hints = get_type_hints(config)
    closed = [field.name for field in fields(config) if get_origin(hints[field.name]) is Literal]
    for name in closed:
        made = object.__new__(config)  # in tests, the checks of types would refuse a wrong choice first
        for field in fields(config):
            object.__setattr__(made, field.name, field.default)
            if get_origin(hints[field.name]) is Literal:
                object.__setattr__(made, field.name, get_args(hints[field.name])[0])
        check_choices(made)
        object.__setattr__(made, name, "nonsense")
        with pytest.raises(UserError, match=f"{name} must be one of .*, got 'nonsense'"):
            made.__post_init__()


# --- Devices ----------------------------------------------------------------------------------------------------------

WITH_DEVICE = [command for command in REFUSED if "device" in {f.name for f in fields(config_of(command))}]


def test_commands_that_run_a_model_take_a_device():
    assert WITH_DEVICE == [
        "predictor.train",
        "predictor.evaluate",
        "predictor.suite",
        "predictor.interpret",
        "predictor.nba_score",
        "agents.evaluate",
        "agents.watch",
        "train_policy",
        "benchmarks.rows",
        "benchmarks.gpu_springs",
    ]


@pytest.mark.parametrize("command", WITH_DEVICE)
@pytest.mark.parametrize(("there", "taken"), [(True, "cuda"), (False, "cpu")])
def test_auto_takes_the_cuda_device_where_there_is_one(
    command: str, there: bool, taken: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    config: Any = parse(config_of(command), args=[*REQUIRED.get(command, []), "--device", "auto"])
    assert config.device == taken


@pytest.mark.parametrize("command", WITH_DEVICE)
def test_a_device_that_is_not_there_is_named(command: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="device 'cuda' was asked for but torch finds no CUDA device; use --device cpu"):
        parse(config_of(command), args=[*REQUIRED.get(command, []), "--device", "cuda"])


@pytest.mark.slow
def test_a_command_runs_on_auto(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    episodes = [circling_episode(seed) for seed in range(3)]
    write_store(tmp_path / "data", StoreInfo(spec(has_ego=False), "circles"), episodes)
    words = ["--checkpoint", "constant-velocity", "--data", str(tmp_path / "data"), "--device", "auto"]
    monkeypatch.setattr(sys, "argv", ["command", *words, "--out", str(tmp_path / "out")])
    run_entry_point(importlib.import_module("predictor.evaluate").main)
    assert '"device": "cpu"' in (tmp_path / "out" / "accuracy.json").read_text()


WRAPPED: dict[str, Callable[[str], Any]] = {
    "ForecastObservation": lambda device: ForecastObservation(make_env("highway-fast-v0"), "highway", device=device),
    "ForecastParallelEnv": lambda device: ForecastParallelEnv(
        make_multiagent_env("simple_tag_v3"), "simple-tag", device=device
    ),
    "VecForecast": lambda device: VecForecast(
        DummyVecEnv([lambda: SceneObservation(make_env("highway-fast-v0"))]), "highway", device=device
    ),
    "VectorForecast": lambda device: VectorForecast(
        gym.vector.SyncVectorEnv([lambda: SceneObservation(make_env("highway-fast-v0"))]), "highway", device=device
    ),
}


@pytest.mark.parametrize("wrapper", WRAPPED)
def test_wrappers_take_auto(wrapper: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    env = WRAPPED[wrapper]("auto")
    env.reset()
    env.close()
    with pytest.raises(UserError, match="device 'cuda' was asked for but torch finds no CUDA device"):
        WRAPPED[wrapper]("cuda")
