"""Addresses of clusters, and what is said where none answers; tasks on a cluster are in tests/test_cluster.py."""

import builtins
import contextlib
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from predictor.support import cluster
from predictor.support.cluster import check_address, connected
from predictor.support.errors import UserError


@contextlib.contextmanager
def listening(answer: bytes | None) -> Iterator[str]:
    """A machine that sends this to whoever connects; None: that says nothing."""
    with socket.create_server(("0.0.0.0", 0)) as server:
        links: list[socket.socket] = []

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    links.append(server.accept()[0])
                    if answer is not None:
                        links[-1].sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)
        thread.join()
        for link in links:
            link.close()


@pytest.mark.parametrize("address", [None, "auto", "10.0.0.1:6379", "head:1", "head.example.org:65535"])
def test_addresses_are_auto_or_a_host_with_a_port(address: str | None):
    check_address(address)


@pytest.mark.parametrize("address", ["", "10.0.0.1", "head:", "head:0", "head:65536", "ray://head:10001", "local"])
def test_other_addresses_are_refused(address: str):
    with pytest.raises(UserError, match=r"cluster must be auto or HOST:PORT \(as in 10.0.0.1:6379\), got '"):
        check_address(address)


def test_without_an_address_there_is_no_cluster():
    with connected(None, ()) as found:
        assert found is None


def test_without_ray_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "ray"]:
        monkeypatch.delitem(sys.modules, name)
    load = builtins.__import__

    def without_ray(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.partition(".")[0] == "ray":
            raise ModuleNotFoundError("No module named 'ray'", name="ray")
        return load(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_ray)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError) as error, connected("auto", ()):
        pass
    assert str(error.value) == cluster.INSTALL


def test_a_machine_that_is_no_cluster_is_named_at_once(monkeypatch: pytest.MonkeyPatch):
    """Ray itself would try for two minutes."""
    pytest.importorskip("ray", reason="Ray is not installed; pip install 'dgvae-rl[ray]'")
    monkeypatch.setattr(cluster, "ANSWER_S", 0.5)
    before, began = signal.getsignal(signal.SIGTERM), time.monotonic()
    with socket.create_server(("0.0.0.0", 0)) as closed:
        nobody = f"127.0.0.1:{closed.getsockname()[1]}"
    with listening(b"HTTP/1.1 400 Bad Request\r\n\r\n") as web, listening(None) as silent:
        for address, reason in (
            (nobody, r"\[Errno \d+\] Connection refused"),
            (web, "something else listens there"),
            (silent, "timed out"),
        ):
            with pytest.raises(UserError, match=f"^no Ray cluster answers at {address} \\({reason}\\); start one with"):
                with connected(address, ()):
                    pass
    assert time.monotonic() - began < 60 and signal.getsignal(signal.SIGTERM) is before


def test_where_none_runs_auto_says_so(monkeypatch: pytest.MonkeyPatch):
    services = pytest.importorskip("ray._private.services", reason="Ray is not installed; pip install 'dgvae-rl[ray]'")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(services, "find_gcs_addresses", set)
    monkeypatch.setattr(services, "find_bootstrap_address", lambda folder: None)
    with pytest.raises(UserError, match="^no Ray cluster runs on this machine .*; start one with ray start --head"):
        with connected("auto", ()):
            pass
