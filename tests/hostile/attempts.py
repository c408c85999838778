"""Command lines with one thing wrong in each, made from the options that the commands declare, as data.

An attempt is a command, its words, and parts of the line that must come of it (one of them suffices). Numbers and
choices are made for every option of every command; paths and names for every option that takes one.
"""

import dataclasses
import importlib
import os
import sys
import types
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from predictor.support.command_line import parse
from predictor.support.errors import one_line
from tests.hostile.inputs import BAD_PATHS, LONG
from tests.test_entry_points import REFUSED, REQUIRED, config_of

TINY = "--steps 1 --batch-size 2 --history-steps 3 --min-history-steps 1 --val-history-steps 3 --horizon-steps 2 "
GOOD: dict[str, str] = {
    "predictor.train": "--data store --out new --val-windows 2 --model lstm " + TINY,
    "predictor.evaluate": "--checkpoint constant-velocity --data store --out new --history-steps 3 --horizon-steps 2",
    "predictor.suite": "--table springs --data tables --out new --budget smoke --steps 1 --workers 1 "
    "--lines constant-velocity",
    "predictor.interpret": "--checkpoint checkpoint --data store --out new --max-windows 2 --burn-in-steps 1 "
    "--horizon-steps 2",
    "predictor.nba_score": "--data court --out new --max-windows 2 --num-samples 2",
    "predictor.card": "--checkpoint checkpoint --data store --accuracy accuracy.json",
    "predictor.data.springs": "--out new --train 1 --val 0 --test 0 --ood 0",
    "predictor.data.nri": "--out new --train 1 --val 0 --test 0",
    "predictor.data.crowd": "--source tables/springs/train --out new --episodes 1 --episode-steps 2 "
    "--num-agents 2 --at-step 0",
    "predictor.data.nba": "--source nba --out new --episode-steps 2",
    "predictor.data.levelx": "--source csv --out new --episode-steps 2",
    "predictor.data.mocap": "--source mocap --out new --stride 1 --min-steps 2",
    "predictor.data.sdd": "--source sdd --out new --episode-steps 2",
    "predictor.data.tracks": "--source walk --out new --episode-steps 2",
    "envs.collect": "--env-id highway-fast-v0 --out new --episodes 1 --max-steps 1 --workers 1",
    "envs.check": "--env-id highway-fast-v0 --episodes 1 --max-steps 2",
    "envs.evaluate": "--env-ids highway-fast-v0 --checkpoint constant-velocity --episodes 1 --max-steps 9 "
    "--workers 1 --out new",
    "envs.export_levelx": "--env-id highway-fast-v0 --out new --episodes 1 --max-steps 2",
    "agents.evaluate": "--policy idle --env-id highway-fast-v0 --episodes 3 --out new",
    "agents.watch": "run",
    "agents.study": "--study toml/mine.toml --out new",
    "agents.tune": "--out new --trials 1 --steps 8 --num-envs 1 --episodes 1 --selections 1 --selection-episodes 1",
    "train_policy": "--out new --steps 8 --num-envs 1 --selections 1 --eval-episodes 1 --no-video --observe none",
}
"""Words of a run that would succeed or fail for a reason of its own, for each command of the packages."""


@dataclass(frozen=True)
class Attempt:
    """A command line that must be refused."""

    command: str
    """Module of the command."""
    words: tuple[str, ...]
    """Words behind it."""
    expected: tuple[str, ...]
    """Parts of the line, of which one must be there."""
    name: str
    """What is wrong."""

    @property
    def title(self) -> str:
        """Name of the attempt."""
        return f"{self.command}: {self.name}"

    def run(self) -> None:
        """Runs the command in this process."""
        main = importlib.import_module(self.command).main
        sys.argv = ["command", *self.words]
        main()


HUGE, LONGER = "9" * 30, "9" * 5000
NUMBERS: dict[Any, tuple[str, ...]] = {
    int: ("-1", "0", "-0.5", "nan", "1.5", "", "９", HUGE, LONGER, "1e3", "0x10", "--", "1,5"),
    float: ("nan", "inf", "-inf", "1e308", "-1", "0", "abc", "1e999", "", "1,5"),
}
"""Values of numbers."""
WORDS: tuple[str, ...] = ("moon", "", "\x1b[31mred", LONG)
"""Values of closed choices."""


