"""Fixtures of these tests; nothing of this project is imported at the top, so that the shape checks see it first."""

import pytest


@pytest.fixture(scope="session")
def highway_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A tiny dG-VAE with random weights for ids that step at 1 s; its scenes are smaller than the reader's default."""
    from tests.envs.helpers import HIGHWAY_SPEC, save_tiny

    return save_tiny(tmp_path_factory.mktemp("checkpoints") / "tiny-highway", HIGHWAY_SPEC)


@pytest.fixture(scope="session")
def racetrack_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The same for ids that step at 0.2 s."""
    from tests.envs.helpers import RACETRACK_SPEC, save_tiny

    return save_tiny(tmp_path_factory.mktemp("checkpoints") / "tiny-racetrack", RACETRACK_SPEC)


@pytest.fixture(scope="session")
def checkpoint_of(highway_checkpoint: str, racetrack_checkpoint: str) -> dict[str, str]:
    """A tiny checkpoint that fits, for each registered id."""
    from envs.registry import CHECKPOINTS

    return {i: racetrack_checkpoint if i.startswith("racetrack") else highway_checkpoint for i in CHECKPOINTS}
