"""Shows pictures in a window, one after the other."""

import os
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import UInt8

from predictor.support.errors import UserError


def play(pictures: Iterable[UInt8[np.ndarray, "height width 3"]], fps: int | float, title: str) -> int:
    """Shows pictures in a window until they end, or until it is closed or Escape is pressed.

    Args:
        pictures: pictures, all of one size.
        fps: number of pictures per second.
        title: title of the window.

    Returns:
        Number of pictures shown.

    Raises:
        UserError: there is no screen.
    """
    import pygame  # windows alone need it

    shown = 0
    try:
        pygame.display.init()
        if pygame.display.get_driver() == "offscreen" != os.environ.get("SDL_VIDEODRIVER"):
            raise pygame.error("there is no screen")  # SDL draws into memory then, without a word
        for picture in pictures:
            began = time.monotonic()
            if not shown:
                screen = pygame.display.set_mode(picture.shape[1::-1])
                pygame.display.set_caption(title)
            screen.blit(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
            pygame.display.flip()
            shown += 1
            if any(_ends(event, pygame) for event in pygame.event.get()):
                break
            time.sleep(max(0.0, 1 / fps - (time.monotonic() - began)))
    except pygame.error as error:
        raise UserError(f"cannot open a window: {error}; leave out --window to write a film") from error
    finally:
        pygame.display.quit()
    return shown


def _ends(event: Any, pygame: Any) -> bool:
    """Returns whether an event closes the window."""
    return event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE)
