"""Lazy exports: a package exports names of its modules and imports each module only when one of its names is used.

`from envs import VectorForecast` must not need the packages of `envs.sb3`, so `envs/__init__.py` cannot import its
modules. It lists them instead, and once more under `TYPE_CHECKING` for type checkers and editors.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

EXTRA_OF = {
    "gymnasium": "envs", "highway_env": "envs", "pettingzoo": "envs", "mpe2": "envs",
    "stable_baselines3": "rl", "sb3_contrib": "contrib", "envpool": "envpool",
}  # fmt: skip
"""Extra of dgvae-rl that brings a package, of those that exported names need."""


def lazy_exports(package: str, modules: Mapping[str, Sequence[str]]) -> tuple[Callable[[str], Any], list[str]]:
    """Creates `__getattr__` and `__all__` of a package.

    Args:
        package: name of the package, for the error message.
        modules: names that each module exports, by the module's name.

    Returns:
        A function that imports the module of a name and returns the name's value, with an AttributeError for other
        names, and a ModuleNotFoundError that names the extra where a package is missing; and the sorted names.
    """
    module_of = {name: module for module, names in modules.items() for name in names}
    above = package.rpartition(".")[0]  # "dgvae_rl" where a user's folder hides the package (dgvae_rl.own_packages)

    def load(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        try:
            return getattr(importlib.import_module(f"{above}.{module_of[name]}".lstrip(".")), name)
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing not in EXTRA_OF:
                raise
            install = f"pip install 'dgvae-rl[{EXTRA_OF[missing]}]'"
            sentence = f"'{name}' needs the package '{missing}', which is not installed; {install}"
            raise ModuleNotFoundError(sentence, name=error.name) from error

    return load, sorted(module_of)
