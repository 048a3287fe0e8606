"""The last few frames of a task as one flat vector, oldest first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class FrameHistory:
    """Stacks the newest ``n_frames`` frames; frames are written along a strip, so a push moves nothing in memory.

    :param n_frames: number of frames in the stack
    :param frame_dim: entries per frame
    """

    def __init__(self, n_frames: int, frame_dim: int) -> None:
        self._n_frames = n_frames
        self._strip = np.zeros((n_frames + 1000, frame_dim))
        self._end = 0

    def reset(self, frame: Sequence[float]) -> NDArray[np.float64]:
        """Fill every slot with ``frame`` and return the stack."""
        self._strip[: self._n_frames] = frame
        self._end = self._n_frames
        return self._strip[: self._n_frames].flatten()

    def push(self, frame: Sequence[float]) -> NDArray[np.float64]:
        """Append ``frame`` and return the stack as a fresh array ``(n_frames * frame_dim,)``, newest frame last."""
        if self._end == len(self._strip):
            kept = self._n_frames - 1
            self._strip[:kept] = self._strip[self._end - kept :]
            self._end = kept
        self._strip[self._end] = frame
        self._end += 1
        return self._strip[self._end - self._n_frames : self._end].flatten()
