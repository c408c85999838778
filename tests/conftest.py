"""Settings for every test; nothing of this project is imported here, so that the shape checks see each module first."""

import os
import signal
from collections.abc import Iterator

import jaxtyping
import pytest

# A shell starts what runs in its background with Ctrl-C ignored, and every process of the tests would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Processes that tests start have one thread too; read when torch and numpy are imported, in this process as well.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import torch  # noqa: E402
from highway_env.vehicle.behavior import IDMVehicle  # noqa: E402
from hypothesis import settings  # noqa: E402

# The same examples in every run, however busy the machine is.
settings.register_profile("suite", max_examples=50, deadline=None, derandomize=True, database=None, print_blob=True)
settings.load_profile("suite")

# Tensors are tiny here: a second thread costs more than it brings, above all when tests run in parallel.
torch.set_num_threads(1)


AS_SHIPPED = {name: getattr(IDMVehicle, name) for name in ("DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN")}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves the tests of the shape checks out where shapes are not checked; `make test-shapes` has them."""
    if not config.getoption("--jaxtyping-packages"):
        for item in items:
            if item.get_closest_marker("shapes"):
                item.add_marker(pytest.mark.skip(reason="shapes are not checked; make test-shapes does"))


@pytest.fixture(autouse=True)
def unchecked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Switches the shape checks off in tests that pass what has a wrong shape or type: they would complain first."""
    if request.node.get_closest_marker("unchecked"):
        monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(autouse=True)
def pristine_drivers() -> Iterator[None]:
    """highway-env's intersection changes every IDM driver of the process; no test may depend on who ran before it.

    Values are put back after each test, so that fixtures of a module, which come before those of a test, see them too.
    """
    yield
    for name, value in AS_SHIPPED.items():
        setattr(IDMVehicle, name, value)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Commands set the threads of their process; the tests after one that ran here have one thread again."""
    yield
    torch.set_num_threads(1)
