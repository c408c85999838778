"""What tests of training runs share."""

from pathlib import Path

import pytest

from predictor.dgvae.config import PRESETS
from tests.predictor.helpers import FAST_LIKE, write_circles


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """The preset `fast` is as small as can be."""
    monkeypatch.setitem(PRESETS, "fast", FAST_LIKE)


@pytest.fixture(scope="module")
def circles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small store of circling agents."""
    return write_circles(tmp_path_factory.mktemp("data") / "circles")
