"""Nothing that is wrong gets from environments into replay: each step is looked at where it enters."""

from __future__ import annotations

import logging
from typing import Any, Literal, NamedTuple

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import AnyArray, BoolArray, FloatArray
from sb3_tbc.errors import ConfigError, EnvironmentFault, NonFiniteError
from sb3_tbc.smdp.copyable import CopyableVecEnvWrapper
from sb3_tbc.smdp.episode_limit import RESETS
from sb3_tbc.smdp.faults import reset_or_name, step_or_name
from sb3_tbc.smdp.finite import all_finite, not_finite, place
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, rows_of
from sb3_tbc.smdp.goal_test import EpisodeJudge
from sb3_tbc.smdp.shapes import BAD_STEP
from sb3_tbc.smdp.spaces import GoalObservation

OnBadStep = Literal["stop", "end-episode"]
MOST_IN_A_ROW = 10
"""Episodes of an environment that may be over with their first step before its bad steps end the run after all."""
TOLD = 10
"""Bad steps that are told of one by one; the later ones are only counted."""
USED_ELSEWHERE = (
    "it was reset by someone else while the agent's episode was running (as evaluate_policy(model, model.get_env()) "
    "does); evaluate in an environment of its own"
)

logger = logging.getLogger(__name__)


class GuardedStep(NamedTuple):
    """What a step of every environment led to, with nothing in it that is not finite."""

    observation: GoalObservation  # after automatic resets
    rewards: FloatArray  # (n_envs,)
    dones: BoolArray  # (n_envs,)
    infos: list[Plain]
    seen: GoalObservation  # before automatic resets
    bad: BoolArray  # (n_envs,), whose episode ended before this step, which is not to be stored


