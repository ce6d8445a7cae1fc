"""A window that shows frames and hears keys; pygame is imported only when one opens."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray


class Viewer:
    """Opens with the first frame and keeps the frames' pace.

    Args:
        title: Of the window.
        fps: Frames per second that `show` waits for; 0 waits for nothing.

    Raises:
        gymnasium.error.DependencyNotInstalled: pygame is missing.
    """

    def __init__(self, title: str, fps: float) -> None:
        try:
            import pygame
        except ImportError as error:
            raise DependencyNotInstalled(
                "render_mode='human' opens a window with pygame, which is missing: pip install 'servotrack[human]'"
            ) from error
        self._pygame = pygame
        self._title = title
        self._fps = fps
        self._window: Any = None
        self._clock: Any = None
        self.closed = False
        """Whether the user has closed the window; later frames are then ignored."""

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Show a frame, shape (H, W, 3), RGB, and wait until the next one is due."""
        if self.closed:
            return
        pygame = self._pygame
        height, width = frame.shape[:2]
        if self._window is None:
            pygame.display.init()
            pygame.display.set_caption(self._title)
            self._window = pygame.display.set_mode((width, height))
            self._clock = pygame.time.Clock()
        picture = pygame.image.frombuffer(np.ascontiguousarray(frame).tobytes(), (width, height), "RGB")
        self._window.blit(picture, (0, 0))
        pygame.display.flip()
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
        elif self._fps > 0:
            self._clock.tick(self._fps)

    def held_keys(self) -> frozenset[str]:
        """Names of the keys that are down now, as pygame names them: `left`, `a`, `space`; none without a window."""
        if self._window is None:
            return frozenset()
        pygame = self._pygame
        pygame.event.pump()
        pressed = pygame.key.get_pressed()
        return frozenset(name for name in _KEYS if pressed[pygame.key.key_code(name)])

    def close(self) -> None:
        """Close the window; closing twice does no harm."""
        self.closed = True
        if self._window is not None:
            self._window = None
            self._pygame.display.quit()


_KEYS = ("left", "right", "up", "down", "space", "escape", "return", *"abcdefghijklmnopqrstuvwxyz0123456789")
