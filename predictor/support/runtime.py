"""Use of the machine by the process: device, memory that stays mapped, library and precision of matrix products.

Entry points call `tune`, which changes results in the last bits only; `precision` changes them as its name says.
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
"""Precision of products: "bfloat16" rounds their inputs and results; weights, states and losses stay float32."""

_OF_ONEDNN: Literal["medium"] = "medium"
"""torch's precision of products with which it uses oneDNN."""
_before_onednn: list[str] = []
"""The precision that `prefer_onednn` replaced, if it did."""

# glibc's <malloc.h>
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4
_LARGEST = 2**31 - 1


def resolve_device(device: str) -> str:
    """Returns the torch device of a name: cpu, cuda, cuda:N, or auto, which is cuda where torch finds such a device.

    Raises:
        UserError: the name is another one, or this machine has no such device.
    """
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(device)
    except (RuntimeError, TypeError):
        kind = None
    if kind is None or kind.type not in ("cpu", "cuda"):
        raise UserError(f"device must be cpu, cuda or auto, got '{device}'")
    if kind.type == "cuda":
        found = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (kind.index or 0) >= found:
            devices = f"{found or 'no'} CUDA device{'s' if found > 1 else ''}"
            raise UserError(f"device '{device}' was asked for but torch finds {devices}; use --device cpu")
    return device


def tune(device: str = "cpu") -> None:
    """Sets a process up for speed: freed memory is kept, matrix products use the faster library.

    Args:
        device: device of the tensors; on CUDA the library is not set, and set back if it was, since that would let
            products round to TF32.
    """
    keep_freed_memory()
    if device == "cpu":
        prefer_onednn()
    elif _before_onednn:
        torch.set_float32_matmul_precision(_before_onednn.pop())


@cache
def keep_freed_memory() -> bool:
    """Makes glibc keep freed memory instead of returning it to the kernel; returns whether this was possible.

    Training steps and forecasts allocate and free large tensors of equal sizes repeatedly. By default each of them is
    mapped and cleared anew, which costs as much as the arithmetic on it. The process's resident size stays at its peak
    instead.
    """
    if not sys.platform.startswith("linux") or platform.libc_ver()[0] != "glibc":
        return False
    options = {_M_MMAP_MAX: 0, _M_TRIM_THRESHOLD: _LARGEST, _M_TOP_PAD: 2**26}
    mallopt = ctypes.CDLL(None).mallopt
    return all(mallopt(option, value) == 1 for option, value in options.items())


def prefer_onednn() -> bool:
    """Makes torch use oneDNN for float32 matrix products where its default, MKL, is slow; returns whether it does."""
    if _onednn_is_better() and (before := torch.get_float32_matmul_precision()) != _OF_ONEDNN:
        _before_onednn[:] = [before]
        torch.set_float32_matmul_precision(_OF_ONEDNN)
    return _onednn_is_better()


@cache
def _onednn_is_better() -> bool:
    """Returns whether oneDNN is faster here, and as exact.

    MKL uses its AVX-512 kernels on Intel's processors only; on AMD's, oneDNN is twice as fast. torch uses oneDNN only
    if it may round inputs to bfloat16, so this is set only where a test shows that oneDNN does not.
    """
    if "AuthenticAMD" not in _cpu_info("vendor_id") or torch.backends.cpu.get_cpu_capability() != "AVX512":
        return False
    with float32_products(_OF_ONEDNN):
        return _products_are_exact()


def _products_are_exact() -> bool:
    """Returns whether products of some shapes and layouts are as precise as float32; bfloat16 is 4,000 times worse."""
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
    """Computes products inside the block at this precision, by autocast; faster where bfloat16 is native."""
    with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=kind == "bfloat16"):
        yield


@contextlib.contextmanager
def float32_products(kind: Literal["highest", "high", "medium"]) -> Iterator[None]:
    """Sets torch's precision of products of float32 inside the block; "high" lets CUDA round their inputs to TF32."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(kind)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def processor() -> str:
    """Returns the processor's name as the operating system gives it, and the number of logical cores."""
    names = _cpu_info("model name")
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} logical cores"


def _cpu_info(field: str) -> list[str]:
    """Returns the values of a field of Linux's list of processors; none on other systems."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        return [line.split(":", 1)[1].strip() for line in file if line.startswith(field)]
    return []
