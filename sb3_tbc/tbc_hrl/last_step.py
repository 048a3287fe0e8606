"""Keeps the step at which a callback stops SB3's off-policy algorithms, which they themselves drop."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import PlainMapping


class KeepsLastStep(OffPolicyAlgorithm):
    """An off-policy algorithm that can go on where a callback has stopped it.

    SB3 returns before it stores that step, although the environments have taken it. The next call of ``learn`` would
    join what was seen before it to what follows two steps later: if the step ended an episode, in the next one.
    """

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any) -> RolloutReturn:
        """Collect and store steps, see SB3; that at which the callback stops is stored, too."""
        rollout = super().collect_rollouts(env, callback, *args, **kwargs)
        if not rollout.continue_training:
            self._keep(callback.locals)
        return rollout

    def _keep(self, step: PlainMapping) -> None:
        """Do what SB3 does with a step after the callback.

        :param step: local variables of SB3's ``collect_rollouts``, as callbacks see them
        """
        infos, dones = step["infos"], step["dones"]
        self._update_info_buffer(infos, dones)
        self._store_transition(
            step["replay_buffer"], step["buffer_actions"], step["new_obs"], step["rewards"], dones, infos
        )
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        for index in np.flatnonzero(dones):
            self._episode_num += 1
            if step["action_noise"] is not None:
                step["action_noise"].reset(**({"indices": [index]} if len(dones) > 1 else {}))
