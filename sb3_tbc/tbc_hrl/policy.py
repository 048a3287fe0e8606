"""Acting with both levels: the policy whose ``predict`` carries the live option and the membrane potentials."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, TensorDict

from sb3_tbc.arrays import AnyArray, Arrays, BoolArray, FloatArray, IntArray
from sb3_tbc.errors import NonFiniteError
from sb3_tbc.level.actors import NDBCActor
from sb3_tbc.level.level import SACLevel
from sb3_tbc.level.policies import LevelPolicy
from sb3_tbc.ndbc.diagnostics import check_finite
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, UnitActions, rows_of
from sb3_tbc.smdp.hierarchical_vec_env import Schedule
from sb3_tbc.smdp.options import OptionClock, OptionRules
from sb3_tbc.smdp.views import LevelViews
from sb3_tbc.tbc_hrl.actor import TwoLevelActor
from sb3_tbc.tbc_hrl.checks import check_sizes, episode_starts
from sb3_tbc.tbc_hrl.reconsideration import Reconsideration


class TwoLevelState(NamedTuple):
    """What ``predict`` hands on from step to step, one row per environment: the option's clock and the memory."""

    subgoal: FloatArray  # (n, subgoal_dim), task units
    time_budget: FloatArray  # (n,), steps
    elapsed: IntArray  # (n,), steps since the option began
    used: IntArray  # (n,), options begun in this episode
    membrane: FloatArray  # (n, state_dim)