def kinds_of(hint: Any) -> set[Any]:
    """Returns the types that a field takes; closed choices are `Literal`."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hasattr(hint, "__metadata__"):
        return kinds_of(hint.__origin__)
    if origin is Literal:
        return {Literal}
    if origin in (Union, types.UnionType, tuple):
        return set().union(*(kinds_of(argument) for argument in arguments if argument is not Ellipsis))
    return {hint}


@cache
def fields_of(command: str) -> dict[str, set[Any]]:
    """Returns the types of each field of a command's config."""
    config = config_of(command)
    hints = get_type_hints(config)
    return {field.name: kinds_of(hints[field.name]) for field in dataclasses.fields(config)}


def shown(word: str) -> str:
    """Returns a word for a title."""
    return repr(word if len(word) <= 24 else f"{word[:8]}… ({len(word)})")


@dataclass(frozen=True)
class Parsed(Attempt):
    """Words that must be refused before anything is done."""

    def run(self) -> None:
        """Reads the command line."""
        parse(config_of(self.command), args=list(self.words))


def numbers() -> Iterator[Attempt]:
    """Yields each option that takes a number or a closed choice, with values that do not fit."""
    for command in REFUSED:
        for name, kinds in fields_of(command).items():
            option = f"--{name.replace('_', '-')}"
            for kind in (int, float, Literal):
                if kind not in kinds or (kind is int and float in kinds):
                    continue
                for value in WORDS if kind is Literal else NUMBERS[kind]:
                    words = (*_without(REQUIRED.get(command, []), option), option, value)
                    yield Parsed(command, words, (name, option), f"{option} {shown(value)}")


NEW = ("an empty folder", "nothing", "markup in its name", "a line end in its name")
"""What an output may be."""
ALONE = {("agents.evaluate", "run_dir")}
"""Options that do not go with the good words."""
UNREAD = {("predictor.card", "data")}
"""Options that are only read once all the others were."""


def paths() -> Iterator[Attempt]:
    """Yields each option that takes a path, with what no command can use."""
    for command, good in GOOD.items():
        for name, kinds in fields_of(command).items():
            if Path not in kinds:
                continue
            option = f"--{name.replace('_', '-')}"
            for what, value in BAD_PATHS.items():
                if (command, name) in UNREAD or (name == "out" and what in NEW):
                    continue
                words = (value,) if command == "agents.watch" and name == "policy" else (option, value)
                rest = () if len(words) == 1 or (command, name) in ALONE else _without(good.split(), option)
                yield Attempt(command, (*rest, *words), (value[:20].partition("\n")[0],), f"{option} {what}")


NAMES: dict[str, tuple[str, ...]] = {
    "env_id": (
        "",
        "nope-v0",
        "Highway-v0",
        "highway-fast-v9",
        "absent:Id-v0",
        ":",
        "json:loads",
        "json:absent",
        "../x",
        "\x1b[31mred",
        LONG,
        "highway-fast-v0 ",
        "envpool/Nope-v0",
        "a/b/c",
    ),
    "checkpoint": (
        "",
        "absent",
        "hihgway",
        "own:",
        "own:absent",
        "own:absent:make",
        "own:json:loads",
        "own:json:absent",
        "fifo",
        "zero",
        "loop",
        "dangling",
        "file",
        "empty",
        "file/below",
        "run",
        LONG,
        "\x1b[31mred",
    ),
    "device": ("", "tpu", "cuda:99", "cuda:-1", "meta", "mps", "cpu:1x", LONG),
    "driver": ("", "nobody", "plannr", "planner:moon", "fifo.zip", "absent.zip", "zip/policy.zip", "empty", LONG),
    "reader": ("", "absent:read", "json:loads", "json", "json:absent", ":", LONG),
    "env_kwargs": (
        "{",
        "[]",
        "3",
        "null",
        '{"env_id": "x"}',
        "{'a': 1}",
        '{"a": NaN}',
        "[" * 5000,
        '{"nonsense": 1}',
        '{"config": 3}',
        '{"render_mode": 5}',
        LONG,
    ),
    "init": ("absent", "fifo", "file", "empty", "hihgway", LONG),
    "lines": ("moon", "", LONG),
    "set": (
        "",
        "=",
        "a",
        "a=1",
        "hidden_dim=",
        "hidden_dim=abc",
        "hidden_dim=-1",
        "hidden_dim=nan",
        "learning_rate=",
        "learning_rate=nan",
        "learning_rate=-1",
        "gamma=1e308",
        "n_steps=0",
        "n_steps=999999999999999999999999",
    ),
    "learners": ("", "moon", LONG),
    "locations": ("", "moon", LONG),
    "pattern": ("", "/absolute", "..", "[", "**nothing", LONG),
    "study": ("", "absent", "fifo", "zero", "loop", "dangling", "file", "empty", "file/below", LONG, "qick"),
    "policy": ("", "nobody", "absent.zip", "fifo.zip", "zip/policy.zip", "planner:moon", LONG),
    "drivers": ("", "nobody", "planner:moon", "absent.zip", LONG),
    "env_ids": ("", "nope-v0", "Highway-v0", "absent:Id-v0", "json:loads", LONG),
    "crash_key": ("",),
    "success_key": ("",),
}
"""Field → names that are unknown, misspelt or none."""


