"""Estimates of memory, so that what cannot fit is refused before it is allocated."""

import contextlib
from pathlib import Path

from predictor.support.errors import UserError

ITEM_BYTES = 512
"""Least memory of one episode, rollout or forecast that is kept with its results."""
PROCESS_BYTES = 150 * 2**20
"""Least memory of a worker process: Python, NumPy and torch, measured on Linux."""
ENV_BYTES = 2**20
"""Least memory of an environment inside a process, with its observations."""
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
"""Limits of a container, of version 2 and 1."""


def memory_bytes() -> int | None:
    """Returns the memory of this machine, or of the container; None on systems that do not say.

    Not what is free now: that changes, and the estimates are of what can never fit.
    """
    found = []
    with contextlib.suppress(OSError, ValueError):
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        found.append(1024 * sum(int(lines[name].split()[0]) for name in ("MemTotal", "SwapTotal") if name in lines))
    for file in _LIMITS:
        with contextlib.suppress(OSError, ValueError):
            found.append(int(file.read_text()))
    return min(found, default=None)


def check_memory(needed_bytes: int, what: str, advice: str, available_bytes: int | None = None) -> None:
    """Checks an estimate against the machine's memory.

    Args:
        needed_bytes: lower bound of what is needed.
        what: what needs it, for the message.
        advice: what to do, for the message.
        available_bytes: memory of another device; None takes `memory_bytes`.

    Raises:
        UserError: it is more than there is.
    """
    available = memory_bytes() if available_bytes is None else available_bytes
    if available is not None and needed_bytes > available:
        raise UserError(
            f"{what} needs at least {needed_bytes / 2**30:,.1f} GiB, and there are {available / 2**30:,.1f} GiB; "
            f"{advice}"
        )


def check_count(count: int, name: str, each_bytes: int = ITEM_BYTES) -> None:
    """Checks that this many things of at least `each_bytes` fit into the memory.

    Args:
        count: number of things; 0 always fits.
        name: name of the option, or of several that are multiplied ("episodes times max_steps"), for the message.
        each_bytes: least size of each.

    Raises:
        UserError: they do not fit.
    """
    options = " or ".join(f"--{option.replace('_', '-')}" for option in name.split(" times "))
    check_memory(count * each_bytes, f"{name}={count:,}", f"pass a smaller {options}")
