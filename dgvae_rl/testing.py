"""Checks of what users bring: `check_reader(env, reader)` and `check_forecaster(forecaster)`.

Each raises a `UserError` with one line for each thing that is wrong, and returns nothing where nothing was found;
`reader_problems` and `forecaster_problems` return the lines. They are `envs.testing` and `predictor.testing`, where
what is checked is said; `check_forecaster` needs no simulator.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from envs.testing import check_reader, reader_problems
    from predictor.testing import check_forecaster, forecaster_problems

PACKAGE_OF = {
    "check_forecaster": "predictor", "check_reader": "envs", "forecaster_problems": "predictor",
    "reader_problems": "envs",
}  # fmt: skip

__all__ = ["check_forecaster", "check_reader", "forecaster_problems", "reader_problems"]


def __getattr__(name: str) -> Any:
    """Imports the module of a public name and returns the name's value."""
    if name not in PACKAGE_OF:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"dgvae_rl.{PACKAGE_OF[name]}.testing"), name)