def names() -> Iterator[Attempt]:
    """Yields each option that takes a name, with names that there are not."""
    for command, good in GOOD.items():
        for name, kinds in fields_of(command).items():
            if str not in kinds:
                continue
            option = f"--{name.replace('_', '-')}"
            for value in NAMES.get(name, ()):
                words = (*_without(good.split(), option), option, value)
                seen = one_line(Exception(value))[:20].partition("=")[0] or "''"
                parts = (
                    name,
                    option,
                    seen,
                    seen.rpartition(":")[2],
                    *(("cannot make env",) if name == "env_kwargs" else ()),
                )
                yield Attempt(command, words, parts, f"{option} {shown(value)}")


def _without(words: Any, option: str) -> tuple[str, ...]:
    """Returns words without an option and its value."""
    kept = list(words)
    if option in kept:
        at = kept.index(option)
        del kept[at : at + 2]
    return tuple(kept)


CONTRADICTIONS: tuple[tuple[str, str, str], ...] = (
    ("predictor.train", "--data store --out new --steps 1 --threads 100000000", "threads"),
    ("predictor.train", "--data store --out new --steps 1 --seed 99999999999999999999", "seed"),
    ("predictor.train", "--data store --out new --steps 1 --set hidden_dim=100000000", "hidden_dim"),
    ("predictor.train", "--data store --out new --steps 1 --set moon=1", "moon"),
    ("predictor.train", "--data store --out new --steps 1 --min-history-steps 9 --history-steps 3", "history_steps"),
    ("predictor.train", "--data store --out new --steps 1 --val-fraction 0", "val_fraction"),
    ("predictor.train", "--data store --out new --steps 1 --val-fraction 1", "val_fraction"),
    ("predictor.train", "--data store court --out new --steps 1", "court"),
    ("predictor.train", "--data store --val-data court --out new --steps 1", "court"),
    ("predictor.train", "--data store --out new --steps 1 --model moon", "model"),
    ("predictor.train", "--data store --out store --steps 1", "store"),
    ("predictor.train", "--data store --out new --steps 1 --causal-edges", "causal"),
    ("predictor.train", "--data store --out new --steps 1 --label-weight 1", "label"),
    ("predictor.train", "--data store --out new --steps 1 --capture", "capture"),
    ("predictor.evaluate", "--checkpoint highway --data court --out new", "court"),
    ("predictor.interpret", "--checkpoint constant-velocity --data store --out new", "constant-velocity"),
    ("predictor.interpret", "--checkpoint checkpoint --data court --out new", "court"),
    ("predictor.card", "--checkpoint constant-velocity --data store --accuracy accuracy.json", "constant-velocity"),
    ("predictor.data.crowd", "--source store --out store", "store"),
    ("predictor.data.crowd", "--source store --out new --at-step 50 --episode-steps 5", "at_step"),
    ("predictor.data.mocap", "--source csv --out new", "csv"),
    ("predictor.data.levelx", "--source mocap --out new", "mocap"),
    ("predictor.data.levelx", "--source csv --out new --dt-s 0.03", "dt_s"),
    ("predictor.data.sdd", "--source csv --out new", "csv"),
    ("predictor.data.nba", "--source csv --out new", "csv"),
    ("predictor.data.nba", "--source nba --out new --format sportvu", "nba"),
    ("predictor.data.tracks", "--source csv --out new", "csv"),
    ("predictor.data.tracks", "--source walk --out walk --overwrite", "walk"),
    ("envs.collect", "--env-id highway-fast-v0 --out new --perturb-kinds brake", "perturb"),
    ("envs.collect", "--env-id highway-fast-v0 --out new --branches 1 --perturb 0.5", "branches"),
    ("envs.collect", "--env-id highway-fast-v0 --out new --causal-threshold-m 1", "causal"),
    ("envs.collect", "--env-id highway-fast-v0 --out new --driver heuristic --workers 1", "heuristic"),
    ("envs.collect", "--env-id highway-fast-v0 --out store --overwrite --perturb 2", "perturb"),
    ("envs.collect", "--env-id highway-fast-v0 --out csv --overwrite --workers 1", "csv"),
    ("envs.evaluate", "--env-ids merge-v1 merge-v1 --checkpoint merge merge", "merge"),
    ("envs.evaluate", "--env-ids racetrack-v1 --checkpoint simple-tag --episodes 1 --workers 1", "simple-tag"),
    ("envs.export_levelx", "--env-id highway-fast-v0 --out csv --overwrite", "csv"),
    ("agents.evaluate", "--run-dir run --policy idle", "run-dir"),
    ("agents.evaluate", "--policy idle --out new", "env-id"),
    ("agents.evaluate", "--policy idle --env-id highway-fast-v0 --out new --checkpoint highway", "checkpoint"),
    ("agents.evaluate", "--run-dir run --timeout-s nan", "timeout_s"),
    ("agents.evaluate", "--run-dir run --timeout-s -1", "timeout_s"),
    ("agents.watch", "run --window --out a.mp4", "--window"),
    ("agents.watch", "run --out file/a.mp4", "file"),
    ("agents.study", "--study toml/mine.toml --out csv", "csv"),
    ("agents.study", "--study preset.toml --out new", "preset.toml"),
    ("agents.tune", "--env-id highway-fast-v0 --algorithm sac --out new", "sac"),
    ("agents.tune", "--env-id highway-fast-v0 --out csv", "csv"),
    ("train_policy", "--preset toml/mine.toml --out new", "mine.toml"),
    ("train_policy", "--preset preset.toml --algorithm dqn --set batch_size=-3 --out new", "batch_size"),
    ("train_policy", "--observe none --what-if --out new", "what"),
    ("train_policy", "--observe none --checkpoint highway --out new", "checkpoint"),
    ("train_policy", "--learners adversary --out new", "learners"),
    ("train_policy", "--backend envpool --env-id simple_tag_v3 --out new", "envpool"),
    ("train_policy", "--env-id simple_tag_v3 --what-if --out new", "what"),
    ("train_policy", "--out csv", "csv"),
    ("train_policy", "--out csv --resume", "csv"),
    ("train_policy", "--out run --resume", "run"),
    ("train_policy", "--algorithm tqc --out new", "tqc"),
)
"""Commands, words that do not go together, and a part of the line."""


