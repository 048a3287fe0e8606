"""The semi-Markov problem that a fixed low level makes of a task: any algorithm can be the high level in it."""

from __future__ import annotations

from typing import cast

import numpy as np
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import AnyArray, FloatArray, Indices
from sb3_tbc.errors import EnvironmentFault, NonFiniteError
from sb3_tbc.smdp.copyable import CopyableVecEnvWrapper
from sb3_tbc.smdp.episode_limit import (
    BUDGET_EXHAUSTED,
    LastWindow,
    LimitingVecEnv,
    announce,
    can_tell,
    with_episode_limit,
)
from sb3_tbc.smdp.faults import reset_or_name
from sb3_tbc.smdp.finite import not_finite
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, check_goal_space, rows_of
from sb3_tbc.smdp.guard import refuse_reset
from sb3_tbc.smdp.last_windows import LastWindows
from sb3_tbc.smdp.options import OptionClock
from sb3_tbc.smdp.shapes import BAD_STEP, checked, shapes_of
from sb3_tbc.smdp.spaces import GoalObservation
from sb3_tbc.tbc_hrl.foreign_high import refuse_reconsidering
from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL


class OptionEnv(CopyableVecEnvWrapper):
    """One step is one option: the action is a subgoal with its time budget, which a trained low level executes.

    Observations are what the high level of an agent sees, one flat vector; actions are in [-1, 1]. A step's reward is
    the high level's (paper section 4.1, without completion bonus), ``info["discount"]`` the factor of the next state's
    value, for algorithms that use it, and ``info["option"]`` says what happened. Episodes end as the agent's do.

    Options differ in length, so each environment is stepped by itself until its option is over::

        venv = OptionEnv(make_vec_env("sb3_tbc/Pendulum-v0", 4), agent)
        high = PPO("MlpPolicy", venv).learn(50_000)
        agent = TBCHRL.from_levels(high, agent)

    :param venv: a ``DummyVecEnv`` or ``SubprocVecEnv`` of the agent's task; wrappers of vectors (``VecMonitor``) go
        around the ``OptionEnv``
    :param agent: gives the low level, and what ends an option; it is used as it is, not trained
    :param deterministic: whether the low level acts by its means
    :param seed: of the low level's noise where it does not
    :raises ValueError: if ``venv`` is wrapped, or is no vector of goal environments; if the agent's high level ends
        windows before their time, which another algorithm cannot do
    """

    def __init__(self, venv: VecEnv, agent: TBCHRL, deterministic: bool = True, seed: int | None = None) -> None:
        if not isinstance(venv, VecEnv) or not isinstance(agent, TBCHRL):
            raise ValueError(
                "OptionEnv needs a vector of environments and a TBCHRL, got "
                f"{type(venv).__name__} and {type(agent).__name__}; DummyVecEnv([lambda: env]) makes a vector"
            )
        if isinstance(venv, VecEnvWrapper):
            raise ValueError(
                f"OptionEnv steps each environment by itself, past {type(venv).__name__}: give it the DummyVecEnv or "
                "SubprocVecEnv itself, and put wrappers around the OptionEnv"
            )
        refuse_reconsidering(agent.rules)
        space = check_goal_space(venv.observation_space, venv.action_space)
        check_for_correct_spaces(venv, agent.observation_space, agent.action_space)
        policy = agent.policy
        super().__init__(
            with_episode_limit(venv),
            observation_space=policy.views.high_space(space),
            action_space=policy.views.high_action_space(),
        )
        self.agent, self.policy, self.deterministic = agent, policy, deterministic
        self.rng = np.random.default_rng(seed)
        self.clock = OptionClock(venv.num_envs, policy.views.subgoals, policy.rules)
        self._last_windows = LastWindows(self.venv, self.clock, can_tell(self.venv))
        self._membrane = policy.actor.blank(venv.num_envs)
        self._shapes = shapes_of(venv.observation_space)  # env_method brings what worker processes have not checked
        self._seen: dict[str, FloatArray] = {}
        self._actions: FloatArray = np.zeros((venv.num_envs, 0))

    def reset(self) -> FloatArray:
        """Begin an episode everywhere; weights of the agent that were changed by hand hold from now on.

        :raises EnvironmentFault: if an environment fails, or shows something of another shape than it should
        :raises NonFiniteError: if it shows something that is not finite
        """
        self.policy.actor.notice_changes()
        observation = cast(GoalObservation, reset_or_name(self.venv))
        self.reset_infos = list(self.venv.reset_infos)
        self._seen = {key: np.array(observation[key]) for key in GOAL_KEYS}
        for index, info in enumerate(self.reset_infos):
            refuse_reset(index, rows_of(self._seen, index), info)
        self._forget(np.arange(self.num_envs))
        return self.policy.views.high(self._seen)

    def step_async(self, actions: AnyArray) -> None:
        """Take the next options, in unit coordinates; what lies outside [-1, 1] is clipped."""
        self._actions = np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0)

    def step_wait(self) -> VecEnvStepReturn:
        """Run every environment to the end of its option."""
        self._begin()
        rewards: list[list[float]] = [[] for _ in range(self.num_envs)]
        dones = np.zeros(self.num_envs, dtype=bool)
        infos: list[Plain] = [{} for _ in range(self.num_envs)]
        live = np.arange(self.num_envs)
        while len(live):
            self._last_windows.announce(live)
            for index, action in zip(live, self._act(live), strict=True):
                reward, dones[index], infos[index] = self._step_one(int(index), action)
                rewards[index].append(reward)
            self.clock.elapsed[live] += 1
            over = self.clock.ended(self._seen) | dones
            self._membrane = self.policy.actor.forget(self._membrane, over, dones)
            live = live[~over[live]]
        values = np.array([self._close(i, rewards[i], bool(dones[i]), infos[i]) for i in range(self.num_envs)])
        ended = np.array(["terminal_observation" in info for info in infos])
        return self.policy.views.high(self._seen), values.astype(np.float32), ended, infos

    # ------------------------------------------------------------------ inner workings

    def _forget(self, where: Indices) -> None:
        self.clock.begin_episode(where)
        self._membrane[where] = 0.0

    def _begin(self) -> None:
        """Start the options that were asked for."""
        schedule, everywhere = self.policy.schedule, np.arange(self.num_envs)
        unit = self._actions if schedule is None else schedule(self._actions, self._seen)
        self.clock.begin(everywhere, unit)
        self._last_windows.note(everywhere)

    def _act(self, live: Indices) -> AnyArray:
        """The low level's actions in the environments whose option is running."""
        policy, clock = self.policy, self.clock
        observation = policy.views.low(rows_of(self._seen, live), clock.subgoal[live], clock.remaining[live])
        unit, self._membrane[live] = policy.actor.act(observation, self._membrane[live], self.deterministic, self.rng)
        actions: AnyArray = policy.unit.unscale(unit)
        return actions

    def _step_one(self, index: int, action: AnyArray) -> tuple[float, bool, Plain]:
        """One step of one environment: its reward, whether its episode is over, its info."""
        observation, reward, terminated, truncated, info = self.venv.env_method("step", action, indices=[index])[0]
        observation, info = checked(observation, info, self._shapes)
        for key in GOAL_KEYS:
            self._seen[key][index] = observation[key]
        self._refuse_bad(index, float(reward), info)
        over = bool(terminated or truncated)
        return float(reward), over, {**info, "TimeLimit.truncated": over and not terminated}

    def _refuse_bad(self, index: int, reward: float, info: Plain) -> None:
        """Let nothing through that is not finite, or of another shape.

        :raises EnvironmentFault: if a value has another shape than it should
        :raises NonFiniteError: if one is not finite
        """
        step = int(self.clock.elapsed[index]) + 1
        if BAD_STEP in info:
            raise EnvironmentFault(f"environment {index}, step {step} of its option: {info[BAD_STEP]}")
        wrong = not_finite(rows_of(self._seen, index), reward)
        if wrong is not None:
            raise NonFiniteError(f"environment {index}, step {step} of its option: {wrong}")

    def _close(self, index: int, rewards: list[float], over: bool, info: Plain) -> float:
        """Reward of the option that ended; begins a new episode where that is over, too."""
        reward, duration = self.agent.high_reward, np.array([len(rewards)])
        where = np.array([index])
        reached = bool(self.clock.reached(rows_of(self._seen, where), where)[0])
        cut_off = over and not (info["TimeLimit.truncated"] and info.get(BUDGET_EXHAUSTED, False))
        info["option"] = self.clock.close(index, int(duration[0]), reached, cut_off).as_info()
        info["discount"] = float(reward.discounts(duration)[0])
        value = reward.window_rewards(np.array(rewards), np.array([0]), duration)[0]
        value -= reward.price(self.clock.time_budget[index])
        if over or self.clock.is_last[index]:
            info["TimeLimit.truncated"] = bool(info["TimeLimit.truncated"] or not over)
            if not over:
                self._end_late(index, info)
            self._restart(index, info)
        return float(value)

    def _end_late(self, index: int, info: Plain) -> None:
        """End an episode whose last window's end the task did not see, by a step that does not count.

        So a ``Monitor`` sees the end. Environments without wrappers have none that would.
        """
        if isinstance(self.venv, LimitingVecEnv):
            return
        announce(self.venv, index, LastWindow(True))
        action = self._act(np.array([index]))[0]
        told = self.venv.env_method("step", action, indices=[index])[0][-1]
        info |= {key: told[key] for key in ("episode",) if key in told}

    def _restart(self, index: int, info: Plain) -> None:
        where = np.array([index])
        info["terminal_observation"] = self.policy.views.high(rows_of(self._seen, where))[0]
        observation, told = self.venv.env_method("reset", indices=[index])[0]
        observation, self.reset_infos[index] = checked(observation, told, self._shapes)
        refuse_reset(index, observation, self.reset_infos[index])
        for key in GOAL_KEYS:
            self._seen[key][index] = observation[key]
        self._forget(where)