class TBCPolicy(BasePolicy):
    """Both levels as one policy: :meth:`predict` takes the task's observation and returns the task's action.

    :param observation_space: the task's goal observation
    :param action_space: the task's action box
    :param high: the high level
    :param low: the low level
    :param views: what each level sees
    :param rules: what ends an option
    :param memory: when the membrane is reset: at each new ``"window"``, ``"episode"``, or at every step (``"none"``)
    :param seed: of the noise that ``predict(deterministic=False)`` draws
    :param schedule: gives the time budgets where the high level does not
    :param reconsider_margin: see :class:`.Reconsideration`, used where the rules let the high level end windows
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        high: SACLevel,
        low: SACLevel,
        views: LevelViews,
        rules: OptionRules,
        memory: str,
        seed: int | None = None,
        schedule: Schedule | None = None,
        reconsider_margin: float = 1.0,
    ) -> None:
        super().__init__(observation_space, action_space, squash_output=True)
        self.high_policy, self.low_policy = high.policy, low.policy
        levels = high.acting, low.acting  # and not the levels themselves, with all that they learn from
        reconsider = rules.may_be_reconsidered
        reconsideration = Reconsideration(levels[0], views, rules, reconsider_margin) if reconsider else None
        self.actor = TwoLevelActor(*levels, memory, reconsideration)
        self.views, self.rules, self.memory, self.schedule = views, rules, memory, schedule
        self.unit = UnitActions(action_space)
        self.rng = np.random.default_rng(seed)
        for level in (self.high_policy, self.low_policy):
            level.register_load_state_dict_post_hook(_read_again)  # type: ignore[no-untyped-call]

    def save(self, path: str) -> None:
        """Refused: the two levels are parts of an agent.

        :raises TypeError: always, naming what to save
        """
        raise TypeError("a policy of two levels is saved with its agent: use model.save(path) and TBCHRL.load(path)")

    @classmethod
    def load(cls, path: str, device: th.device | str = "auto") -> TBCPolicy:
        """Refused, see :meth:`save`.

        :raises TypeError: always, naming what to load
        """
        raise TypeError("a policy of two levels is loaded with its agent: use TBCHRL.load(path).policy")

    def initial_state(self, n_envs: int) -> TwoLevelState:
        """State of ``n_envs`` environments that have not begun an option."""
        return _packed(OptionClock(n_envs, self.views.subgoals, self.rules), self.actor.blank(n_envs))

    def predict(
        self,
        observation: AnyArray | Arrays,
        state: tuple[AnyArray, ...] | None = None,
        episode_start: AnyArray | None = None,
        deterministic: bool = False,
    ) -> tuple[AnyArray, tuple[AnyArray, ...] | None]:
        """Primitive actions for one observation or a batch of them.

        Pass the returned state back in with the next observation: it holds the live subgoal, its time budget and the
        membrane potentials. ``state=None`` begins a new episode. The action budget is counted in ``state.used`` but
        not enforced: a deployed agent goes on.

        :param observation: of one environment, ``{key: (dim,)}``, or of n, ``{key: (n, dim)}``, in the task's units
        :param state: what the last call returned, see :class:`TwoLevelState`
        :param episode_start: which environments begin an episode, ``(n,)``; by default all where ``state`` is None
        :param deterministic: use the means of both levels, and the averaged actors where they are kept
        :return: actions in the environment's units, ``(action_dim,)`` or ``(n, action_dim)``, and the new state
        :raises ValueError: if the observation is not that of a goal environment, or the state of other environments
        :raises NonFiniteError: if a level answers with NaN
        """
        batch, single = self._as_batch(observation)
        n = len(batch["observation"])
        self.actor.notice_changes()
        clock, membrane = self._unpacked(n, state)
        starts = np.ones(n, bool) if state is None else np.zeros(n, bool)
        if episode_start is not None:
            starts |= episode_starts(episode_start, n)
        over = self._begin_options(clock, batch, starts, deterministic)
        low_observation = self.views.low(batch, clock.subgoal, clock.remaining)
        membrane = self.actor.forget(membrane, over, starts)
        unit, membrane = self.actor.act(low_observation, membrane, deterministic, self.rng)
        if not np.isfinite(unit).all():
            self._name_non_finite(low_observation, membrane, unit, clock.elapsed)
        actions = self.unit.unscale(unit)
        clock.tick()
        return (actions[0] if single else actions), cast("tuple[AnyArray, ...]", _packed(clock, membrane))

    def _unpacked(self, n: int, state: tuple[AnyArray, ...] | None) -> tuple[OptionClock, FloatArray]:
        """Clock and memory of a state, copied."""
        clock = OptionClock(n, self.views.subgoals, self.rules)
        if state is None:
            return clock, self.actor.blank(n)
        if not isinstance(state, tuple | list) or len(state) != len(TwoLevelState._fields):
            raise ValueError(
                f"state must be what predict returned ({', '.join(TwoLevelState._fields)}), or None where episodes "
                f"begin; got {type(state).__name__}"
            )
        given = TwoLevelState(*state)
        if len(given.elapsed) != n:
            raise ValueError(
                f"state is of {len(given.elapsed)} environments, the observation of {n}: pass the state that predict "
                "gave for these environments, or None where episodes begin"
            )
        own = _packed(clock, self.actor.blank(n))
        for name, mine, part in zip(own._fields, own, given, strict=True):
            if np.shape(part) != mine.shape:  # NumPy would spread a narrower one over all entries
                raise ValueError(
                    f"state.{name} is of shape {mine.shape} here, got {np.shape(part)}: is it of another agent?"
                )
            if not np.isfinite(part).all():
                raise NonFiniteError(
                    f"state.{name} is not finite: {np.asarray(part).tolist()}; predict gives no such state"
                )
            mine[...] = part
        return clock, own.membrane

    def _begin_options(self, clock: OptionClock, batch: Arrays, starts: BoolArray, deterministic: bool) -> BoolArray:
        """Replace the options that are over, in place; which they are."""
        if self.actor.reconsideration is not None:
            clock.give_up(self.actor.reconsideration(batch, clock) & ~starts)
        over = starts | clock.ended(batch)
        clock.begin_episode(np.flatnonzero(starts))
        where = np.flatnonzero(over)
        if len(where):
            seen = rows_of(batch, where)
            unit = self.actor.propose(self.views.high(seen), deterministic, self.rng)
            if not np.isfinite(unit).all():
                raise NonFiniteError(f"high level, subgoal or time budget {unit.tolist()} for observation {seen}")
            clock.begin(where, unit if self.schedule is None else self.schedule(unit, seen))
        return over

    def _name_non_finite(self, inputs: FloatArray, membrane: FloatArray, unit: FloatArray, elapsed: IntArray) -> None:
        """Raise, naming where the low level stopped being finite; steps count from the beginning of the option."""
        row = int(np.flatnonzero(~np.isfinite(unit).all(axis=1))[0])
        actor, step, one = self.low_policy.actor, int(elapsed[row]), slice(row, row + 1)
        if isinstance(actor, NDBCActor):
            check_finite(actor.net.wiring, inputs[one], membrane[one], unit[one], "low", step)
        raise NonFiniteError(f"low level, step {step}: action {unit[row].tolist()} for inputs {inputs[row].tolist()}")

    def _as_batch(self, observation: object) -> tuple[Arrays, bool]:
        if isinstance(observation, tuple):
            raise ValueError(
                "predict got a tuple, probably by mixing Gym API and SB3's: an environment's reset returns "
                "(observation, info), that of a vector the observations alone; pass the observation alone"
            )
        if not isinstance(observation, dict) or any(key not in observation for key in GOAL_KEYS):
            found = sorted(observation) if isinstance(observation, dict) else type(observation).__name__
            raise ValueError(f"predict needs a goal observation with the keys {sorted(GOAL_KEYS)}, got {found}")
        check_sizes(cast(spaces.Dict, self.observation_space), observation)
        single_precision = {key: np.asarray(observation[key], dtype=np.float32) for key in GOAL_KEYS}
        batch = {key: part.astype(np.float64) for key, part in single_precision.items()}  # as exported policies see it
        single = batch["observation"].ndim == 1
        return ({key: part[None] for key, part in batch.items()} if single else batch), single

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """SB3's tensor form of a single, memoryless step."""
        batch = {key: np.asarray(part) for key, part in cast(TensorDict, observation).items()}
        return th.as_tensor(self.predict(batch, deterministic=deterministic)[0])

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Same as ``_predict``."""
        return self._predict(observation, deterministic)


def _packed(clock: OptionClock, membrane: FloatArray) -> TwoLevelState:
    return TwoLevelState(**{name: getattr(clock, name) for name in OptionClock.carried}, membrane=membrane)


def _read_again(level: LevelPolicy, _: object) -> None:
    """Let a level act from weights that were just loaded into it."""
    level.after_updates(0)