def contradictions() -> Iterator[Attempt]:
    """Yields options that do not go together, or not with what the files hold."""
    for command, words, expected in CONTRADICTIONS:
        yield Attempt(command, tuple(words.split()), (expected, expected.replace("_", "-")), words)


VARIABLES: dict[str, tuple[str, ...]] = {
    "OMP_NUM_THREADS": ("a", "-1", "99999999999"),
    "COLUMNS": ("a", "-5", "0"),
    "TERM": ("", "moon"),
    "NO_COLOR": ("1",),
    "TMPDIR": ("absent", "file", "fifo"),
    "HOME": ("absent", "fifo", ""),
    "PYTHONHASHSEED": ("a",),
    "CUDA_VISIBLE_DEVICES": ("moon", "-1", "99"),
    "SDL_VIDEODRIVER": ("moon",),
    "LANG": ("moon",),
    "TZ": ("moon",),
    "SOURCE_DATE_EPOCH": ("a", "-1"),
    "GIT_DIR": ("absent", "fifo"),
    "MPLBACKEND": ("moon",),
    "MPLCONFIGDIR": ("file", "fifo"),
}
"""Environment variable → values."""


@dataclass(frozen=True)
class Surrounded:
    """A command that must be refused as ever, with an environment variable that makes no sense."""

    attempt: Attempt
    """Command line."""
    variable: str
    """Name of the variable."""
    value: str
    """Its value."""

    @property
    def title(self) -> str:
        """Name of the trial."""
        return f"{self.variable}={self.value}: {self.attempt.command}"

    @property
    def expected(self) -> tuple[str, ...]:
        """Parts of the line."""
        return self.attempt.expected

    def run(self) -> None:
        """Runs the command in this process."""
        os.environ[self.variable] = self.value
        self.attempt.run()


def environment() -> Iterator[Surrounded]:
    """Yields environment variables that make no sense."""
    refused = (
        Attempt("predictor.train", ("--data", "absent", "--out", "new"), ("absent",), "no data"),
        Attempt("envs.collect", ("--env-id", "nope-v0", "--out", "new"), ("nope-v0",), "no environment"),
    )
    for variable, values in VARIABLES.items():
        for value in values:
            yield from (Surrounded(attempt, variable, value) for attempt in refused)
