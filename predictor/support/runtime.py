"""How the process uses the machine: memory that stays mapped, who multiplies matrices, and how precisely.

Entry points call `tune`; it changes no result beyond the last bits. `precision` does what it says.
"""

import contextlib
import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from functools import cache
from typing import Literal

import torch

from predictor.support.errors import UserError

Precision = Literal["float32", "bfloat16"]
"""Of products and convolutions: "bfloat16" rounds their inputs and results; weights, states and losses stay float32."""

# glibc's <malloc.h>
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4
_LARGEST = 2**31 - 1


def resolve_device(device: str) -> str:
    """Returns the torch device of a name: cpu, cuda, cuda:N, or auto, which is cuda where torch finds such a device.

    Raises:
        UserError: another name, or no such device in this machine.
    """
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(device)
    except RuntimeError:
        kind = None
    if kind is None or kind.type not in ("cpu", "cuda"):
        raise UserError(f"device must be cpu, cuda or auto, got '{device}'")
    if kind.type == "cuda" and not torch.cuda.is_available():
        raise UserError(f"device '{device}' was asked for but torch finds no CUDA device; use --device cpu")
    return device


def tune(device: str = "cpu") -> None:
    """Settings for a process of our own: freed memory is kept, products take the faster library.

    Args:
        device: where tensors live; the setting behind the second would let products on CUDA round to TF32.
    """
    keep_freed_memory()
    if device == "cpu":
        prefer_onednn()


@cache
def keep_freed_memory() -> bool:
    """Let glibc keep freed memory instead of handing it back to the kernel; whether it could be done.

    Training steps and forecasts allocate and free the same large tensors again and again. By default each of them is
    mapped and cleared anew, which costs as much as the arithmetic on it. The process's resident size stays at its peak
    instead.
    """
    if not sys.platform.startswith("linux") or platform.libc_ver()[0] != "glibc":
        return False
    options = {_M_MMAP_MAX: 0, _M_TRIM_THRESHOLD: _LARGEST, _M_TOP_PAD: 2**26}
    mallopt = ctypes.CDLL(None).mallopt
    return all(mallopt(option, value) == 1 for option, value in options.items())


@cache
def prefer_onednn() -> bool:
    """Leave float32 matrix products to oneDNN where torch's default, MKL, is slow; whether it was done.

    MKL keeps its AVX-512 kernels for Intel's processors; on AMD's, oneDNN is twice as fast. torch asks oneDNN only if
    it may round inputs to bfloat16, so this is done only where oneDNN turns out not to.
    """
    if "AuthenticAMD" not in _cpu_info("vendor_id") or torch.backends.cpu.get_cpu_capability() != "AVX512":
        return False
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    if _products_are_exact():
        return True
    torch.set_float32_matmul_precision(before)
    return False


def _products_are_exact() -> bool:
    """Whether products of some shapes and layouts are as precise as float32 is; bfloat16 would be 4,000 times worse."""
    noise = torch.Generator().manual_seed(0)
    for rows, inner, columns in ((64, 64, 64), (1024, 48, 96), (300, 256, 256)):
        a, b = (torch.randn(shape, generator=noise) for shape in ((rows, inner), (inner, columns)))
        exact = a.double() @ b.double()
        for product in (a @ b, (b.t() @ a.t()).t(), torch.addmm(torch.zeros(columns), a, b)):
            if (product - exact).abs().max() > 1e-6 * inner:
                return False
    return True


@contextlib.contextmanager
def precision(kind: Precision, device: str) -> Iterator[None]:
    """Products at this precision while it lasts, by autocast; pays where the processor multiplies bfloat16 natively."""
    with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=kind == "bfloat16"):
        yield


def processor() -> str:
    """The processor's name as the operating system gives it, and how many logical cores there are."""
    names = _cpu_info("model name")
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} logical cores"


def _cpu_info(field: str) -> list[str]:
    """Values of a field of Linux's list of processors; none elsewhere."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        return [line.split(":", 1)[1].strip() for line in file if line.startswith(field)]
    return []
