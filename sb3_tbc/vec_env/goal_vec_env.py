"""Goal environments side by side in this process."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_tbc.spaces import GoalObservation


class GoalVecEnv(DummyVecEnv):
    """SB3's ``DummyVecEnv`` for goal environments: the same results, without its deep copies.

    On tasks that step in microseconds those copies take longer than the task. Observations and infos are still the
    caller's own: arrays are copied, and so is the dictionary of an info, though not what lies in it.
    """

    def step_wait(self) -> VecEnvStepReturn:
        """Step every environment and reset those whose episode is over."""
        infos: list[dict[str, Any]] = []
        for index, env in enumerate(self.envs):
            observation, self.buf_rews[index], terminated, truncated, given = env.step(self.actions[index])
            info = {**given, "TimeLimit.truncated": truncated and not terminated}
            over = self.buf_dones[index] = terminated or truncated
            if over:
                info["terminal_observation"] = observation
                observation, self.reset_infos[index] = env.reset()
            for key, array in self.buf_obs.items():
                array[index] = observation[key]
            infos.append(info)
        return self._obs_from_buf(), self.buf_rews.copy(), self.buf_dones.copy(), infos  # type: ignore[return-value]

    def _obs_from_buf(self) -> GoalObservation:  # type: ignore[override]
        return {key: array.copy() for key, array in self.buf_obs.items()}
