"""Commands on a cluster of three nodes on this machine, one of which is killed: results are those of one machine."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from agents.study import StudyConfig, run_study
from envs import collect
from envs.collect import CollectConfig
from envs.evaluate import EvaluateConfig, evaluate_env
from envs.rollouts.cluster_pool import ClusterPool
from envs.rollouts.workers import Failed
from envs.supervision import EnvironmentFailedError
from predictor.data.springs import SpringsConfig, make
from predictor.suite import SuiteConfig, run_suite
from predictor.support.cluster import check_shared, connected
from predictor.support.errors import UserError
from predictor.support.reading import read_object
from tests.agents.studies.helpers import SLOW_TOY, study_path, study_text
from tests.envs.misbehaving import env_id
from tests.envs.test_collect import assert_same_episodes

ray: Any = pytest.importorskip("ray", reason="Ray is not installed; pip install 'dgvae-rl[ray]'")

pytestmark = pytest.mark.cluster
PATIENCE_S = 300.0
"""Longest time that is waited for something on a busy machine [s]."""
SETTINGS = {"num_cpus": 1, "object_store_memory": 80_000_000}


class Nodes:
    """Three nodes on this machine, with one CPU each; the first is the head."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster as LocalCluster

        self._cluster: Any = LocalCluster(initialize_head=True, head_node_args=SETTINGS | {"include_dashboard": False})
        self._others: list[Any] = []
        self.complete()

    @property
    def address(self) -> str:
        return str(self._cluster.address)

    def complete(self) -> None:
        """Puts new nodes where some were killed."""
        while len(self._others) < 2:
            self._others.append(self._cluster.add_node(**SETTINGS))

    def busy(self) -> Any:
        """Returns a node, not the head, whose process runs a task; None if there is none."""
        for node in self._others:
            (raylet,) = node.all_processes["raylet"]
            if any("ray::_run" in words_of(child) for child in children(raylet.process.pid)):
                return node
        return None

    def tasks(self) -> list[int]:
        """Returns the processes that run a task, on all nodes."""
        raylets = [node.all_processes["raylet"][0].process.pid for node in (self._cluster.head_node, *self._others)]
        return [child for raylet in raylets for child in children(raylet) if "ray::_run" in words_of(child)]

    def kill(self, node: Any) -> None:
        self._others.remove(node)
        self._cluster.remove_node(node, allow_graceful=False)

    def shut_down(self) -> None:
        self._cluster.shutdown()


