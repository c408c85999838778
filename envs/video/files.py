"""Writes pictures (PNG) and videos (MP4), and keeps pictures small in memory."""

import io
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from predictor.support.files import new_file


def decode_png(data: bytes) -> Image.Image:
    """Returns the picture in PNG data."""
    return Image.open(io.BytesIO(data))


def encode_png(pixels: UInt8[np.ndarray, "height width 3"]) -> bytes:
    """Returns a picture as PNG data, about a hundredth of its size for highway-env's flat colours."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=1)
    return buffer.getvalue()


def write_video(path: str | Path, pictures: Iterable[UInt8[np.ndarray, "height width 3"]], fps: int) -> None:
    """Writes a video as MP4 (H.264, yuv420p); `path` is never a partial file.

    Args:
        path: path of the video.
        pictures: at least one, all of one size; height and width must be even for H.264.
        fps: number of pictures per second.
    """
    path = Path(path)
    rest = iter(pictures)
    first = next(rest)
    with new_file(path) as partial:
        writer = imageio_ffmpeg.write_frames(
            partial, first.shape[1::-1], fps=fps, codec="libx264", quality=7, macro_block_size=2
        )
        with closing(writer):
            writer.send(None)
            writer.send(np.ascontiguousarray(first))
            for picture in rest:
                writer.send(np.ascontiguousarray(picture))


def write_picture(path: str | Path, picture: UInt8[np.ndarray, "height width 3"]) -> None:
    """Writes a picture as PNG."""
    Image.fromarray(picture).save(path, format="PNG")
