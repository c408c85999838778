"""What a driver's name stands for, as a hash: a recording that is taken up again must not mix two drivers."""

import hashlib
import importlib.util
from pathlib import Path

from envs.drivers.planner import ORACLE, is_planner, planner_checkpoint
from predictor.checkpoint import CONSTANT_VELOCITY, WEIGHTS, resolve
from predictor.own_forecasters import PREFIX, is_own


def content_of(driver: str) -> str | None:
    """Returns the SHA-256 of a policy's zip, a planner's weights, or the module of one's own driver or forecaster.

    None for drivers that are named, not read from a file.
    """
    file = _file_of(driver)
    if file is None or not file.is_file():
        return None
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _file_of(driver: str) -> Path | None:
    if driver.endswith(".zip"):
        return Path(driver)
    planned = planner_checkpoint(driver) if is_planner(driver) else ""
    if is_own(driver) or is_own(planned):
        module, colon, _ = (planned or driver).removeprefix(PREFIX).partition(":")
        found = importlib.util.find_spec(module) if colon else None
        return None if found is None or found.origin is None else Path(found.origin)
    return None if planned in ("", ORACLE, CONSTANT_VELOCITY) else resolve(planned) / WEIGHTS
