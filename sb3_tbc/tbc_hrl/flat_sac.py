"""The flat baseline: Stable-Baselines3's own SAC with hindsight experience replay, behind our runner."""

from __future__ import annotations

import io
import pathlib
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac.policies import MultiInputPolicy

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import Arrays, put_under, taken_from
from sb3_tbc.files import write_arrays
from sb3_tbc.reading import read_arrays
from sb3_tbc.replay.both_levels import MORE
from sb3_tbc.settings import SettingError, hints
from sb3_tbc.smdp.episode_limit import with_episode_limit
from sb3_tbc.smdp.goal_test import check_goal_test
from sb3_tbc.smdp.guard import GuardedVecEnv, OnBadStep
from sb3_tbc.smdp.hindsight import check_goal_strategy
from sb3_tbc.tbc_hrl import resume
from sb3_tbc.tbc_hrl.arguments import FlatArguments, SB3Arguments, SignatureOfSettings, takes
from sb3_tbc.tbc_hrl.averaged_policy import AveragedPolicy
from sb3_tbc.tbc_hrl.checks import refuse_policy, refuse_vec_normalize, whole_steps, without_sb3_names
from sb3_tbc.tbc_hrl.config import FlatConfig
from sb3_tbc.tbc_hrl.diagnostics import record_settings
from sb3_tbc.tbc_hrl.environment import in_fitting_vector, in_vector, subgoals_of
from sb3_tbc.tbc_hrl.flat_replay import TerminatingHerReplayBuffer
from sb3_tbc.tbc_hrl.last_step import KeepsLastStep
from sb3_tbc.tbc_hrl.level_config import learning_rate_of
from sb3_tbc.tbc_hrl.saving import UNFIT, PlainAlgorithm

SelfFlatSAC = TypeVar("SelfFlatSAC", bound="FlatSAC")

CYCLE = 100
"""Environment steps between two bursts of updates."""
_NO_BUFFER: Any = object()


def sb3_arguments(config: FlatConfig) -> Plain:
    """Settings under the names, and in the forms, that Stable-Baselines3's SAC takes."""
    by_event = config.goal_strategy == "event"
    same = ("batch_size", "gamma", "tau", "ent_coef", "target_entropy", "buffer_size", "learning_starts")
    return {
        **{name: getattr(config, name) for name in same},
        "learning_rate": learning_rate_of(config.learning_rate),
        "replay_buffer_kwargs": {
            "n_sampled_goal": config.n_hindsight_goals,
            "goal_selection_strategy": "future" if by_event else config.goal_strategy,
            "event_goals": by_event,
        },
        "policy_kwargs": config.policy_kwargs.to_dict(),
    }