class Guard:
    """Steps a vector of goal environments and lets nothing through that is not finite or of another shape.

    :param venv: the environments, with :func:`.with_episode_limit`, which looks at shapes
    :param on_bad_step: ``stop``: raise; ``end-episode``: end the episode with the step before, and reset
    :raises ConfigError: for ``end-episode`` where wrappers of the vector change observations
    """

    def __init__(self, venv: VecEnv, on_bad_step: OnBadStep = "stop") -> None:
        self.venv, self.on_bad_step = venv, on_bad_step
        if on_bad_step == "end-episode" and not self._can_begin_one():
            raise ConfigError(
                "on_bad_step='end-episode' resets one environment alone, and the observations of that reset pass no "
                "wrapper of the vector: use on_bad_step='stop', or wrap each environment in place of the vector "
                "(gymnasium.wrappers.FrameStackObservation for VecFrameStack)"
            )
        self.count = 0
        self._none_bad = np.zeros(venv.num_envs, dtype=bool)
        self._in_a_row = np.zeros(venv.num_envs, dtype=np.int64)
        self._last: GoalObservation = {}
        self._resets: list[int | None] = [None] * venv.num_envs  # of each task, at the begin of its running episode

    def _can_begin_one(self) -> bool:
        """Whether one environment can be reset alone: what its reset shows passes no wrapper of the vector."""
        return bool(self.venv.observation_space == self.venv.unwrapped.observation_space)

    def reset(self) -> GoalObservation:
        """Reset every environment.

        :raises EnvironmentFault: if one fails, naming it
        :raises NonFiniteError: see :meth:`begin`
        """
        observation: Any = reset_or_name(self.venv)
        self.begin(observation)
        return observation  # type: ignore[no-any-return]

    def begin(self, observation: GoalObservation) -> None:
        """Look at what environments show that were just reset.

        :raises NonFiniteError: naming environment and key
        """
        everywhere = np.ones(self.venv.num_envs, dtype=bool)
        self._refuse_resets(observation, everywhere)
        self._last = observation
        self._note_resets(everywhere)

    def go_on(self, observation: GoalObservation, before: Guard | None = None) -> None:
        """Go on with episodes that run already.

        :param observation: what the environments show
        :param before: what guarded these episodes so far; None: their beginning is not known
        """
        self._last = observation
        self._resets = [None] * self.venv.num_envs if before is None else before._resets

    def step(self, actions: AnyArray, steps: AnyArray) -> GuardedStep:
        """Step every environment.

        :param steps: of the running episodes so far, ``(n_envs,)``
        :raises EnvironmentFault: if an environment fails, dies or hangs, or a value has another shape than it should
        :raises NonFiniteError: for what is not finite, naming environment, step and key
        """
        if not all_finite(actions):
            index = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
            what = f"the action is not finite: {actions[index].tolist()}"
            raise NonFiniteError(f"{place(index, int(steps[index]) + 1)}: {what}. The agent's own networks give it")
        observation, rewards, dones, given = step_or_name(self.venv, actions, steps)
        infos: list[Plain] = list(given)
        seen = before_reset(observation, dones, infos)  # type: ignore[arg-type]
        well = all_finite(*[seen[key] for key in GOAL_KEYS], rewards) and not self._any_bad(infos)
        if not well and seen is observation:  # what was seen and what the reset shows are to differ from here on
            seen = {key: np.array(part) for key, part in seen.items()}
        bad = self._none_bad if well else self._end_bad(observation, rewards, dones, infos, seen, steps)  # type: ignore[arg-type]
        if np.count_nonzero(dones):
            self._refuse_resets(observation, dones)  # type: ignore[arg-type]
            self._note_resets(dones)
        self._last = observation  # type: ignore[assignment]
        return GuardedStep(observation, rewards, dones, infos, seen, bad)  # type: ignore[arg-type]

    def _any_bad(self, infos: list[Plain]) -> bool:
        """Whether an environment's limit found something wrong with its step, or it is not in the agent's episode."""
        return any(BAD_STEP in info or self._begun_elsewhere(index, info) for index, info in enumerate(infos))

    def _begun_elsewhere(self, index: int, info: Plain) -> bool:
        """Whether a step was one of an episode that someone else has begun."""
        expected = self._resets[index]
        return expected is not None and info.get(RESETS, expected) != expected

    def _note_resets(self, where: BoolArray) -> None:
        """Remember which episodes have begun, so that those that someone else begins are told from them."""
        told = getattr(self.venv.unwrapped, "reset_infos", ())
        for index in np.flatnonzero(where):
            self._resets[index] = (told[index] or {}).get(RESETS) if len(told) > index else None

    def _refuse_resets(self, observation: GoalObservation, where: BoolArray) -> None:
        """Nothing can be done about an episode that begins badly."""
        reset_infos = getattr(self.venv.unwrapped, "reset_infos", ())
        told = {index: info[BAD_STEP] for index, info in enumerate(reset_infos) if info and BAD_STEP in info}
        if not told and all_finite(*(observation[key] for key in GOAL_KEYS)):
            return
        for index in map(int, np.flatnonzero(where)):
            info = {BAD_STEP: told[index]} if index in told else {}
            refuse_reset(index, rows_of(observation, index), info)

    def _end_bad(
        self, observation: Plain, rewards: Any, dones: Any, infos: list[Plain], seen: Plain, steps: AnyArray
    ) -> BoolArray:
        """End the episodes whose step is bad with the step before, in place; which those are."""
        bad = self._none_bad.copy()
        for index in range(self.venv.num_envs):
            step, told = int(steps[index]) + 1, infos[index].get(BAD_STEP)
            elsewhere, row = self._begun_elsewhere(index, infos[index]), rows_of(seen, index)
            what = USED_ELSEWHERE if elsewhere else told or not_finite(row, float(rewards[index]))
            if what is None:
                continue
            if not elsewhere:
                self._stop_or_count(index, step, what, EnvironmentFault if told else NonFiniteError)
            elif not self._can_begin_one():
                raise EnvironmentFault(f"{place(index, step)}: {what}")
            self._tell(f"{place(index, step)}: {what}")
            bad[index] = True
            rewards[index] = 0.0
            last = {key: np.array(part[index]) for key, part in self._last.items()}
            for key, part in last.items():
                seen[key][index] = part
            if not dones[index]:
                self._begin_one(index, observation)
                dones[index] = True
            infos[index] = {"terminal_observation": last, "TimeLimit.truncated": True, "is_success": False,
                            BAD_STEP: what}  # fmt: skip
        return bad

    def _begin_one(self, index: int, observation: Plain) -> None:
        """Reset one environment alone, and put what it shows into the observations of all."""
        fresh, info = self.venv.env_method("reset", indices=[index])[0]
        refuse_reset(index, fresh, info)
        if RESETS in info:
            told = list(self.venv.unwrapped.reset_infos)
            told[index] = info
            self.venv.unwrapped.reset_infos = told
        for key, part in observation.items():
            part[index] = fresh[key]

    def _stop_or_count(self, index: int, step: int, what: str, kind: type[Exception]) -> None:
        self._in_a_row[index] = self._in_a_row[index] + 1 if step == 1 else 0
        if self.on_bad_step == "stop" or self._in_a_row[index] > MOST_IN_A_ROW:
            raise kind(f"{place(index, step)}: {what}. The step was not stored: look into the environment")

    def _tell(self, what: str) -> None:
        self.count += 1
        if self.count <= TOLD:
            more = "; further ones are only counted" if self.count == TOLD else ""
            logger.warning(f"{what}. Its episode ends with the step before{more}")


