"""A window for ``render_mode="human"`` on Tk, which ships with Python."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Window:
    """Shows pictures at a fixed rate.

    :param title: of the window
    :param fps: pictures per second; :meth:`show` waits until the next is due
    :raises RuntimeError: without Tk or a display, with what to do
    """

    def __init__(self, title: str, fps: float) -> None:
        try:
            import tkinter

            self._root: Any = tkinter.Tk()
        except Exception as error:
            raise RuntimeError(
                f'render_mode="human" needs Tk and a display ({error}). Install python3-tk and set DISPLAY, '
                'or use render_mode="rgb_array" and save the pictures.'
            ) from error
        self._root.title(title)
        self._photo: Any = None
        self._label: Any = tkinter.Label(self._root)
        self._label.pack()
        self._image_class: Any = tkinter.PhotoImage
        self._interval = 1.0 / fps
        self._due = time.perf_counter()

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show one picture ``(height, width, 3)`` when it is due."""
        height, width = picture.shape[:2]
        data = b"P6 %d %d 255\n" % (width, height) + picture.tobytes()
        self._photo = self._image_class(data=data, format="PPM")  # Tk keeps no reference of its own
        self._label.configure(image=self._photo)
        now = time.perf_counter()
        if now < self._due:
            time.sleep(self._due - now)
        self._due = max(now, self._due) + self._interval
        self._root.update()

    def close(self) -> None:
        """Close the window."""
        self._root.destroy()