class FlatSAC(PlainAlgorithm, KeepsLastStep, SAC):
    """SB3's SAC, goal-conditioned, with :class:`TerminatingHerReplayBuffer`, under the names of our configurations.

    :param policy: ``"MultiInputPolicy"``
    :param env: a goal environment
    :param arguments: settings, see :class:`~sb3_tbc.tbc_hrl.config.FlatConfig`, and Stable-Baselines3's ``seed, device,
        verbose, tensorboard_log, stats_window_size``
    :raises ConfigError: on an unknown setting or a value that it cannot have
    :raises ValueError: if ``goal_strategy`` is ``"event"`` on a task without one
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": MultiInputPolicy}
    config_class: ClassVar[type[FlatConfig]] = FlatConfig
    stop_requested: bool
    """Set it to make :meth:`learn` return at the next point from which learning can be continued exactly."""
    _guarded: GuardedVecEnv | None = None
    __signature__ = SignatureOfSettings(SB3Arguments)

    @takes(FlatArguments)
    def __init__(self, policy: str | type[BasePolicy], env: GymEnv | str, **arguments: object) -> None:
        refuse_policy(policy, self.policy_aliases)
        sb3, settings = SB3Arguments.taken_from(without_sb3_names(arguments))
        config = self.config_class.from_dict(settings)
        self.settings = config.to_dict()
        self.gradient_ratio = config.gradient_ratio
        self._updated_at, self._owed = 0, 0.0
        self._counted_to: int | None = None
        self._resumed: Plain = {}
        self.stop_requested = False
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,
            **sb3_arguments(config),
            train_freq=(CYCLE, "step"),
            gradient_steps=1,  # see _update
            replay_buffer_class=TerminatingHerReplayBuffer,
            stats_window_size=sb3.stats_window_size,
            tensorboard_log=None if sb3.tensorboard_log is None else str(sb3.tensorboard_log),
            verbose=sb3.verbose,
            device=sb3.device,
            seed=sb3.seed,
            _init_setup_model=False,
        )
        if self.env is not None:
            refuse_vec_normalize(self.env)
            check_goal_test(self.env, listed_infos=True)
        if sb3._init_setup_model:
            self._setup_model()

    _wrap_env = staticmethod(in_vector)

    def _setup_model(self) -> None:
        """Build the networks; without an environment there is no hindsight replay, and the agent can only act."""
        if self.settings.get("average_decay") and self.policy_class is MultiInputPolicy:
            self.policy_class = AveragedPolicy
        if self.target_entropy == "auto":
            self.target_entropy = -float(get_action_dim(self.action_space))  # SB3 asks the environment
        if self.env is None:
            self.replay_buffer = _NO_BUFFER  # so that SB3 makes none
        else:
            self._check_event(self.env)
        super()._setup_model()
        if self.replay_buffer is _NO_BUFFER:
            self.replay_buffer = None

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Learn in another environment from now on, see SB3.

        :raises ValueError: if the environment does not fit the agent
        """
        venv = in_fitting_vector(env, self)
        self._check_event(venv)
        super().set_env(venv, force_reset)
        self._ensure_buffer()
        self._her_buffer().env = self.env  # whose goal test labels hindsight

    def _check_event(self, env: VecEnv) -> None:
        """Refuse a task without the event that hindsight goals are to come from.

        :raises ValueError: if it names none
        """
        if self.settings.get("goal_strategy") == "event":
            check_goal_strategy("event", subgoals_of(env))

    def _ensure_buffer(self) -> None:
        """Make an empty replay buffer if there is none, as in an agent that was loaded without an environment."""
        if self.env is not None and not isinstance(getattr(self, "replay_buffer", None), TerminatingHerReplayBuffer):
            self.replay_buffer = TerminatingHerReplayBuffer(
                self.buffer_size, self.observation_space, self.action_space, env=self.env, device=self.device,
                n_envs=self.n_envs, **self.replay_buffer_kwargs,
            )  # fmt: skip

    def learn(
        self: SelfFlatSAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "SAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfFlatSAC:
        """Collect :data:`CYCLE` steps, then update in a burst, until ``total_timesteps`` steps are done.

        As with the two-level agents, several short calls learn what one long one does, and setting
        :attr:`stop_requested` makes it return before or after a burst of updates, never within one.

        :raises ValueError: without an environment, or if ``total_timesteps`` is negative
        :raises TypeError: if ``total_timesteps`` is not a whole number
        """
        total_timesteps = whole_steps(total_timesteps)
        if self.env is None:
            raise ValueError("learn needs an environment: pass env to load, or call set_env first")
        resumed, self._resumed = {} if reset_num_timesteps else self._resumed, {}
        anew = reset_num_timesteps or self._last_obs is None  # then SB3 resets the environments
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if reset_num_timesteps:
            self._updated_at, self._owed = 0, 0.0
        elif self._counted_to is not None:
            self._updated_at += self.num_timesteps - self._counted_to  # steps that were not done here owe no updates
        self._counted_to = self.num_timesteps
        record_settings(self, self.settings)
        relived = bool(resumed) and resume.set_flat_state(self, self.env, resumed)
        if (anew or resumed) and not relived:
            self.close_running_episodes()  # hindsight goals are of the same episode
        before = None if anew or resumed or self._guarded is None else self._guarded.guard
        self._guarded = GuardedVecEnv(with_episode_limit(self.env), self.on_bad_step, self._her_buffer().steps())
        self._guarded.guard.begin(self._last_obs)  # type: ignore[arg-type]
        if not anew:
            self._guarded.guard.go_on(self._last_obs, before)  # type: ignore[arg-type]
        callback.on_training_start(locals(), globals())
        while True:
            if self.num_timesteps - self._updated_at >= CYCLE:
                self._update()
            left = min(total_timesteps - self.num_timesteps, CYCLE - (self.num_timesteps - self._updated_at))
            if left <= 0 or self.stop_requested:
                break
            if not self._collect(-(-left // self.n_envs), callback, log_interval):
                break
        callback.on_training_end()
        return self

    def _collect(self, steps: int, callback: BaseCallback, log_interval: int) -> bool:
        """Step every environment ``steps`` times; False if a callback asks to stop."""
        assert self._guarded is not None
        rollout = self.collect_rollouts(
            self._guarded,
            callback,
            TrainFreq(steps, TrainFrequencyUnit.STEP),
            self._her_buffer(),
            self.action_noise,
            self.learning_starts,
            log_interval,
        )
        self._counted_to = self.num_timesteps
        return bool(rollout.continue_training)

    def _update(self) -> None:
        """Do the updates that ``gradient_ratio`` gives for the steps since the last call; a fraction is kept for later.

        Before the first episode has ended there are no hindsight goals: the updates wait for it.
        """
        steps = max(self.num_timesteps - max(self._updated_at, self.learning_starts), 0)
        self._updated_at = self.num_timesteps
        self._owed += self.gradient_ratio * steps
        updates = int(self._owed)
        if updates and self._her_buffer().ep_length.any():
            self._owed -= updates
            self.train(updates, self.batch_size)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """SB3's updates; where an average of the actor is kept, it follows each of them."""
        if not isinstance(self.policy, AveragedPolicy):
            super().train(gradient_steps, batch_size)
            return
        for _ in range(gradient_steps):
            super().train(1, batch_size)
            self.policy.follow(self._n_updates, self.settings["average_decay"])

    @property
    def on_bad_step(self) -> OnBadStep:
        """What follows where an environment gives what is not finite."""
        return self.settings.get("on_bad_step", "stop")  # type: ignore[no-any-return]

    def dump_logs(self) -> None:
        """Write what was seen since the last time, see SB3."""
        if self._guarded is not None and self._guarded.guard.count:
            self.logger.record("rollout/bad_steps", self._guarded.guard.count)
        super().dump_logs()

    def learning_state(self) -> Arrays:
        """What learning goes on from besides weights and replay, as plain arrays: random streams, running episodes."""
        return resume.get_flat_state(self)

    @classmethod
    def _changes(cls, given: PlainMapping, data: PlainMapping) -> Plain:
        changes, own = super()._changes(given, data), hints(cls.config_class)
        changed = {name: changes.pop(name) for name in own if name in changes}
        if not changed:
            return changes
        saved = {name: value for name, value in data.get("settings", {}).items() if name in own}
        if isinstance(changed.get("policy_kwargs"), Mapping):
            changed["policy_kwargs"] = {**saved.get("policy_kwargs", {}), **changed["policy_kwargs"]}
        config = cls.config_class.from_dict({**saved, **changed})
        if config.policy_kwargs != cls.config_class.from_dict(saved).policy_kwargs:
            raise SettingError("policy_kwargs", UNFIT)
        new = {*changed} - {"policy_kwargs"}
        if new & {"n_hindsight_goals", "goal_strategy"}:
            new.add("replay_buffer_kwargs")
        attributes = {**sb3_arguments(config), "gradient_ratio": config.gradient_ratio}
        changes |= {name: value for name, value in attributes.items() if name in new}
        return {**changes, "settings": config.to_dict()}

    def save_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, learning_state: Arrays | None = None
    ) -> None:
        """Write the replay buffer, and all else that is needed to continue learning, to one file of plain arrays.

        A model saved at the same moment and loaded together with this file continues with
        ``learn(..., reset_num_timesteps=False)`` as if it had never stopped, bit for bit.

        :param learning_state: of an earlier moment that the buffer was put back to; by default that of now
        """
        buffer = self._her_buffer()
        arrays: Plain = dict(buffer.parts())
        rows = buffer.buffer_size if buffer.full else buffer.pos
        arrays = {name: array[:rows] for name, array in arrays.items()}
        more = put_under(MORE, learning_state or self.learning_state())
        held = {"_start": buffer._current_ep_start, "pos": buffer.pos, "full": buffer.full}
        write_arrays(path, {**arrays, **held, **more})

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Read what :meth:`save_replay_buffer` wrote; only plain arrays are read, never pickled objects.

        :param truncate_last_traj: close the episode that was running when the buffer was saved, if it cannot be
            continued
        :raises ValueError: if the file was written for other spaces or a larger buffer
        """
        self._ensure_buffer()
        buffer = self._her_buffer()
        arrays = read_arrays(path)
        try:
            buffer.take_over(arrays)
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{path} is no saved replay buffer of such an agent: {error!r}") from error
        self._resumed = taken_from(MORE, arrays)
        if truncate_last_traj and not resume.can_go_on(self, self._resumed):
            self.close_running_episodes()

    def close_running_episodes(self) -> None:
        """End the running episodes where they are: what was stored of them is used, and they are not continued."""
        buffer = self._her_buffer()
        if (buffer._current_ep_start != buffer.pos).any():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # SB3 warns of what was just asked for
                buffer.truncate_last_trajectory()

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            *("_resumed", "stop_requested", "_guarded", "_settings_told_to", "_counted_to"),
        ]

    def _her_buffer(self) -> TerminatingHerReplayBuffer:
        if not isinstance(self.replay_buffer, TerminatingHerReplayBuffer):
            raise ValueError("there is no replay buffer: pass env when loading the agent, or call set_env first")
        return self.replay_buffer
