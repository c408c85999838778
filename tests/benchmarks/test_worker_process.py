import io
import sys
from typing import Any

import pytest
import torch

from benchmarks import worker_process
from benchmarks.worker_process import WorkerProcess, exact_memory, peak_rise


@pytest.mark.slow
def test_a_worker_measures_memory_and_reports_what_it_cannot_do():
    arguments: dict[str, Any] = {"preset": "fast", "neighbours": 0, "horizon": 2}
    with WorkerProcess(1, exact_memory()) as other:
        few, many = (other.ask("forecast", agents=agents, **arguments)["peak_bytes"] for agents in (20, 120))
        with pytest.raises(RuntimeError, match="in a process of its own: KeyError"):
            other.ask("forecast", agents=2, **(arguments | {"preset": "huge"}))
        again = other.ask("forecast", agents=120, **arguments)["peak_bytes"]
    if many is None:
        pytest.skip("no /proc/self/clear_refs here")
    assert many > 3 * few  # 36 times the pairs, beside what any call takes
    assert again == pytest.approx(many, rel=0.3)


def test_a_worker_that_dies_is_reported():
    with WorkerProcess(1) as other:
        other._process.kill()
        other._process.wait()
        with pytest.raises(RuntimeError, match="in a process of its own: it died"):
            other.ask("forecast")


def test_memory_that_proc_lacks_is_none(monkeypatch: pytest.MonkeyPatch):
    def lacking(name: str) -> int:
        raise OSError

    monkeypatch.setattr(worker_process, "_status_bytes", lacking)
    assert peak_rise(lambda: None) is None


def test_a_worker_takes_the_products_of_its_parent(monkeypatch: pytest.MonkeyPatch):
    """Else what is said of the allocator is in part said of the library of products."""
    taken: list[str] = []
    monkeypatch.setattr(worker_process, "prefer_onednn", lambda: taken.append("products"))
    monkeypatch.setattr(sys, "argv", ["worker_process", str(torch.get_num_threads())])
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    worker_process.main()
    assert taken == ["products"]