def children(pid: int) -> list[int]:
    with contextlib.suppress(OSError):
        return [int(c) for c in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def words_of(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    return ""


STAY = ("multiprocessing.resource_tracker", "multiprocessing.forkserver")
"""Helpers of Python's that stay with the process of the tests."""


def processes_with(mark: str) -> list[int]:
    """Returns the processes whose environment has the mark."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            pid = int(path.parent.name)
            if mark.encode() in path.read_bytes() and not any(name in words_of(pid) for name in STAY):
                found.append(pid)
    return found


def wait_until(holds: Callable[[], Any], what: str) -> Any:
    until = time.monotonic() + PATIENCE_S
    while not (found := holds()):
        assert time.monotonic() < until, what
        time.sleep(0.05)
    return found


@pytest.fixture(scope="module")
def nodes() -> Iterator[Nodes]:
    mark = f"cluster-of-{os.getpid()}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")  # 15 by default: a busy machine would never come to them
        patch.setenv("PYTHONPATH", os.getcwd())
        patch.setenv("OF_THESE_TESTS", mark)
        made = Nodes()
        yield made
        made.shut_down()
        wait_until(lambda: not set(processes_with(mark)) - {os.getpid()}, "processes are left")


@contextlib.contextmanager
def one_killed(nodes: Nodes, begun: Callable[[], Any] = lambda: True) -> Iterator[None]:
    """Kills a node inside the block, once something has begun and while the node runs a task."""
    nodes.complete()
    killed: list[Any] = []

    def kill() -> None:
        wait_until(begun, "nothing began")
        killed.append(wait_until(nodes.busy, "no node is busy"))
        nodes.kill(killed[0])

    thread = threading.Thread(target=kill)
    thread.start()
    yield
    thread.join()
    assert killed


# --- Episodes -----------------------------------------------------------------------------------------------------


class Slow(NamedTuple):
    """Episode that takes its time and says where it is."""

    env_id: str
    seed: int
    task: Any
    folder: Path


def record_slowly(slow: Slow) -> Any:
    (slow.folder / f"{slow.seed}-{os.getpid()}").touch()
    time.sleep(1.0)
    return collect._record(slow.task)


def test_episodes_of_a_node_that_is_killed_are_played_elsewhere(nodes: Nodes, tmp_path: Path):
    config = CollectConfig("two-way-v0", tmp_path / "store", episodes=9, max_steps=3, workers=1)
    settings = collect.recording_of(config)
    tasks = [
        Slow(config.env_id, seed, collect._Task(config.env_id, "random", seed, settings, ""), tmp_path)
        for seed in range(9)
    ]
    with ClusterPool(record_slowly, nodes.address) as pool, one_killed(nodes, lambda: any(tmp_path.iterdir())):
        found = [episode for result in pool.results(tasks) for episode in result]
        assert pool.size in (2, 3)
    assert_same_episodes(found, [episode for task in tasks for episode in collect._record(task.task)])
    assert all(episode.states.flags.writeable for episode in found)
    assert not ray.is_initialized()


def test_collection_and_evaluation_are_those_of_one_machine(nodes: Nodes, tmp_path: Path):
    config = CollectConfig("two-way-v0", tmp_path / "store", episodes=4, max_steps=3, workers=1)
    there = EvaluateConfig(
        ("two-way-v0",), checkpoint=("constant-velocity",), episodes=4, max_steps=8, horizon_steps=3, num_samples=2
    )
    here = replace(there, workers=1)
    with ClusterPool(collect._played, nodes.address):  # one connection for all that follows
        assert_same_episodes(
            list(collect.collect(replace(config, cluster=nodes.address))), list(collect.collect(config))
        )
        with one_killed(nodes):
            (result, cases) = evaluate_env(replace(there, cluster=nodes.address), "two-way-v0", "constant-velocity")
    (expected, expected_cases) = evaluate_env(here, "two-way-v0", "constant-velocity")
    without_time(result, expected)
    assert [case.error_m for case in cases] == [case.error_m for case in expected_cases]


def without_time(result: Any, expected: Any) -> None:
    left, right = asdict(result), asdict(expected)
    assert left.keys() == right.keys()
    for name in left:
        if "ms" not in name.split("_"):
            assert repr(left[name]) == repr(right[name]), name


@pytest.mark.parametrize(("kind", "reason"), [("Raise", "step 2: RuntimeError: "), ("Kill", "step 2: its process was")])
def test_environments_that_fail_are_named_and_not_tried_again(nodes: Nodes, kind: str, reason: str):
    config = CollectConfig(env_id(kind), Path("unused"), workers=1)
    tasks = [collect._Task(config.env_id, "random", seed, collect.recording_of(config), "") for seed in (0, 1)]
    with ClusterPool(collect._record, nodes.address, on_error="skip") as pool:
        failed, played = pool.play(tasks)
        assert isinstance(failed, Failed) and failed.reason.startswith(f"{env_id(kind)}, seed 0, {reason}")
        assert not isinstance(played, Failed)
        pool._on_error = "stop"
        with pytest.raises(EnvironmentFailedError, match=f"seed 0, {reason}"):
            list(pool.play(tasks))


# --- Studies and suites -------------------------------------------------------------------------------------------


def cells_of(folder: Path) -> dict[str, Any]:
    """Returns the results of cells, without times."""
    found = {}
    for path in folder.glob("cells/*/result.json"):
        content = read_object(path)
        curve = [{k: v for k, v in point.items() if k != "seconds"} for point in content["curve"]]
        found[path.parent.name] = content["episodes"], curve
    return found


def test_a_study_is_that_of_one_machine(nodes: Nodes, tmp_path: Path):
    path = study_path(tmp_path, study_text(env_id=SLOW_TOY, references='["random"]', seeds="2"))
    here, there = tmp_path / "here", tmp_path / "there"
    with one_killed(nodes, lambda: list(there.glob("cells/*/result.json"))):
        assert run_study(StudyConfig(str(path), there, cluster=nodes.address)) == 0
    assert run_study(StudyConfig(str(path), here, workers=2)) == 0
    assert cells_of(there) == cells_of(here) and len(cells_of(here)) == 3


@pytest.mark.slow
def test_lines_of_a_suite_are_those_of_one_machine(nodes: Nodes, tmp_path: Path):
    data = tmp_path / "data"
    make(SpringsConfig(data / "springs", train=8, val=4, test=4, ood=4))
    config = SuiteConfig("springs", data, tmp_path / "here", "smoke", ("constant-velocity", "least-squares"))
    nodes.complete()
    there = run_suite(replace(config, out=tmp_path / "there", cluster=nodes.address))
    here = run_suite(replace(config, workers=2))
    assert not there["failed"]
    for ours, theirs in zip(there["rows"], here["rows"], strict=True):
        for kind, found in ours["tests"].items():
            same = {name: value for name, value in found.items() if name not in ("seconds", "peak_memory_mb")}
            assert repr(same) == repr({name: theirs["tests"][kind][name] for name in same})


# --- Tasks --------------------------------------------------------------------------------------------------------


def fail(error: Exception) -> None:
    raise error


def save_when_stopped(path: Path | None) -> None:
    if path is None:
        return
    path.with_suffix(".begun").touch()
    try:
        while True:
            time.sleep(0.1)
    except KeyboardInterrupt:
        path.touch()


def test_tasks_that_are_cancelled_get_time_to_save(nodes: Nodes, tmp_path: Path):
    with connected(nodes.address, ()) as cluster:
        assert cluster is not None
        running = cluster.results(save_when_stopped, [None, tmp_path / "saved"], saving_s=60.0)
        assert next(running) == (0, None)
        wait_until((tmp_path / "saved.begun").exists, "the other does not run")
        running.close()
        assert (tmp_path / "saved").exists()


def test_errors_come_as_they_are_and_what_is_left_is_cancelled(nodes: Nodes):
    with connected(nodes.address, ()) as cluster:
        assert cluster is not None
        with pytest.raises(UserError, match="^too small$"):
            list(cluster.results(fail, [UserError("too small")]))
        with pytest.raises(KeyError):
            list(cluster.results(fail, [KeyError("x")]))
        with pytest.raises(UserError, match="the cluster has none; add a machine or --device cpu"):
            list(cluster.results(fail, [None], gpus=1))
        running = cluster.results(time.sleep, [0.0, PATIENCE_S, PATIENCE_S, PATIENCE_S])
        assert next(running) == (0, None)
        wait_until(nodes.tasks, "the others do not run")
        began = time.monotonic()
        running.close()
        wait_until(lambda: not nodes.tasks(), "tasks are left")
        assert time.monotonic() - began < PATIENCE_S / 2


def test_other_versions_are_named(nodes: Nodes):
    with connected(nodes.address, ("numpy",)) as cluster:
        assert cluster is not None
        made_by = cluster._command.made_by
        other = {**made_by, "versions": {**made_by["versions"], "numpy": "1.0"}}
        cluster._command = replace(cluster._command, made_by=other)
        with pytest.raises(UserError, match=r"has numpy [\d.]+ and not 1.0 as the one of the command"):
            list(cluster.results(fail, [None]))


def test_a_machine_that_does_not_see_the_folder_says_so(nodes: Nodes, tmp_path: Path):
    with connected(nodes.address, ()) as cluster:
        assert cluster is not None
        with pytest.raises(UserError, match=f"does not see what is written to {tmp_path}; with --cluster the folder"):
            list(cluster.results(check_shared, [tmp_path]))


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_command_and_its_tasks(nodes: Nodes, tmp_path: Path, number: signal.Signals):
    nodes.complete()
    mark = f"command-{number}-{os.getpid()}"
    words = f"-m envs.collect --env-id two-way-v0 --episodes 5000 --cluster {nodes.address} --out {tmp_path / 'store'}"
    with (tmp_path / "errors").open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, *words.split()], stderr=errors, stdout=errors, env=os.environ | {"MARK": mark}
        )
        wait_until(nodes.tasks, "no episode is played")
        process.send_signal(number)
        assert process.wait(PATIENCE_S) == 128 + number
    *_, line = (tmp_path / "errors").read_text().splitlines()
    assert line.startswith("stopped: ") and line.endswith(("the same command goes on", "the same command begins anew"))
    assert "Traceback" not in (tmp_path / "errors").read_text()
    wait_until(lambda: not processes_with(mark) and not nodes.tasks(), "a process is left")
