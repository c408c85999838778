"""A filmed episode: pictures that are drawn when asked for, and files of them."""

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from envs.video.files import write_picture, write_video


class Film(ABC):
    """Played episode, which can be drawn."""

    fps: int
    """Number of pictures per second."""

    @abstractmethod
    def __len__(self) -> int:
        """Returns the number of pictures."""

    @abstractmethod
    def draw(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """Returns a picture."""

    def write_video(self, path: str | Path) -> None:
        """Writes the video as MP4 (H.264, yuv420p); `path` is never a partial file."""
        write_video(path, (self.draw(index) for index in range(len(self))), self.fps)

    def write_frame(self, path: str | Path, index: int) -> None:
        """Writes one picture as PNG."""
        write_picture(path, self.draw(index))
