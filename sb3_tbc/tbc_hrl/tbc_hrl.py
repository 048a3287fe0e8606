"""TBC-HRL: a high level that emits a subgoal and a time budget, a low level that executes it inside that window."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.replay.both_levels import Replay
from sb3_tbc.settings import hints
from sb3_tbc.smdp.bounds import RewardRange
from sb3_tbc.smdp.goal_spaces import check_goal_space
from sb3_tbc.smdp.goal_test import check_goal_test
from sb3_tbc.smdp.hierarchical_vec_env import HierarchicalStep
from sb3_tbc.smdp.hindsight import GoalTest, check_goal_strategy
from sb3_tbc.smdp.options import Episode
from sb3_tbc.smdp.rewards import LowLevelReward
from sb3_tbc.smdp.views import LevelViews
from sb3_tbc.tbc_hrl import assembly, checks, resume
from sb3_tbc.tbc_hrl.actor import TwoLevelActor
from sb3_tbc.tbc_hrl.arguments import HierarchyArguments, SignatureOfSettings, TBCArguments, takes
from sb3_tbc.tbc_hrl.collection import Collector, EpisodeStore
from sb3_tbc.tbc_hrl.config import TBCConfig
from sb3_tbc.tbc_hrl.diagnostics import (
    EpisodeDiagnostics,
    ProgressBar,
    described,
    progress_bar_of,
    record_progress,
    record_settings,
)
from sb3_tbc.tbc_hrl.environment import (
    attribute_of,
    episode_length,
    in_fitting_vector,
    in_vector,
    reward_range,
    subgoals_of,
)
from sb3_tbc.tbc_hrl.foreign_high import put_together
from sb3_tbc.tbc_hrl.former_settings import take_settings
from sb3_tbc.tbc_hrl.idle_settings import warn_of_idle_settings
from sb3_tbc.tbc_hrl.level_config import learning_rate_of
from sb3_tbc.tbc_hrl.live_settings import LiveSettings
from sb3_tbc.tbc_hrl.policy import TBCPolicy
from sb3_tbc.tbc_hrl.reachability import UPDATE_EVERY
from sb3_tbc.tbc_hrl.two_level_saving import TwoLevelSaving

SelfTBCHRL = TypeVar("SelfTBCHRL", bound="TBCHRL")

MIN_UPDATES_TO_COMPILE = 3000
"""With ``compile="auto"`` fewer updates than this run eagerly: compiling costs about as much as they do."""


class TBCHRL(TwoLevelSaving):
    """Timed and bionic circuit hierarchical reinforcement learning (Li, Shan, Mo 2025).

    Two levels of SAC: the high level chooses a subgoal and a time budget, the low level acts until the time is spent.
    Settings are given by name, see :class:`~sb3_tbc.tbc_hrl.config.TBCConfig`; those of a level as ``high={...}`` and
    ``low={...}``, see :class:`~sb3_tbc.tbc_hrl.level_config.HighConfig` and
    :class:`~sb3_tbc.tbc_hrl.level_config.LowConfig`::

        TBCHRL("MultiInputPolicy", env, max_options=10, low={"learning_rate": 1e-3, "policy_kwargs": {"ndbc": None}})

    :param policy: ``"MultiInputPolicy"``
    :param env: a goal environment or its id; its ``subgoals`` attribute says what the high level may ask for
    :param arguments: settings; ``subgoals``, the subgoal space, for environments without an attribute of this name; and
        Stable-Baselines3's ``seed, device, verbose, tensorboard_log, stats_window_size``
    :raises ConfigError: on an unknown setting or a value that it cannot have
    :raises ValueError: if the environment has no goals, no subgoals or no time limit
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": TBCPolicy}
    policy: TBCPolicy
    config_class: ClassVar[type[TBCConfig]] = TBCConfig
    stop_requested: bool
    """Set it, from a signal handler or another thread, to make :meth:`learn` return at the next point from which
    learning can be continued exactly; it stays set until you set it to False."""
    __signature__ = SignatureOfSettings(HierarchyArguments)

    @takes(TBCArguments)
    def __init__(self, policy: str | type[BasePolicy], env: GymEnv | str | None, **arguments: object) -> None:
        checks.refuse_policy(policy, self.policy_aliases)
        checks.refuse_level_names(arguments := checks.without_sb3_names(arguments))
        others, settings = HierarchyArguments.taken_from(arguments)
        config = self.config_class.from_dict(settings)
        super().__init__(
            policy,
            env,
            learning_rate=0.0,  # each level has its own
            stats_window_size=others.stats_window_size,
            tensorboard_log=None if others.tensorboard_log is None else str(others.tensorboard_log),
            verbose=others.verbose,
            device="cpu",  # what SB3 takes auto for, a GPU, is not what it means here
            support_multi_env=True,
            seed=others.seed,
        )
        self.settings = config.to_dict()
        self.subgoals = others.subgoals
        self.episode_length: int | None = None
        self.reward_range: RewardRange | None = None
        self._n_updates = 0
        self._updated_at = 0  # num_timesteps at the last updates
        self._counted_to: int | None = None  # num_timesteps after our last step; what others add owes no updates
        self._owed: dict[str, float] = {}  # updates still to be done, by level; may be fractions
        self._burst_due = 0  # episodes stored since the last updates
        self.stop_requested = False
        self.collector: Collector | None = None
        self._resumed: Plain = {}  # what load_replay_buffer read of a run, for learn to continue
        if others._init_setup_model:
            checks.refuse_no_environment(env)
            self._setup_model()

    @property
    def high_settings(self) -> LiveSettings:
        """Settings of the high level; those in :data:`.CHANGEABLE` may be set, and hold from the next update on."""
        return self._live_settings("high")

    @property
    def low_settings(self) -> LiveSettings:
        """Settings of the low level, likewise."""
        return self._live_settings("low")

    def _live_settings(self, name: str) -> LiveSettings:
        return LiveSettings(name, self.settings[name], lambda key, value: self._change_setting(name, key, value))

    def _change_setting(self, name: str, key: str, value: object) -> None:
        self._change(name, {**self.settings[name], key: value})
        level, config = (self.high, self.config.high) if name == "high" else (self.low, self.config.low)
        if key == "learning_rate":
            level.learning_rate = learning_rate_of(config.learning_rate)
            level._setup_lr_schedule()
        elif key == "tau":
            level.tau = config.tau

    def _change(self, name: str, value: object) -> None:
        given = self.config_class.from_dict({**self.settings, name: value})
        self.settings, self.config = given.to_dict(), given.for_episodes_of(self.episode_length)

    @property
    def dt_max(self) -> float:
        """Longest time budget, environment steps."""
        return self.rules.dt_max

    @property
    def layout(self) -> LevelViews:
        """Former name of ``views``: what each level sees and chooses."""
        return self.views

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """A setting by its name, as ``model.max_options``: short for ``model.config.max_options``."""
            if name in hints(type(self).config_class) and "config" in self.__dict__:
                return getattr(self.config, name)
            checks.explain_level_setting(name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

        def __setattr__(self, name: str, value: object) -> None:
            """Set a setting that can still change, see :data:`.CHANGEABLE_LATER`; refuse what would change nothing."""
            if name in checks.OF_A_LEVEL:  # set in every step: a call costs more than the look
                checks.refuse_level_setting(name, value)
            elif name in checks.OF_THE_AGENT and "collector" in self.__dict__:
                checks.refuse_fixed(name, value)
                return self._change(name, value)
            return super().__setattr__(name, value)

    # ------------------------------------------------------------------ set-up

    def _setup_model(self) -> None:
        """Build both levels from the environment's spaces, or after loading from the saved ones."""
        self.config = self.config_class.from_dict(take_settings(self.__dict__, self.config_class))
        self.settings = self.config.to_dict()
        self.set_random_seed(self.seed)
        actions = self.action_space
        space = check_goal_space(self.observation_space, actions)
        assert isinstance(actions, spaces.Box)  # checked
        if self.env is not None:
            self._read_environment(self.env)
        if self.subgoals is None:
            raise ValueError(
                "no subgoal space: pass subgoals=SubgoalSpace(...) or an environment that has .subgoals; for one of "
                "another package, sb3_tbc.tasks.generic.DescribedGoalEnv(env) measures them"
            )
        self.config = config = self.config.for_episodes_of(self.episode_length)
        subgoals = self.subgoals
        seeds = np.random.SeedSequence(self.seed).generate_state(7).tolist()
        self.rng = np.random.default_rng(seeds[0])
        self.rules = assembly.make_rules(config, self.episode_length)
        self.views = assembly.make_views(config, subgoals, self.achieved_in_observation)
        self.high_reward = assembly.make_high_reward(config, self.rules)
        self.low_level_reward = LowLevelReward(config.low_reward, subgoals, self.rules)
        high_bounds = assembly.make_high_bounds(config, self.high_reward, self.rules, self.reward_range)
        low_bounds = assembly.make_low_bounds(config, self.low_level_reward)
        self.high = assembly.make_high_level(config, self.views, space, seeds[1], high_bounds)
        self.low = assembly.make_low_level(config, self.views, actions, seeds[2], low_bounds)
        self.reachability = assembly.make_reachability(config, subgoals, self.rules, seeds[6])
        self.schedule = assembly.make_schedule(config, self.views, self.rules, self.reachability)
        self._make_replay(seeds[3], seeds[4])
        self.policy = TBCPolicy(
            space, actions, self.high, self.low, self.views, self.rules, config.memory, seeds[5], self.schedule,
            config.reconsider_margin,
        )  # fmt: skip
        self.diagnostics = EpisodeDiagnostics()

    def _make_replay(self, high_seed: int, low_seed: int) -> None:
        """Empty replay buffers for both levels, and what fills them."""
        config = self.config
        self.replay_buffer = Replay(
            assembly.make_high_buffer(config, high_seed, self.high, self.views, self.rules, self.reachability),
            assembly.make_low_buffer(config, low_seed, self.low, self.views, self.low_level_reward),
        )
        self.high.replay_buffer, self.low.replay_buffer = self.replay_buffer  # type: ignore[assignment]
        self.store = EpisodeStore(
            self.replay_buffer, self.views, self.rules, self.high_reward, self.low_level_reward,
            assembly.hindsight_settings(config, self.rules), self.rng,
        )  # fmt: skip

    def set_random_seed(self, seed: int | None = None) -> None:
        """Restart all random streams from a seed, see SB3."""
        super().set_random_seed(seed)
        if seed is not None and "diagnostics" in self.__dict__:  # all parts are there
            resume.reseed(self._moving_parts(), seed)

    def _read_environment(self, env: VecEnv) -> None:
        """What the task itself says: subgoals and episode length."""
        checks.refuse_vec_normalize(env)
        checks.warn_of_unseen(env.observation_space)
        check_goal_test(env)
        if self.subgoals is None:
            self.subgoals = subgoals_of(env)
        check_goal_strategy(self.config.goal_strategy, self.subgoals)
        if self.subgoals is not None:
            self.subgoals.check_fits(env.observation_space)
        achieved_in_observation = attribute_of(env, "achieved_in_observation")
        self.achieved_in_observation = True if achieved_in_observation is None else bool(achieved_in_observation)
        if self.episode_length is None:
            self.episode_length = episode_length(env)
        self.reward_range = reward_range(env)

    _wrap_env = staticmethod(in_vector)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Learn in another environment from now on, see SB3; episodes that run in the present one are abandoned.

        :raises ValueError: if the environment does not fit the agent
        """
        super().set_env(in_fitting_vector(env, self), force_reset)
        self.collector, self._resumed = None, {}

    # ------------------------------------------------------------------ learning

    @property
    def actor(self) -> TwoLevelActor:
        """Both levels acting together."""
        return self.policy.actor

    def learn(
        self: SelfTBCHRL,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 10,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfTBCHRL:
        """Collect whole episodes, then update both levels in a burst, until ``total_timesteps`` steps are done.

        With ``reset_num_timesteps=False`` a call continues the last one, with its running episodes, open options and
        updates still to be done: several short calls learn what one long one does. Updates follow finished episodes
        only, so the steps of an episode that the end of a call cuts off get their updates in the next call.

        Setting :attr:`stop_requested` makes it return between two steps, never in the middle of a burst.

        :param tb_log_name: name of the run for TensorBoard; none: that of the class

        Other parameters are those of :meth:`stable_baselines3.common.base_class.BaseAlgorithm.learn`.

        :raises ValueError: without an environment, or if ``total_timesteps`` is negative
        :raises TypeError: if ``total_timesteps`` is not a whole number
        """
        self._refuse_foreign_high("learn")
        assembly.refuse_small_buffers(self.config, self.episode_length)
        warn_of_idle_settings(self.config)
        total_timesteps = checks.whole_steps(total_timesteps)
        if self.env is None:
            raise ValueError("learn needs an environment: pass env to load, or call set_env first")
        resumed, self._resumed = {} if reset_num_timesteps else self._resumed, {}
        planned = total_timesteps + (self.num_timesteps if resumed else 0)
        anew = reset_num_timesteps or self._last_obs is None  # then SB3 resets the environments
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        if reset_num_timesteps:
            self._updated_at, self._owed, self._burst_due = 0, {}, 0
        elif self._counted_to is not None:
            self._updated_at += self.num_timesteps - self._counted_to  # steps that were not done here owe no updates
        self._counted_to = self.num_timesteps
        record_settings(self, self.settings)
        collector = self._collect_from(self.env, anew, resumed)
        callback.on_training_start(locals(), globals())
        self._prepare_updates(planned, progress_bar_of(callback))
        while True:
            self._update_if_due(log_interval)
            if self.num_timesteps >= total_timesteps or self.stop_requested:
                break
            if not self.collect_rollouts(collector, callback, total_timesteps):
                break
        callback.on_training_end()
        return self

    def _collect_from(self, env: VecEnv, anew: bool, resumed: PlainMapping) -> Collector:
        """The collector that acts in the environments: that of the last call, unless they begin new episodes.

        :param anew: they were just reset
        :param resumed: what was loaded of a saved run
        """
        self.actor.notice_changes()
        if anew or self.collector is None:
            explore = assembly.exploration(self.config)
            self.collector = Collector(env, self.policy, self.rng, explore, self.config.on_bad_step)
            self.collector.begin(self._last_obs if anew else env.reset())  # type: ignore[arg-type]
        if resumed:
            resume.set_state(self._moving_parts(), resumed)
        return self.collector

    def _update_if_due(self, log_interval: int | None) -> None:
        """Update both levels if an episode was stored since the last time; environments may end several at once."""
        if not self._burst_due:
            return
        self.train()
        before, self._burst_due = self._episode_num - self._burst_due, 0
        if log_interval and before // log_interval < self._episode_num // log_interval:
            self.dump_logs()

    def _prepare_updates(self, total_timesteps: int, bar: ProgressBar | None) -> None:
        """Compile now; the progress bar says so, and the logged speed does not count it.

        :param total_timesteps: environment steps to come, and those before a resumed run was stopped
        :param bar: the progress bar, if there is one
        """
        for level, config in ((self.high, self.config.high), (self.low, self.config.low)):
            level.set_logger(self.logger)
            name = level.log_prefix[:-1]
            few = self.config.updates_per_step(config) * total_timesteps < MIN_UPDATES_TO_COMPILE
            compile = False if self.config.compile == "auto" and few else self.config.compile
            with described(bar, f"compiling the {name} level's update" if compile else ""):
                seconds = level.prepare(config.batch_size, compile)
            if self.verbose and level.compiled:
                print(f"{name} level: update compiled in {seconds:.0f} s")
        self.start_time = time.time_ns()

    def collect_rollouts(self, collector: Collector, callback: BaseCallback, total_timesteps: int) -> bool:
        """Act until an episode is over (or the steps are used up) and store it; False if a callback asks to stop."""
        callback.on_rollout_start()
        while not self._burst_due and self.num_timesteps < total_timesteps and not self.stop_requested:
            step = collector.step()
            self._last_obs = step.task_observations  # type: ignore[assignment]
            self.num_timesteps += self.n_envs
            self._counted_to = self.num_timesteps
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._update_info_buffer(step.infos, step.episode_over)
            self._store(step.episodes.values(), collector.env.judge.goal_test)
            callback.update_locals(self._as_sb3_names(step))
            if not callback.on_step():
                return False
        callback.on_rollout_end()
        return True

    def _store(self, episodes: Iterable[Episode], goal_test: GoalTest) -> None:
        """Put finished episodes into the replay buffers; updates follow."""
        progress = 1.0 - self._current_progress_remaining
        for episode in episodes:
            self._episode_num += 1
            self._burst_due += 1
            self.diagnostics.add(episode, self.store.add(episode, goal_test, progress))

    def _as_sb3_names(self, step: HierarchicalStep) -> Plain:
        """What SB3's algorithms show their callbacks of a step: the task's side of it, episodes and not windows."""
        return {
            "self": self, "env": self.env, "replay_buffer": self.replay_buffer, "actions": step.actions,
            "new_obs": step.task_observations, "rewards": step.task_rewards, "dones": step.episode_over,
            "infos": step.infos, "episodes": step.episodes,
        }  # fmt: skip

    def train(self) -> None:
        """Do the updates of both levels that ``gradient_ratio`` gives for the steps since the last call.

        Fractions of an update, and updates that wait until a buffer holds a batch, are kept for later.
        """
        steps = max(self.num_timesteps - max(self._updated_at, self.config.learning_starts), 0)
        self._updated_at = self.num_timesteps
        levels = zip((self.high, self.low), self.replay_buffer, (self.config.high, self.config.low), strict=True)
        for level, buffer, config in levels:
            updates = self._owed_updates(level.log_prefix, self.config.updates_per_step(config) * steps)
            if updates and buffer.size() >= config.batch_size:
                self._owed[level.log_prefix] -= updates
                level._current_progress_remaining = self._current_progress_remaining
                level.train(updates, config.batch_size)
        self._n_updates = self.low._n_updates
        if self.reachability is not None:
            updates = self._owed_updates("reachability", steps / UPDATE_EVERY)
            if updates and self.replay_buffer.low.size():
                self._owed["reachability"] -= updates
                loss = self.reachability.train_on(self.replay_buffer.low, updates)
                self.logger.record("reachability/loss", loss)

    def _owed_updates(self, name: str, more: float) -> int:
        """Number of whole updates to do now.

        :param more: updates for the steps since the last call
        """
        self._owed[name] = self._owed.get(name, 0.0) + more
        return int(self._owed[name])

    def dump_logs(self) -> None:
        """Write what was seen since the last time: SB3's keys, and per level what explains learning."""
        record_progress(self)
        if self.collector is not None and self.collector.env.guard.count:
            self.logger.record("rollout/bad_steps", self.collector.env.guard.count)
        for name, value in self.diagnostics.drain().items():
            self.logger.record(name, value)
        self.logger.dump(step=self.num_timesteps)

    # ------------------------------------------------------------------ saving

    @classmethod
    def from_levels(cls, high: BaseAlgorithm, low: TBCHRL) -> TBCHRL:
        """An agent whose high level is another algorithm's policy, for ``predict``, evaluation and export.

        It shares the low level with ``low`` and can be neither trained nor saved: save the two parts instead, and call
        this again after loading them.

        :param high: trained in an :class:`~sb3_tbc.tbc_hrl.option_env.OptionEnv` with ``low``
        :param low: the agent that executes the options
        :raises ValueError: if the two do not fit
        """
        return put_together(high, low)