def refuse_reset(index: int, fresh: GoalObservation, info: Plain) -> None:
    """Refuse an episode that begins badly, about which nothing can be done.

    :param index: of the environment
    :param fresh: what it shows
    :param info: what it says
    :raises EnvironmentFault: if a value has another shape than it should
    :raises NonFiniteError: if one is not finite
    """
    what = info.get(BAD_STEP) or not_finite(fresh)
    if what is not None:
        kind = EnvironmentFault if BAD_STEP in info else NonFiniteError
        raise kind(f"{place(index, 0)}: {what}. A reset cannot be skipped")


def before_reset(observation: GoalObservation, dones: BoolArray, infos: list[Plain]) -> GoalObservation:
    """What a step led to: SB3 hides the last observation of an episode in ``info``."""
    ended = np.flatnonzero(dones) if np.count_nonzero(dones) else ()
    if not len(ended):
        return observation
    seen = {key: np.array(observation[key]) for key in observation}
    for index in ended:
        for key in seen:
            seen[key][index] = infos[index]["terminal_observation"][key]
    return seen


class GuardedVecEnv(CopyableVecEnvWrapper):
    """The same in the form of a vector, for SB3's own algorithms.

    :param venv: see :class:`Guard`
    :param on_bad_step: likewise
    :param steps: of the running episodes so far, ``(n_envs,)``
    """

    def __init__(
        self,
        venv: VecEnv,
        on_bad_step: OnBadStep = "stop",
        steps: AnyArray | None = None,
    ) -> None:
        super().__init__(venv)
        self.guard = Guard(venv, on_bad_step)
        self.steps = np.zeros(venv.num_envs, dtype=np.int64) if steps is None else steps.copy()
        self.judge = EpisodeJudge(venv)
        self._actions: AnyArray = np.zeros(0)

    def reset(self) -> VecEnvObs:
        """Reset every environment, see :meth:`Guard.reset`."""
        self.steps[:] = 0
        return self.guard.reset()  # type: ignore[return-value]

    def step_async(self, actions: AnyArray) -> None:
        """Take note of the actions."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step, see :meth:`Guard.step`; ``info["is_success"]`` says of each episode that ends whether it succeeded."""
        step = self.guard.step(self._actions, self.steps)
        self.steps += 1
        self.steps[step.dones] = 0
        for index in np.flatnonzero(step.dones):
            step.infos[index]["is_success"] = self.judge.succeeded(step.infos[index])
        return step.observation, step.rewards, step.dones, step.infos  # type: ignore[return-value]
