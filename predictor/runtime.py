"""How the process uses the machine: memory that stays mapped, threads, and the precision of matrix products.

Nothing here changes a result, except `matmul_precision` where it says so. Entry points call it; models do not.
"""

import contextlib
import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from typing import Literal

import torch

Precision = Literal["float32", "bfloat16"]
"""Of matrix products: "bfloat16" rounds their inputs, sums stay float32."""

# glibc's <malloc.h>
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4
_LARGEST = 2**31 - 1


def keep_freed_memory() -> bool:
    """Let glibc keep freed memory instead of handing it back to the kernel; whether it could be done.

    A training step allocates and frees the same large tensors again and again. By default each of them is mapped and
    cleared anew, which costs more than the arithmetic on it (benchmarks/training.py has the ratio). The process's
    resident size stays at its peak instead.
    """
    if not sys.platform.startswith("linux") or platform.libc_ver()[0] != "glibc":
        return False
    options = {_M_MMAP_MAX: 0, _M_TRIM_THRESHOLD: _LARGEST, _M_TOP_PAD: 2**26}
    mallopt = ctypes.CDLL(None).mallopt
    return all(mallopt(option, value) == 1 for option, value in options.items())


@contextlib.contextmanager
def matmul_precision(precision: Precision) -> Iterator[None]:
    """Matrix products of float32 tensors at this precision, while it lasts; of torch's global setting.

    "bfloat16" is faster only where the processor multiplies it natively, and changes results by about 0.4 % of a
    product's inputs.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium" if precision == "bfloat16" else "highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def processor() -> str:
    """The processor's name as the operating system gives it, and how many logical cores there are."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
        name = names[0] if names else name
    return f"{name}, {os.cpu_count()} logical cores"
