"""Both levels acting together: what collecting, evaluating and ``predict`` share."""

from __future__ import annotations

from typing import NoReturn

import numpy as np

from sb3_tbc.arrays import BoolArray, FloatArray
from sb3_tbc.level.acting import ActingLevel
from sb3_tbc.tbc_hrl.reconsideration import Reconsideration


class TwoLevelActor:
    """The high level proposes options; the low level acts on them and keeps its memory for as long as ``memory`` says.

    Acting deterministically is what an agent is evaluated and deployed with: by the means of both levels, and by their
    averaged actors where they are kept.

    :param high: the high level
    :param low: the low level
    :param memory: when the membrane is reset: at each new ``"window"``, ``"episode"``, or at every step (``"none"``)
    :param reconsideration: lets the high level end windows before their time; None: it does not
    """

    def __init__(
        self, high: ActingLevel, low: ActingLevel, memory: str, reconsideration: Reconsideration | None = None
    ) -> None:
        self.high, self.low, self.memory, self.reconsideration = high, low, memory, reconsideration

    def predict(self, *_: object, **__: object) -> NoReturn:
        """Refused: an action takes the clock of the running option, which the policy keeps.

        :raises TypeError: always, naming what to call
        """
        raise TypeError("both levels act through the policy, which keeps the option's clock: use policy.predict")

    def notice_changes(self) -> None:
        """Act from weights that were changed by hand, too."""
        self.high.notice_changes()
        self.low.notice_changes()

    def blank(self, n_envs: int) -> FloatArray:
        """The low level's memory before anything happened, ``(n_envs, state_dim)``."""
        return np.zeros((n_envs, self.low.state_dim), dtype=np.float32)

    def propose(self, observations: FloatArray, deterministic: bool, rng: np.random.Generator) -> FloatArray:
        """Unit subgoals, and time budgets unless a schedule gives them, ``(n, subgoal_dim [+ 1])``.

        They are double: rounding a time budget to single precision can change the length of a window.

        :param observations: the high level's, ``(n, high_dim)``
        """
        no_state = np.zeros((len(observations), 0), dtype=np.float32)
        unit, _ = self.high.act(observations, no_state, deterministic, rng, average=deterministic)
        return unit.astype(np.float64)

    def act(
        self, observations: FloatArray, membrane: FloatArray, deterministic: bool | BoolArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Unit actions ``(n, action_dim)`` and the memory after the step, ``(n, state_dim)``.

        :param observations: the low level's, ``(n, low_dim)``
        :param membrane: its memory before the step
        :param deterministic: for all rows, or for those of a mask ``(n,)``, which act by the present actor's means
        """
        return self.low.act(observations, membrane, deterministic, rng, average=deterministic is True)

    def carried(self, membrane: FloatArray) -> FloatArray:
        """What the next step of the same option begins with: the memory, or rest with ``memory: none``."""
        return np.zeros(membrane.shape, dtype=np.float32) if self.memory == "none" else membrane

    def forget(self, membrane: FloatArray, window_over: BoolArray, episode_over: BoolArray) -> FloatArray:
        """The memory with which the next step begins: blank where it ends.

        :param membrane: memory after a step, ``(n, state_dim)``
        :param window_over: whose option ended with it
        :param episode_over: whose episode ended with it
        """
        if self.memory == "none" or not membrane.shape[1]:
            return self.carried(membrane)
        over = window_over if self.memory == "window" else episode_over
        return np.where(over[:, None], np.float32(0.0), membrane) if np.count_nonzero(over) else membrane
