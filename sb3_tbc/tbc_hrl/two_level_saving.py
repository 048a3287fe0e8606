"""What an agent of two levels saves and loads: parameters of both levels, replay, and the state of learning."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, TensorDict

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import Arrays
from sb3_tbc.level.actors import NDBCActor
from sb3_tbc.level.level import SACLevel
from sb3_tbc.replay.both_levels import Replay
from sb3_tbc.settings import SettingError, plain
from sb3_tbc.tbc_hrl import resume
from sb3_tbc.tbc_hrl.checks import LEVEL_NAMES
from sb3_tbc.tbc_hrl.collection import Collector
from sb3_tbc.tbc_hrl.diagnostics import EpisodeDiagnostics
from sb3_tbc.tbc_hrl.environment import mismatch_explained
from sb3_tbc.tbc_hrl.policy import TBCPolicy
from sb3_tbc.tbc_hrl.reachability import Reachability
from sb3_tbc.tbc_hrl.saving import UNFIT, PlainAlgorithm, leaves

INPUT_SCALE = "low.policy_kwargs.ndbc.input_scale"
SelfTwoLevel = TypeVar("SelfTwoLevel", bound="TwoLevelSaving")


class TwoLevelSaving(PlainAlgorithm):
    """Saving and loading of an agent of two levels; the agent itself builds the parts named here."""

    more_changes: ClassVar[tuple[str, ...]] = (*LEVEL_NAMES, "subgoals")
    policy: TBCPolicy
    high: SACLevel
    low: SACLevel
    replay_buffer: Replay
    reachability: Reachability | None
    rng: np.random.Generator
    diagnostics: EpisodeDiagnostics
    collector: Collector | None
    _resumed: Plain
    foreign_high: BaseAlgorithm | None = None
    """The algorithm that proposes options in the place of the high level, see :meth:`from_levels`."""

    def _make_replay(self, high_seed: int, low_seed: int) -> None:
        """Empty replay buffers for both levels, and what fills them."""
        raise NotImplementedError

    def learning_state(self) -> Arrays:
        """What is needed to continue learning besides weights and replay: random streams, open options, counters."""
        return resume.get_state(self._moving_parts())

    def _moving_parts(self) -> resume.MovingParts:
        return resume.MovingParts(
            self.num_timesteps, self.high, self.low, self.replay_buffer, self.policy.rng, self.rng, self.reachability,
            self.diagnostics, self.collector,
        )  # fmt: skip

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            "high", "low", "config", "rng", "views", "rules", "high_reward", "low_level_reward", "store",
            "diagnostics", "replay_buffer", "schedule", "reachability", "collector", "_resumed",
            "stop_requested", "_settings_told_to", "_counted_to",
        ]  # fmt: skip

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = [], []
        for name in ("high", "low"):
            level_dicts, level_variables = getattr(self, name)._get_torch_save_params()
            state_dicts += [f"{name}.{part}" for part in level_dicts]
            variables += [f"{name}.{part}" for part in level_variables]
        if self.reachability is not None:
            state_dicts += ["reachability", "reachability.optimizer"]
        return state_dicts, variables

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """Load parameters of both levels in place, see SB3."""
        super().set_parameters(load_path_or_dict, exact_match, device)
        for level in (self.high, self.low):
            level.acting.refresh()

    def _drop_parts(self) -> None:
        del self.diagnostics  # the sign that there are parts whose random streams a seed restarts

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Write both levels' replay buffers, and all else that is needed to continue learning, to one file of arrays.

        A model saved at the same moment (between two rollouts) and loaded together with this file continues with
        ``learn(..., reset_num_timesteps=False)`` as if it had never stopped, bit for bit.
        """
        self.replay_buffer.save(path, self.learning_state())

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Read what :meth:`save_replay_buffer` wrote; only plain arrays are read, never pickled objects.

        :param truncate_last_traj: for SB3's sake; unfinished episodes are never in the buffers
        :raises ValueError: if the file was written for other spaces or sizes
        """
        if getattr(self, "replay_buffer", None) is None:
            self._make_replay(*self.rng.integers(2**31, size=2).tolist())
        self._resumed = self.replay_buffer.load(path)

    @classmethod
    def load(
        cls: type[SelfTwoLevel],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: Plain | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trust: bool = False,
        **kwargs: Any,
    ) -> SelfTwoLevel:
        """Load an agent, see SB3; ``device="auto"`` is the CPU, where both levels act and learn.

        :raises ValueError: if the environment given does not fit, naming the layout that does
        :raises SettingError: see :meth:`.PlainAlgorithm.load`
        """
        device = "cpu" if device == "auto" else device
        with mismatch_explained():
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, trust, **kwargs)
        if INPUT_SCALE in leaves({name: plain(value) for name, value in kwargs.items()}):
            model._refuse_other_scale()
        return model

    def _refuse_other_scale(self) -> None:
        """Refuse a new scale of the circuit's inputs: it is saved with the weights, which would bring back the old one.

        :raises SettingError: if it is another one
        """
        circuit, actor = self.low.policy.level_kwargs["ndbc"], self.low.policy.actor
        if isinstance(actor, NDBCActor) and not np.allclose(actor.net.input_gain.numpy() * circuit["input_scale"], 1.0):
            raise SettingError(INPUT_SCALE, UNFIT)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save the agent, see SB3.

        :raises ValueError: for an agent from :meth:`from_levels`
        """
        self._refuse_foreign_high("save")
        super().save(path, exclude, include)

    def _refuse_foreign_high(self, what: str) -> None:
        if self.foreign_high is not None:
            raise ValueError(
                f"an agent from from_levels cannot {what}: its high level is a {type(self.foreign_high).__name__}. "
                f"Use high.{what}(...) and low.{what}(...), then from_levels again"
            )
