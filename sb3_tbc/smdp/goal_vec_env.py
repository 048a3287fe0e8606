"""Goal environments side by side in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_tbc.aliases import Env, Plain
from sb3_tbc.arrays import AnyArray
from sb3_tbc.smdp.faults import fault
from sb3_tbc.smdp.goal_spaces import goal_space_problems
from sb3_tbc.smdp.spaces import GoalObservation


class RunningEpisode(NamedTuple):
    """What is needed to replay an unfinished episode."""

    seed: int | None  # given to the reset; if None, the generator's state is used
    generator: Plain  # state of the task's random generator before the reset
    actions: list[AnyArray]  # taken since the reset
    others: Sequence[Plain] = ()  # likewise, of generators that wrappers of ours have


def in_goal_vec_env(env: Env | VecEnv) -> Env | VecEnv:
    """A single goal environment, monitored, as a :class:`GoalVecEnv`; anything else as it is."""
    if isinstance(env, VecEnv) or goal_space_problems(env.observation_space):
        return env
    return GoalVecEnv([lambda: env if is_wrapped(env, Monitor) else Monitor(env)])


class GoalVecEnv(DummyVecEnv):
    """SB3's ``DummyVecEnv`` for goal environments: the same results, without its deep copies.

    On tasks that step in microseconds those copies take longer than the task. Observations and infos are still the
    caller's own: arrays are copied, and so is the dictionary of an info, though not what lies in it.

    Running episodes are recorded, and can be replayed in environments made later. These then reach the same state if
    all their randomness comes from ``np_random``, as Gymnasium requires.
    """

    def __init__(self, env_fns: list[Callable[[], Env]]) -> None:
        super().__init__(env_fns)
        self.running = [RunningEpisode(None, {}, []) for _ in self.envs]

    def reset(self) -> GoalObservation:  # type: ignore[override]
        """Begin an episode everywhere."""
        for index, seed in enumerate(self._seeds):
            self._note_start(index, seed)
        return super().reset()  # type: ignore[return-value]

    def env_method(self, method_name: str, *args: object, indices: VecEnvIndices = None, **kwargs: Any) -> list[object]:
        """Call a method of environments, see SB3; an episode begun this way is noted."""
        if method_name == "reset":
            for index in self._get_indices(indices):
                self._note_start(index, kwargs.get("seed"))
        return super().env_method(method_name, *args, indices=indices, **kwargs)

    def _note_start(self, index: int, seed: int | None) -> None:
        env, states = self.envs[index], []
        if seed is None:
            states = [dict(generator.state) for generator in (env.unwrapped.np_random.bit_generator, *_others(env))]
        self.running[index] = RunningEpisode(seed, states[0] if states else {}, [], states[1:])

    def relive(self, running: Sequence[RunningEpisode]) -> GoalObservation:
        """Begin the same episodes again, take the same actions, and return the observations they lead to."""
        for index, (env, episode) in enumerate(zip(self.envs, running, strict=True)):
            if episode.seed is None:
                env.unwrapped.np_random.bit_generator.state = episode.generator
                for generator, state in zip(_others(env), episode.others, strict=False):  # older runs have none
                    generator.state = state
            observation, self.reset_infos[index] = env.reset(seed=episode.seed)
            for action in episode.actions:
                observation = env.step(action)[0]
            self._save_obs(index, observation)
            self.running[index] = episode._replace(actions=list(episode.actions))
        return self._obs_from_buf()

    def step_wait(self) -> VecEnvStepReturn:
        """Step every environment and reset those whose episode is over."""
        infos: list[Plain] = []
        for index, env in enumerate(self.envs):
            action, step = self.actions[index], len(self.running[index].actions) + 1
            kept = np.array(action)  # the task may change the other in place
            try:
                observation, self.buf_rews[index], terminated, truncated, given = env.step(action)
                self.running[index].actions.append(kept)
                info = {**given, "TimeLimit.truncated": truncated and not terminated}
                over = self.buf_dones[index] = terminated or truncated
                if over:
                    info["terminal_observation"] = observation
                    observation = self._reset_one(index)
                for key, array in self.buf_obs.items():
                    array[index] = observation[key]
            except Exception as error:  # a task's own code may fail in any way
                raise fault(index, step, error) from error
            infos.append(info)
        return self._obs_from_buf(), self.buf_rews.copy(), self.buf_dones.copy(), infos  # type: ignore[return-value]

    def _reset_one(self, index: int) -> GoalObservation:
        self._note_start(index, None)
        try:
            observation, self.reset_infos[index] = self.envs[index].reset()
        except Exception as error:  # a task's own code may fail in any way
            raise fault(index, 0, error) from error
        return observation  # type: ignore[no-any-return]

    def _obs_from_buf(self) -> GoalObservation:  # type: ignore[override]
        return {key: array.copy() for key, array in self.buf_obs.items()}


def _others(env: Env) -> list[Any]:
    """Bit generators that a wrapper has beside the task's own."""
    return env.get_wrapper_attr("bit_generators") if env.has_wrapper_attr("bit_generators") else []
