"""What a driver's name stands for, as a hash: a recording that is taken up again must not mix two drivers."""

import hashlib
import importlib.util
from pathlib import Path

from envs.drivers.planner import ORACLE, is_planner, planner_checkpoint
from predictor.checkpoint import CONSTANT_VELOCITY, WEIGHTS, resolve
from predictor.own_forecasters import is_own, module_of


def content_of(driver: str) -> str | None:
    """Returns the SHA-256 of a policy's zip, a planner's weights, or the module of one's own driver or forecaster.

    None for drivers that are named, not read from a file.
    """
    return _sha256(_file_of(driver))


def content_of_module(env_id: str) -> str | None:
    """Returns the SHA-256 of the module that registers an environment ("module:Id"); None for other ids."""
    module, colon, _ = env_id.partition(":")
    return _sha256(_file_of_module(module)) if colon else None


def _sha256(file: Path | None) -> str | None:
    if file is None or not file.is_file():
        return None
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _file_of(driver: str) -> Path | None:
    if driver.endswith(".zip"):
        return Path(driver)
    planned = planner_checkpoint(driver) if is_planner(driver) else ""
    if is_own(driver) or is_own(planned):
        return _file_of_module(module_of(planned or driver))
    return None if planned in ("", ORACLE, CONSTANT_VELOCITY) else resolve(planned) / WEIGHTS


def _file_of_module(module: str) -> Path | None:
    found = importlib.util.find_spec(module)
    return None if found is None or found.origin is None else Path(found.origin)
