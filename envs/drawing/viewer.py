"""Window that shows frames and reads keys. pygame is imported only when a window opens."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray


class Viewer:
    """Window that opens with the first frame and shows frames at a constant rate.

    Args:
        title: Title of the window.
        fps: Frame rate that `show` keeps by waiting, 1/s; 0 does not wait.

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
        """True after the window was closed; later frames are ignored."""

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
        """Names of the pressed keys in pygame's naming: `left`, `a`, `space`. Empty without a window."""
        if self._window is None:
            return frozenset()
        pygame = self._pygame
        pygame.event.pump()
        pressed = pygame.key.get_pressed()
        return frozenset(name for name in _KEYS if pressed[pygame.key.key_code(name)])

    def close(self) -> None:
        """Close the window. A second call has no effect."""
        self.closed = True
        if self._window is not None:
            self._window = None
            self._pygame.display.quit()


_KEYS = ("left", "right", "up", "down", "space", "escape", "return", *"abcdefghijklmnopqrstuvwxyz0123456789")
