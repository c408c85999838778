"""Sizes of compressed chunks: a few kilobytes of zeros would unpack to all of the memory before Zarr looks at them."""

from collections.abc import Sequence
from pathlib import Path

from predictor.support.errors import UserError, short

CODECS = ("transpose", "bytes", "zstd", "crc32c")
"""Codecs of a chunk, each at most once and in this order: only one of them makes a chunk larger when it is read."""
_FRAME = (0xFD2FB528).to_bytes(4, "little")
_MOST_HEADER_BYTES = 18
_SLACK_BYTES = 4  # of a checksum


def check_codecs(names: Sequence[object], where: str) -> None:
    """Checks the codecs of an array.

    Raises:
        UserError: one is unknown, comes twice, or in another order.
    """
    known = [name for name in CODECS if name in names]
    if list(names) != known:
        raise UserError(
            f"{where}: codecs must be some of {', '.join(CODECS)}, in this order, got {short(repr(list(names)), 60)}"
        )


def check_unpacked(array: Path, chunk_bytes: int) -> None:
    """Checks the size that each chunk of an array declares in the header of its Zstandard frame (RFC 8878, 3.1.1.1).

    Args:
        array: folder of an array that is compressed by Zstandard.
        chunk_bytes: size of a chunk.

    Raises:
        UserError: a chunk declares no size, or a larger one.
    """
    for chunk in sorted(array.glob("c/**/*")):
        if chunk.is_file():
            with chunk.open("rb") as file:
                declared = _content_size(file.read(_MOST_HEADER_BYTES))
            if declared is None or declared > chunk_bytes + _SLACK_BYTES:
                name = chunk.relative_to(array).as_posix()
                raise UserError(
                    f"{array.parent}: chunk {name} of '{array.name}' is damaged (it must unpack to {chunk_bytes} "
                    f"bytes, got {declared}); copy or collect it anew"
                )


def _content_size(header: bytes) -> int | None:
    """Returns the size of a frame's content; None without one, or if it is no frame."""
    if len(header) < 6 or header[:4] != _FRAME:
        return None
    descriptor = header[4]
    is_single = descriptor >> 5 & 1
    begin = 5 + (1 - is_single) + (0, 1, 2, 4)[descriptor & 3]
    length = (is_single, 2, 4, 8)[descriptor >> 6]
    content = header[begin : begin + length]
    if not length or len(content) < length:
        return None
    return int.from_bytes(content, "little") + (256 if length == 2 else 0)
