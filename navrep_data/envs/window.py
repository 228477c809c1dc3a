"""A window that shows pictures and listens to keys: matplotlib's, where there is a display."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import ConfigError, DisplayError, did_you_mean

RENDER_MODES = ("human", "rgb_array")
# Long enough for the window to be drawn and events to be handled [s].
_BLINK = 0.001


def has_display() -> bool:
    """Return whether matplotlib can open a window here.

    Notes
    -----
    matplotlib itself falls back to drawing in memory where there is no display or no toolkit.
    """
    import matplotlib.pyplot as plt
    from matplotlib.backends.registry import BackendFilter, backend_registry

    registry: Any = backend_registry
    interactive = {name.lower() for name in registry.list_builtin(BackendFilter.INTERACTIVE)}
    # asking pyplot makes it try what is installed
    return plt.get_backend().lower() in interactive


def may_have_display() -> bool:
    """Return False where a window is out of the question, without loading matplotlib."""
    if "matplotlib.pyplot" in sys.modules:
        return has_display()
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def need_display() -> None:
    """Raise :class:`DisplayError` where no window can be opened."""
    if not has_display():
        import matplotlib

        raise DisplayError(
            f"No window can be opened here (matplotlib draws with {matplotlib.get_backend()!r}): use a machine with a "
            'display, render_mode="rgb_array", or navrep_data.envs.record(env, policy, "episode.gif").'
        )


def available_render_modes() -> list[str]:
    """Return the render modes that work here, as far as can be told at once."""
    return [mode for mode in RENDER_MODES if mode != "human" or may_have_display()]


def check_render_mode(mode: str | None, known: Sequence[str] = RENDER_MODES) -> str | None:
    """Return `mode` if it is known and works here.

    Raises
    ------
    ConfigError
        If it is unknown.
    DisplayError
        If it needs a window and none can be opened.
    """
    if mode is None:
        return None
    if mode not in known:
        raise ConfigError(f"render_mode is {mode!r}, expected one of: {', '.join(known)}.{did_you_mean(mode, known)}")
    if mode == "human":
        need_display()
    return mode


class Window:
    """A window with one picture.

    Parameters
    ----------
    title : str
        Of the window.
    on_key : callable, optional
        Called with (key, pressed) for every key that goes down or up, names as matplotlib's.
    on_close : callable, optional
        Called when the user closes the window.
    """

    def __init__(
        self,
        title: str,
        on_key: Callable[[str, bool], None] | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        import matplotlib as mpl
        import matplotlib.pyplot as plt

        shortcuts = [name for name in mpl.rcParams if name.startswith("keymap.")]
        with mpl.rc_context({"toolbar": "None", **{name: [] for name in shortcuts}}):
            self.figure: Any = plt.figure(title, figsize=(6, 6))
        self._axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self._axes.set_axis_off()
        self._image: Any = None
        if on_key is not None:
            # matplotlib's own shortcuts (s saves, q closes) would act beside ours
            manager = self.figure.canvas.manager
            if manager is not None and manager.key_press_handler_id is not None:
                self.figure.canvas.mpl_disconnect(manager.key_press_handler_id)
            self.figure.canvas.mpl_connect("key_press_event", lambda event: on_key(str(event.key), True))
            self.figure.canvas.mpl_connect("key_release_event", lambda event: on_key(str(event.key), False))
        if on_close is not None:
            self.figure.canvas.mpl_connect("close_event", lambda event: on_close())

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture (h, w, 3), uint8, and handle what the user has done."""
        if self._image is None:
            self._image = self._axes.imshow(picture)
            if has_display():
                self.figure.show()
        else:
            self._image.set_data(picture)
        self.figure.canvas.draw()
        self.wait(0.0)

    def wait(self, seconds: float) -> None:
        """Handle keys and the window's own events for so many seconds."""
        if has_display():
            self.figure.canvas.start_event_loop(max(seconds, _BLINK))

    def close(self) -> None:
        """Close the window."""
        import matplotlib.pyplot as plt

        plt.close(self.figure)
