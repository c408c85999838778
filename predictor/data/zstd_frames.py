"""Size of what a file of zstd unpacks to, from the headers of its frame and blocks (RFC 8878), before it is unpacked.

A few kilobytes can unpack to gigabytes. Zarr looks at the size afterwards, numcodecs unpacks frame after frame, and
frames without a size without bound. What a store has is one frame that names its size, beyond which zstd never writes.
"""

from pathlib import Path
from typing import BinaryIO

_MAGIC = (0xFD2FB528).to_bytes(4, "little")
_RLE, _RESERVED = 1, 3
"""Type of a block that repeats one byte, and the one that is not in use."""


def unpacked_bytes(path: Path, trailer_bytes: int) -> int | None:
    """Returns the size of what a file unpacks to [bytes]; None if it is not one whole frame that names its size.

    Args:
        path: path of a regular file.
        trailer_bytes: number of bytes after the frame, of a checksum.
    """
    end = path.stat().st_size - trailer_bytes
    with path.open("rb", buffering=0) as file:
        head = file.read(6)
        if len(head) < 6 or head[:4] != _MAGIC:
            return None
        flags = head[4]
        is_single, has_checksum = bool(flags & 0x20), bool(flags & 0x04)
        size_bytes = (int(is_single), 2, 4, 8)[flags >> 6]
        at = 5 + int(not is_single) + (0, 1, 2, 4)[flags & 3]
        file.seek(at)
        field = file.read(size_bytes)
        if not size_bytes or len(field) < size_bytes:
            return None
        found = _end_of_blocks(file, at + size_bytes, end)
        if found is None or found + 4 * has_checksum != end:
            return None
        return int.from_bytes(field, "little") + (256 if size_bytes == 2 else 0)


def _end_of_blocks(file: BinaryIO, at: int, end: int) -> int | None:
    """Returns where the blocks that begin at a place end; None if they do not end before the file does."""
    is_last = False
    while not is_last:
        file.seek(at)
        header = int.from_bytes(file.read(3), "little")
        is_last, kind, size = bool(header & 1), (header >> 1) & 3, header >> 3
        at += 3 + (1 if kind == _RLE else size)
        if at > end or kind == _RESERVED:
            return None
    return at
