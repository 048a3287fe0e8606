"""Keeps a run's last good state: detects divergence, and remembers the last point from which it can be resumed."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import Arrays
from sb3_tbc.errors import DivergedError
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.flat_replay import Rewind, TerminatingHerReplayBuffer
from sb3_tbc.tbc_hrl.flat_sac import CYCLE, FlatSAC

DIVERGED = 1e12
"""Critic loss at which training has diverged: values of about a million, while returns are 10 to 1000."""
CURE = "a lower learning rate, or observations or rewards of smaller scale, usually cure it"


class LossWatch(KVWriter):
    """Reads what an agent logs and remembers the first sign of divergence.

    :param limit: critic loss at which a run counts as diverging
    """

    def __init__(self, limit: float = DIVERGED) -> None:
        self.limit = limit
        self.reason = ""

    def write(self, key_values: Plain, key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Check the critics' losses in one set of logged values."""
        for key, value in key_values.items():
            if key.endswith("critic_loss") and not self.reason and not abs(float(value)) < self.limit:
                self.reason = f"diverging: {key} is {value:.3g} at step {step:,}"

    def close(self) -> None:
        """Nothing to close."""


def check_weights(model: BaseAlgorithm) -> None:
    """Refuse to save an agent whose weights are NaN or infinite.

    :raises DivergedError: naming the first such tensor
    """
    for name, tensor in model.policy.state_dict().items():
        if tensor.is_floating_point() and not th.isfinite(tensor).all():
            raise DivergedError(f"the agent's {name} is no longer finite")


class DivergenceCallback(BaseCallback):
    """Ends training when a critic's loss exceeds a limit.

    :param limit: critic loss at which training ends
    """

    def __init__(self, limit: float = DIVERGED) -> None:
        super().__init__()
        self.watch = LossWatch(limit)

    def _init_callback(self) -> None:
        self.logger.output_formats.append(self.watch)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.watch.write(self.logger.name_to_value, {}, self.num_timesteps)
        if self.watch.reason:
            raise DivergedError(f"{self.watch.reason}; {CURE}")


class ConsistentState(BaseCallback):
    """Remembers the state at the start of a rollout, so that an environment's failure loses that rollout only.

    While steps are collected no weights change, and of replay only what is added, so that all that must be remembered
    is small. From the end of a rollout to the beginning of the next, updates run, and nothing is remembered.
    """

    ATTRIBUTES = (
        *("num_timesteps", "_episode_num", "_current_progress_remaining", "_n_updates", "_updated_at", "_burst_due"),
        *("ep_info_buffer", "ep_success_buffer"),
    )

    def __init__(self) -> None:
        super().__init__()
        self._attributes: Plain = {}
        self._stored: tuple[int, ...] = ()
        self._rewind: Rewind | None = None
        self._arrays: Arrays = {}

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        model = self.model
        if isinstance(model, TBCHRL):
            self._stored = self._rows(model)
        elif isinstance(model, FlatSAC) and isinstance(model.replay_buffer, TerminatingHerReplayBuffer):
            self._rewind = Rewind(model.replay_buffer, min(CYCLE, model.replay_buffer.buffer_size - 1))
        else:
            return
        self._arrays = {name: np.array(array) for name, array in model.learning_state().items()}
        self._attributes = {n: deepcopy(getattr(model, n)) for n in self.ATTRIBUTES if hasattr(model, n)}

    def _on_rollout_end(self) -> None:
        self._arrays, self._attributes = {}, {}

    @staticmethod
    def _rows(model: TBCHRL) -> tuple[int, ...]:
        """Fill of the replay buffers: an episode may have been stored before a callback fails."""
        return tuple(place for buffer in model.replay_buffer for place in (buffer.size(), buffer.pos))

    def go_back(self) -> Callable[[Path], None] | None:
        """Take the agent back to that point, and return what writes its replay; None if there is no such point."""
        model, arrays = self.model, self._arrays
        if not self._attributes:
            return None
        if isinstance(model, TBCHRL) and self._rows(model) != self._stored:
            return model.save_replay_buffer  # the step was whole, a callback after it failed
        vars(model).update(self._attributes)
        if isinstance(model, TBCHRL):
            return lambda path: model.replay_buffer.save(path, arrays)
        if self._rewind is not None and isinstance(model, FlatSAC):
            self._rewind()
            return lambda path: model.save_replay_buffer(path, arrays)
        return None
