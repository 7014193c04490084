"""Window that shows frames in real time."""

import os
import warnings

import pygame

UNSEEN_DRIVERS = ("offscreen", "dummy")
"""SDL's video drivers that have no window."""
TITLE = "lpv-track-env"
SURROUND = (255, 255, 255)
IDLE = 20
"""Checks for events per second while paused."""


class Window:
    """Window that the first frame opens; it can be resized, and frames keep their shape.

    It shows at most `fps` frames per second. Space pauses until it is pressed again; Escape, or
    closing the window, ends the drawing for good. Without a display SDL draws invisibly: the window
    warns once, with `otherwise` as advice, and does not wait for real time. If SDL has no video
    driver at all, a RuntimeError is raised.
    """

    def __init__(self, fps: int, otherwise: str = "use render_mode='rgb_array'") -> None:
        self._fps, self._otherwise = fps, otherwise
        self._window: pygame.Surface | None = None
        self._clock: pygame.time.Clock | None = None
        self.dismissed = False

    def show(self, frame: pygame.Surface) -> None:
        """Show a frame for its time.

        Raises
        ------
        RuntimeError
            If SDL has no video driver at all.
        """
        if self.dismissed:
            return
        window = self._window or self._open(frame.get_size())
        if not self._handle_events(frame):
            return
        self._put(frame, pygame.display.get_surface() or window)
        if self._clock is not None:
            self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window; a later frame opens it again unless the user dismissed it."""
        if self._window is not None:
            pygame.display.quit()
        self._window = None
        self._clock = None

    def prepare(self) -> None:
        """Check that SDL can draw.

        Raises
        ------
        RuntimeError
            If SDL has no video driver at all.
        """
        try:
            pygame.display.init()
        except pygame.error as error:
            raise self._lacking(error) from None

    def _lacking(self, error: pygame.error) -> RuntimeError:
        return RuntimeError(f"a window needs a display ({error}): {self._otherwise}")

    def _open(self, size: tuple[int, int]) -> pygame.Surface:
        self.prepare()
        try:
            self._window = pygame.display.set_mode(_fitting(size), pygame.RESIZABLE)
        except pygame.error as error:
            raise self._lacking(error) from None
        pygame.display.set_caption(TITLE)
        if pygame.display.get_driver() not in UNSEEN_DRIVERS:
            self._clock = pygame.time.Clock()
        elif "SDL_VIDEODRIVER" not in os.environ:
            warnings.warn(
                f"no display found, drawing unseen: {self._otherwise}",
                UserWarning,
                stacklevel=5,
            )
        return self._window

    def _handle_events(self, frame: pygame.Surface) -> bool:
        """Handle events, and wait while paused; return False once the window is dismissed."""
        paused = False
        while True:
            for event in pygame.event.get():
                key = event.key if event.type == pygame.KEYDOWN else None
                if event.type == pygame.QUIT or key == pygame.K_ESCAPE:
                    self.dismissed = True
                    self.close()
                    return False
                if key == pygame.K_SPACE:
                    paused = not paused
                    pygame.display.set_caption(f"{TITLE} (paused)" if paused else TITLE)
            if not paused:
                return True
            window = pygame.display.get_surface()
            if window is not None:
                self._put(frame, window)
            pygame.time.wait(1000 // IDLE)

    @staticmethod
    def _put(frame: pygame.Surface, window: pygame.Surface) -> None:
        """Draw a frame in the middle of the window, as large as fits."""
        have, need = window.get_size(), frame.get_size()
        if have == need:
            window.blit(frame, (0, 0))
        else:
            size = _within(need, have)
            window.fill(SURROUND)
            place = ((have[0] - size[0]) // 2, (have[1] - size[1]) // 2)
            window.blit(pygame.transform.smoothscale(frame, size), place)
        pygame.display.flip()


def _within(size: tuple[int, int], room: tuple[int, int]) -> tuple[int, int]:
    """Scale a size to fit into a room, its shape kept."""
    share = min(room[0] / size[0], room[1] / size[1])
    return max(round(size[0] * share), 1), max(round(size[1] * share), 1)


def _fitting(size: tuple[int, int]) -> tuple[int, int]:
    """Size of a window for frames: theirs, or smaller if the desktop is smaller."""
    desktops = pygame.display.get_desktop_sizes()
    room = desktops[0] if desktops else size
    return size if size[0] <= room[0] and size[1] <= room[1] else _within(size, room)
