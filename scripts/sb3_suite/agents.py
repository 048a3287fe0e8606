"""TBC-HRL, HiTS and HAC under the arguments of Stable-Baselines3's algorithms."""

from __future__ import annotations

import functools
import os
from typing import Any

import gymnasium as gym
import pytest
from goal_envs import AsGoalEnv
from tests_apart import BUFFER, SDE

from sb3_tbc import HAC, TBCHRL, HiTS

OF_A_LEVEL = ("learning_rate", "batch_size", "buffer_size", "tau", "gamma", "ent_coef", "target_entropy")
WITHOUT_COUNTERPART = ("train_freq", "n_steps", "n_epochs", "action_noise", "replay_buffer_class",
                       "exploration_final_eps", "target_update_interval", "policy_kwargs")  # fmt: skip
"""Arguments of SB3 that are left out where a test happens to give them: levels explore and update in their own way."""
OF_IMAGES = ("features_extractor_kwargs",)
UPDATES = {"SAC": 1.0, "TD3": 1.0, "DDPG": 1.0, "DQN": 1.0, "A2C": 0.2, "PPO": 0.2}
"""Updates per step, by what is replaced, where a test does not say."""


def translated(arguments: dict[str, Any], as_given: bool = False) -> dict[str, Any]:
    """SB3's arguments for an agent of one level as those of one with two; a case that needs others is skipped.

    :param as_given: hand on what there is not here, to be refused
    """
    given = dict(arguments)
    if as_given:
        level = {name: given.pop(name) for name in OF_A_LEVEL if name in given}
        level |= {"policy_kwargs": given.pop("policy_kwargs")} if given.get("policy_kwargs") else {}
        return given | ({"high": dict(level), "low": dict(level)} if level else {})
    if given.pop("use_sde", False):
        pytest.skip(SDE)
    if given.pop("optimize_memory_usage", False):
        pytest.skip(BUFFER)
    if "gradient_steps" in given or "train_freq" in given:
        steps, frequency = given.pop("gradient_steps", 1), given.get("train_freq", 1)
        given["gradient_ratio"] = steps / frequency if isinstance(frequency, int) and steps > 0 else 1.0
    given |= _hindsight(given.pop("replay_buffer_kwargs", {}))
    level = {name: given.pop(name) for name in OF_A_LEVEL if name in given}
    if given.get("policy_kwargs"):
        level["policy_kwargs"] = _networks(given["policy_kwargs"])
    both = {"high": dict(level), "low": dict(level)} if level else {}
    return {name: value for name, value in given.items() if name not in WITHOUT_COUNTERPART} | both


def _hindsight(replay: dict[str, Any]) -> dict[str, Any]:
    """What an agent is told of SB3's hindsight replay."""
    found = {}
    if "n_sampled_goal" in replay:
        found["n_hindsight_goals"] = replay["n_sampled_goal"]
    if "goal_selection_strategy" in replay:
        strategy = replay["goal_selection_strategy"]
        found["goal_strategy"] = strategy if isinstance(strategy, str) else strategy.name.lower()
    return found


def _networks(policy_kwargs: dict[str, Any]) -> dict[str, Any]:
    """Networks of a level from those of an agent; value networks are of on-policy algorithms."""
    networks = {name: value for name, value in policy_kwargs.items() if name not in OF_IMAGES}
    shape = networks.get("net_arch", [])
    if any(isinstance(part, dict) for part in shape) or "vf" in shape:
        pytest.skip("networks of on-policy algorithms")
    if isinstance(shape, dict) and len(shape) == 1:
        networks["net_arch"] = {"qf": [64, 64], **shape}
    return networks


class Adapted:
    """What makes one of our algorithms callable as one of SB3's; goes before it among the bases of a class."""

    replaces: str
    """SB3's algorithm, under whose name TensorBoard's files are expected."""
    wired: bool
    """Whether the low level may be a circuit."""
    as_given: bool
    """Whether arguments that there are not here are handed on."""

    def __init__(self, policy: Any, env: Any = None, **arguments: Any) -> None:
        if arguments.get("_init_setup_model", True):
            arguments = self._ours(arguments)
            as_it_is = is_goal_env(env) or policy not in ("MlpPolicy", "MultiInputPolicy")
            policy = policy if as_it_is else "MultiInputPolicy"
        super().__init__(policy, env, **arguments)  # type: ignore[call-arg]

    def _ours(self, arguments: dict[str, Any]) -> dict[str, Any]:
        given = translated(arguments, self.as_given)
        levels = {name: {"batch_size": 16, "buffer_size": 20_000, **given.pop(name, {})} for name in ("high", "low")}
        if not self.wired:
            levels["low"]["policy_kwargs"] = {**levels["low"].get("policy_kwargs", {}), "ndbc": None}
        short = {"max_options": 10, "dt_max": 3.0}  # episodes end, and are learnt from, within 30 steps
        return {"compile": False, "gradient_ratio": UPDATES[self.replaces], **short, **given, **levels}

    def learn(self, *args: Any, **given: Any) -> Any:
        """Learn, see SB3."""
        return super().learn(*args, **{"tb_log_name": self.replaces, **given})  # type: ignore[misc]

    @classmethod
    def load(cls, path: Any, env: Any = None, device: Any = "auto", custom_objects: Any = None, **given: Any) -> Any:
        """Load, see SB3; settings of an agent of one level go to both levels."""
        custom = dict(custom_objects or {})
        moved = {name: custom.pop(name) for name in OF_A_LEVEL if name in custom}
        sb3 = {name: given.pop(name) for name in ("print_system_info", "force_reset", "verbose") if name in given}
        return super().load(path, env, device, custom, **sb3, **translated({**moved, **given}, cls.as_given))  # type: ignore[misc]

    def __getattr__(self, name: str) -> Any:
        if name in ("log_ent_coef", "ent_coef_tensor") and "low" in self.__dict__:
            return getattr(self.low, name)
        return super().__getattr__(name)  # type: ignore[misc]

    @property
    def learning_rate(self) -> Any:
        """The low level's."""
        return self.low_settings["learning_rate"] if "settings" in self.__dict__ else 0.0  # type: ignore[attr-defined]

    @learning_rate.setter
    def learning_rate(self, value: Any) -> None:
        pass

    @property
    def gamma(self) -> float:
        """The low level's."""
        return float(self.low_settings["gamma"])  # type: ignore[attr-defined]


def is_goal_env(env: Any) -> bool:
    """Whether SB3's suite itself asks for a policy for goals here."""
    while isinstance(env, gym.Wrapper) and not isinstance(env, AsGoalEnv):
        env = env.env
    return isinstance(env, AsGoalEnv) and env.is_goal


@functools.cache
def ours(replaces: str, wired: bool, as_given: bool = False) -> type[Any]:
    """The algorithm that takes the place of one of SB3's in this process."""
    algorithm = {"tbc-hrl": TBCHRL, "hits": HiTS, "hac": HAC}[os.environ["SB3_SUITE_ALGO"]]
    return type(algorithm.__name__, (Adapted, algorithm), {"replaces": replaces, "wired": wired, "as_given": as_given})
