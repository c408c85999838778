"""Ctrl-C and SIGTERM, sent to real processes: one line, the right status, state saved, no process left."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.storm.running import orphans, start
from tests.storm.subjects import SUBJECTS, make_inputs

BEGUN: dict[str, Callable[[Path], bool]] = {
    "train": lambda out: (out / "run" / "train_state.pt").exists(),
    "policy": lambda out: (out / "run" / "checkpoint.zip").exists(),
    "collect": lambda out: (out / ".store.unfinished").exists(),
    "study": lambda out: any((out / "study" / "cells").glob("*/result.json")),
}
"""When there is something to keep."""
LINES = {
    "train": "stopped: its state is saved in {out}/run; the same command with --resume goes on",
    "policy": "stopped: the latest checkpoint is in {out}/run; the same command with --resume goes on",
    "collect": "stopped: * of 24 episodes are kept beside {out}/store; the same command goes on",
    "study": "stopped: the same command goes on: finished cells are kept, others continue",
}
PATIENCE_S = 600.0


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("train", signal.SIGINT),
        ("policy", signal.SIGINT),
        ("collect", signal.SIGTERM),
        ("study", signal.SIGINT),
    ],
)
def test_a_signal_ends_a_command_in_one_line(inputs: Path, tmp_path: Path, name: str, number: signal.Signals):
    """Ctrl-C reaches the whole group, as from a terminal; SIGTERM the command alone."""
    out, errors = tmp_path / "out", tmp_path / "errors"
    run = start(SUBJECTS[name].words(inputs, out), tmp_path / "log", errors)
    try:
        until = time.monotonic() + PATIENCE_S
        while not BEGUN[name](out):
            assert run.process.poll() is None and time.monotonic() < until, run.said() + errors.read_text()
            time.sleep(0.02)
        (os.killpg if number == signal.SIGINT else os.kill)(run.process.pid, number)
        assert run.process.wait(PATIENCE_S) == 128 + number, errors.read_text()
    finally:
        run.process.kill()
    line = errors.read_text().removesuffix("\n")
    assert "\n" not in line
    before, _, after = LINES[name].format(out=out).rpartition("*")
    assert line.startswith(before) and line.endswith(after)
    assert orphans(run) == []
