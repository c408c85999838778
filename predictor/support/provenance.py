"""Provenance of a result: command, commit, versions, time; it is written to every run folder, store and checkpoint."""

import datetime
import functools
import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def provenance(packages: Sequence[str], command: str | None = None) -> dict[str, Any]:
    """Returns command line, git commit (with "+changes" if the tree is dirty), package versions, machine, UTC time."""
    if command is None:
        command = " ".join([*program(), *map(shlex.quote, sys.argv[1:])])
    return {
        "command": command.encode("utf-8", "backslashreplace").decode(),  # names of files may be no UTF-8
        "commit": commit_at_start(),
        "versions": {name: installed_version(name) for name in ("dgvae-rl", *packages)}
        | {"python": platform.python_version()},
        "machine": f"{platform.machine()}, {os.cpu_count()} logical cores",
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def program() -> list[str]:
    """Returns the words before the options: "dgvae collect", "python -m module" or "python script"."""
    first = sys.argv[0] or ""  # None for a module of dgvae_rl that is run by its path below it
    if first.startswith("dgvae "):
        return [first]
    return ["python", *_module_or_script()]


def _module_or_script() -> list[str]:
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    if spec is not None and spec.name != "__main__":
        return ["-m", spec.name.removesuffix(".__main__")]
    return [Path(sys.argv[0]).name]


def installed_version(package: str) -> str:
    """Returns the version of a package, or "not installed"."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


@functools.cache
def commit_at_start() -> str:
    """Returns the commit that was checked out at the first call, which commands make as they begin.

    A result is written hours later, when another commit may be checked out than the one whose code ran.
    """
    here = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=here, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # an installed package may lie below another project
        return git("rev-parse", "--short=12", "HEAD") + ("+changes" if git("status", "--porcelain", "-uno") else "")
    except (subprocess.CalledProcessError, FileNotFoundError):
        return "unknown"
