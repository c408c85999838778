"""Writes pictures (PNG) and videos (MP4), and keeps pictures small in memory."""

import errno
import io
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import closing
from itertools import chain
from pathlib import Path

import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from predictor.support.errors import UserError
from predictor.support.files import new_file

STILL_PX, STILL_LIMIT_S = 1000, 20.0
"""Largest width of a still [px], and longest time that its making may take [s]."""


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

    Raises:
        UserError: no pictures, pictures of different sizes, or an ffmpeg that fails.
    """
    path = Path(path)
    rest = iter(pictures)
    first = next(rest, None)
    if first is None:
        raise UserError(f"the video {path} needs at least one picture, got none; play at least one step")
    _try_to_write(path)
    try:
        with new_file(path) as partial:  # absolute, as ffmpeg takes "a:" at the beginning for a protocol
            writer = imageio_ffmpeg.write_frames(
                partial.absolute(), first.shape[1::-1], fps=fps, codec="libx264", quality=7, macro_block_size=2
            )
            with closing(writer):
                writer.send(None)
                for number, picture in enumerate(chain([first], rest), start=1):
                    _check_size(path, number, picture, first)
                    writer.send(np.ascontiguousarray(picture))
    except (OSError, RuntimeError) as error:  # RuntimeError: imageio finds no ffmpeg
        # of the pipe to ffmpeg, or of the file that it did not write
        if isinstance(error, OSError) and error.errno not in (None, errno.ENOENT):
            raise
        raise UserError(
            f"ffmpeg must write the video {path}, but it is missing or it failed; repair it with pip install "
            "--force-reinstall imageio-ffmpeg, or unset IMAGEIO_FFMPEG_EXE"
        ) from error


def _try_to_write(path: Path) -> None:
    """Raises the system's error if a file cannot be made there, which ffmpeg would only fail of."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}."):
        pass


def _check_size(path: Path, number: int, picture: np.ndarray, first: np.ndarray) -> None:
    """Raises a `UserError` if a picture has another size than the first one: ffmpeg would cut the stream elsewhere."""
    if picture.shape != first.shape:
        (height, width), (wanted_height, wanted_width) = picture.shape[:2], first.shape[:2]
        raise UserError(
            f"all pictures of the video {path} must have the size of the first one, {wanted_width}×{wanted_height} px, "
            f"got {width}×{height} px for number {number}; let the environment render one size"
        )


def write_picture(path: str | Path, picture: UInt8[np.ndarray, "height width 3"]) -> None:
    """Writes a picture as PNG."""
    with new_file(Path(path)) as partial:
        Image.fromarray(picture).save(partial, format="PNG")


def still_of(film: Path) -> bytes:
    """Returns a picture of an MP4 file as JPEG, from two seconds after its start; nothing without one, or ffmpeg.

    The file may come from a stranger: it is read as MP4 alone, which names no other file, and for `STILL_LIMIT_S`.
    """
    command = ["-v", "error", "-nostdin", "-protocol_whitelist", "file,pipe"]
    command += ["-ss", "2", "-f", "mov", "-i", f"file:{film}", "-frames:v", "1", "-an"]
    command += ["-vf", f"scale='min({STILL_PX},iw)':-2", "-f", "image2pipe", "-c:v", "mjpeg", "-q:v", "4", "pipe:1"]
    try:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), *command]
        return subprocess.run(command, capture_output=True, timeout=STILL_LIMIT_S, check=False).stdout
    except (subprocess.TimeoutExpired, OSError, RuntimeError):  # RuntimeError: imageio finds no ffmpeg
        return b""
