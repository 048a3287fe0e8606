"""TBC-HRL: a high level that emits a subgoal and a time budget, a low level that executes it inside that window."""

from __future__ import annotations

import io
import math
import pathlib
import time
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tbc.replay.both_levels import Replay
from sb3_tbc.smdp.goal_spaces import check_goal_space, width
from sb3_tbc.smdp.hindsight import GoalRange, check_goal_strategy
from sb3_tbc.smdp.options import Episode, OptionRules
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.smdp.views import LevelLayout
from sb3_tbc.tbc_hrl import assembly, resume
from sb3_tbc.tbc_hrl.actor import TwoLevelActor
from sb3_tbc.tbc_hrl.collection import Collector, EpisodeStore, Exploration, goal_test_of
from sb3_tbc.tbc_hrl.config import LEVEL_DEFAULTS, attribute_of, check_settings, episode_length, level_settings
from sb3_tbc.tbc_hrl.diagnostics import EpisodeDiagnostics, described, progress_bar_of
from sb3_tbc.tbc_hrl.policy import TBCPolicy
from sb3_tbc.tbc_hrl.reachability import UPDATE_EVERY, Reachability
from sb3_tbc.tbc_hrl.scheduling import FixedWindows, ReachRule

SelfTBCHRL = TypeVar("SelfTBCHRL", bound="TBCHRL")


MIN_UPDATES_TO_COMPILE = 3000
"""With ``compile="auto"`` fewer updates than this run eagerly: compiling costs about as much as they do."""


class TBCHRL(BaseAlgorithm):
    """Timed and bionic circuit hierarchical reinforcement learning (Li, Shan, Mo 2025), two SAC levels.

    :param policy: ``"MultiInputPolicy"``
    :param env: a goal environment or its id; its ``subgoals`` attribute says what the high level may ask for
    :param high: settings of the high level under SB3's names (``learning_rate, batch_size, gamma, tau, ent_coef,
        target_entropy, buffer_size, policy_kwargs``; also ``actor_learning_rate`` and ``ent_coef_learning_rate`` where
        they differ, ``gradient_ratio`` where it is not the agent's, and ``average_decay`` of the averaged actor);
        ``gamma`` is per decision
    :param low: settings of the low level, likewise; ``policy_kwargs["ndbc"]`` holds the circuit's wiring, None for an
        MLP actor; ``n_hindsight_goals`` and ``goal_strategy`` may differ from the high level's; ``near_misses`` is the
        share of hindsight subgoals moved off the point reached, see :class:`.SubgoalReplayBuffer`
    :param max_options: high-level decisions allowed per episode
    :param window_end: ``"timed"`` or ``"reached"``, see :class:`~sb3_tbc.smdp.options.OptionRules`
    :param dt_min: shortest time budget, environment steps
    :param dt_max: longest, or -1 for the episode's length divided by ``max_options``
    :param duration: who sets the time budget: ``"joint"`` (the high level, with the subgoal), ``"rule"`` (equation 1:
        ``clip(kappa * H_reach, dt_min, dt_max)``) or ``"fixed"`` (always ``fixed_duration``)
    :param fixed_duration: constant window, environment steps; None for ``dt_max``
    :param kappa: scales the estimated steps to a subgoal into a time budget (table A2)
    :param duration_loss_coef: weight of the loss that draws the high level's time budget toward the rule's, in unit
        action coordinates; 0 leaves it out
    :param remaining_time: whether the low level sees how much of its time budget is left
    :param target: ``"smdp"`` (paper) or ``"decision"`` (HiTS), see :class:`~sb3_tbc.smdp.hindsight.HighLevelReward`
    :param decision_cost: price of one decision
    :param duration_cost: price of the longest time budget
    :param completion_bonus: added to the reward of options that reach their subgoal, in hindsight too
    :param low_reward: ``"sparse"``, ``"dense"`` or ``"step"``, see :class:`~sb3_tbc.smdp.rewards.LowLevelReward`
    :param testing_fraction: share of options that test their subgoal
    :param deterministic_testing: whether the low level acts deterministically in a test (the public HiTS does not)
    :param testing_penalty: reward of a failed test, None for ``-max_options``
    :param keep_original: also learn from failed options as they were chosen (paper, algorithm 1)
    :param relabel_tolerance: largest distance, in unit coordinates, between where a failed option ended and the subgoal
        it is relabelled with (the paper's success test: 0.05); None relabels them all
    :param random_fraction: share of uniformly random actions on each level while exploring
    :param n_hindsight_goals: hindsight goals per transition
    :param goal_strategy: where the high level's hindsight goals come from: ``"future"`` or ``"episode"``, later or any
        options of the episode, or ``"event"``, the option that the task's event ended
    :param goals_met: when a window meets a hindsight goal: ``"passing"`` it, as the episode would have ended, or at its
        ``"end"`` alone, which HiTS's target always does
    :param hindsight_goals: ``"all"``, or those ``"asked"``: within the box of the goals that episodes have asked for
    :param gradient_ratio: updates of each level per environment step, done in bursts after episodes
    :param learning_starts: environment steps before the first update
    :param memory: when the membrane is reset: ``"window"``, ``"episode"`` or ``"none"`` (every step)
    :param sequence_length: steps through which the low level's update recomputes its memory; 1 uses the stored one
    :param relative_subgoals: show the low level the distance to its subgoal instead of the subgoal itself
    :param subgoals: the subgoal space, for environments that do not bring one
    :param compile: compile the updates: ``"auto"`` (where a C++ compiler is found and it pays), True or False
    :raises ValueError: on unknown settings or an environment without goals
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": TBCPolicy}
    policy: TBCPolicy
    default_window_end: ClassVar[str] = "timed"
    default_target: ClassVar[str] = "smdp"
    default_circuit: ClassVar[bool] = True
    default_duration: ClassVar[str] = "joint"
    default_low_reward: ClassVar[str] = "sparse"
    default_remaining_time: ClassVar[bool] = True

    def __init__(
        self,
        policy: str | type[TBCPolicy],
        env: GymEnv | str | None,
        *,
        high: Mapping[str, Any] | None = None,
        low: Mapping[str, Any] | None = None,
        max_options: int = 20,
        window_end: str | None = None,
        dt_min: float = 0.0,
        dt_max: float = -1.0,
        duration: str | None = None,
        fixed_duration: float | None = None,
        kappa: float = 1.0,
        duration_loss_coef: float = 0.0,
        remaining_time: bool | None = None,
        target: str | None = None,
        decision_cost: float = 1.0,
        duration_cost: float = 2.0,
        completion_bonus: float = 0.0,
        low_reward: str | None = None,
        testing_fraction: float = 0.3,
        deterministic_testing: bool = False,
        testing_penalty: float | None = None,
        keep_original: bool = False,
        relabel_tolerance: float | None = None,
        random_fraction: float = 0.05,
        n_hindsight_goals: float = 3,
        goal_strategy: str = "future",
        goals_met: str = "passing",
        hindsight_goals: str = "all",
        gradient_ratio: float = 1.0,
        learning_starts: int = 0,
        memory: str = "none",
        sequence_length: int = 1,
        relative_subgoals: bool = False,
        subgoals: SubgoalSpace | None = None,
        compile: bool | str = "auto",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: th.device | str = "cpu",
        seed: int | None = None,
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=0.0,  # each level has its own
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
        )
        self.high_settings = level_settings("high", high)
        self.low_settings = level_settings("low", low, extra=("n_hindsight_goals", "goal_strategy", "near_misses"))
        self.max_options, self.dt_min, self.dt_max = max_options, dt_min, dt_max
        self.window_end = window_end or self.default_window_end
        self.duration, self.fixed_duration = duration or self.default_duration, fixed_duration
        self.kappa, self.duration_loss_coef = kappa, duration_loss_coef
        self.remaining_time = self.default_remaining_time if remaining_time is None else remaining_time
        self.target = target or self.default_target
        self.low_reward = low_reward or self.default_low_reward
        self.decision_cost, self.duration_cost = decision_cost, duration_cost
        self.completion_bonus = completion_bonus
        self.testing_fraction, self.deterministic_testing = testing_fraction, deterministic_testing
        self.testing_penalty, self.keep_original = testing_penalty, keep_original
        self.relabel_tolerance = relabel_tolerance
        self.random_fraction, self.n_hindsight_goals = random_fraction, n_hindsight_goals
        self.goal_strategy, self.goals_met, self.hindsight_goals = goal_strategy, goals_met, hindsight_goals
        self.gradient_ratio, self.learning_starts = gradient_ratio, learning_starts
        self.memory, self.sequence_length, self.compile = memory, sequence_length, compile
        self.subgoals, self.relative_subgoals = subgoals, relative_subgoals
        self._n_updates = 0
        self._updated_at = 0
        self.collector: Collector | None = None
        self._resumed: dict[str, Any] = {}
        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ set-up

    def _setup_model(self) -> None:
        """Build both levels from the environment's spaces, or after loading from the saved ones."""
        check_settings(vars(self))
        self.set_random_seed(self.seed)
        space, actions = check_goal_space(self.observation_space), self.action_space
        if not isinstance(actions, spaces.Box) or len(actions.shape) != 1:
            raise ValueError(f"{type(self).__name__} needs a Box action space with one dimension, got {actions}")
        if self.env is not None:
            self._read_environment(self.env)
        if self.subgoals is None:
            raise ValueError("no subgoal space: pass subgoals=SubgoalSpace(...), or an environment that has .subgoals")
        self._set_rules(self.subgoals)
        seeds = np.random.SeedSequence(self.seed).generate_state(7).tolist()
        self.rng = np.random.default_rng(seeds[0])
        high_spaces = self.layout.high_space(space), self.layout.high_action_space()
        low_spaces = self.layout.low_space(), spaces.Box(-1.0, 1.0, actions.shape, np.float32)
        # agents that were saved before a setting existed
        self.high_settings, self.low_settings = (
            {**LEVEL_DEFAULTS, **s} for s in (self.high_settings, self.low_settings)
        )
        self.high = assembly.make_high_level(self, *high_spaces, seed=seeds[1])
        self.low = assembly.make_low_level(self, *low_spaces, seed=seeds[2])
        self._set_schedule(self.subgoals, seeds[6])
        self.replay_buffer = Replay(
            assembly.make_high_buffer(self, *high_spaces, seeds[3]),
            assembly.make_low_buffer(self, *low_spaces, seeds[4]),
        )
        self.high.attach(self.replay_buffer.high)
        self.low.attach(self.replay_buffer.low)
        self.policy = TBCPolicy(
            space, actions, self.high, self.low, self.layout, self.rules, self.memory, seeds[5], self.schedule
        )
        self.store = EpisodeStore(
            self.replay_buffer, self.layout, self.rules, self.high_reward, self.low_level_reward,
            assembly.hindsight_settings(self), self.rng,
            GoalRange(width(space, "desired_goal")) if self.hindsight_goals == "asked" else None,
        )  # fmt: skip
        self.diagnostics = EpisodeDiagnostics()

    def _set_rules(self, subgoals: SubgoalSpace) -> None:
        """What ends a window, what each level sees, what each is rewarded for."""
        self.rules = OptionRules(self.dt_max, self.dt_min, self.max_options, self.window_end)
        chooses_time = self.duration == "joint"
        self.layout = LevelLayout(
            subgoals, self.achieved_in_observation, self.relative_subgoals, self.remaining_time, chooses_time
        )
        self.high_reward = HighLevelReward(
            self.target, self.high_settings["gamma"], self.rules.dt_ref, self.rules.dt_max, self.decision_cost,
            0.0 if self.duration == "fixed" else self.duration_cost, self.completion_bonus,
        )  # fmt: skip
        self.low_level_reward = LowLevelReward(self.low_reward, subgoals, self.rules)

    def _set_schedule(self, subgoals: SubgoalSpace, seed: int) -> None:
        """Who sets time budgets (paper, section 4.1), and the reachability estimate where it is needed."""
        self.reachability: Reachability | None = None
        self.schedule: FixedWindows | ReachRule | None = None
        if self.duration == "fixed":
            steps = self.rules.dt_max if self.fixed_duration is None else self.fixed_duration
            self.schedule = FixedWindows(self.rules, steps)
        elif self.duration == "rule" or self.duration_loss_coef:
            horizon = math.ceil(self.rules.dt_max / max(self.kappa, 0.1))  # what is further away is clipped anyway
            self.reachability = Reachability(subgoals, self.rules.dt_ref, horizon, seed=seed)
            self.rule = ReachRule(self.layout, self.rules, self.reachability, self.kappa)
            self.schedule = self.rule if self.duration == "rule" else None

    def _read_environment(self, env: VecEnv) -> None:
        """What the task itself says: subgoals and episode length."""
        if unwrap_vec_normalize(env) is not None:
            raise ValueError(
                "VecNormalize moves the subgoal space while the agent learns; use the task's fixed scales instead"
            )
        if self.subgoals is None:
            self.subgoals = attribute_of(env, "subgoals")
        check_goal_strategy(self.goal_strategy, self.subgoals)
        achieved_in_observation = attribute_of(env, "achieved_in_observation")
        self.achieved_in_observation = True if achieved_in_observation is None else bool(achieved_in_observation)
        if self.dt_max == -1:
            self.dt_max = episode_length(env) / self.max_options

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
        tb_log_name: str = "TBCHRL",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfTBCHRL:
        """Collect whole episodes, then update both levels in a burst, until ``total_timesteps`` steps are done."""
        resumed, self._resumed = {} if reset_num_timesteps else self._resumed, {}
        planned = total_timesteps + (self.num_timesteps if resumed else 0)
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if self.env is None:
            raise ValueError("learn needs an environment: call set_env first")
        if reset_num_timesteps:
            self._updated_at = 0
        for level in (self.high, self.low):
            level.set_logger(self.logger)
        explore = Exploration(self.random_fraction, self.testing_fraction, self.deterministic_testing)
        self.collector = collector = Collector(
            self.env, self.actor, self.layout, self.rules, self.rng, self.schedule, explore
        )
        collector.reset()
        if resumed:
            resume.set_state(self, collector, resumed)
        callback.on_training_start(locals(), globals())
        self._prepare_updates(planned, progress_bar_of(callback))
        while self.num_timesteps < total_timesteps:
            if not self.collect_rollouts(collector, callback, total_timesteps):
                break
            self.train()
            if log_interval and self._episode_num % log_interval == 0:
                self.dump_logs()
        callback.on_training_end()
        return self

    def _prepare_updates(self, total_timesteps: int, bar: Any | None) -> None:
        """Compile now; the progress bar says so, and the logged speed does not count it.

        :param total_timesteps: environment steps to come, and those before a resumed run was stopped
        :param bar: the progress bar, if there is one
        """
        for level, settings in ((self.high, self.high_settings), (self.low, self.low_settings)):
            name, few = level.log_prefix[:-1], self._updates_of(settings, total_timesteps) < MIN_UPDATES_TO_COMPILE
            compile = False if self.compile == "auto" and few else self.compile
            with described(bar, f"compiling the {name} level's update" if compile else ""):
                seconds = level.prepare(settings["batch_size"], compile)
            if self.verbose and level.compiled:
                print(f"{name} level: update compiled in {seconds:.0f} s")
        self.start_time = time.time_ns()

    def collect_rollouts(self, collector: Collector, callback: BaseCallback, total_timesteps: int) -> bool:
        """Act until an episode is over (or the steps are used up) and store it; False if a callback asks to stop."""
        callback.on_rollout_start()
        episodes: dict[int, Episode] = {}
        while not episodes and self.num_timesteps < total_timesteps:
            step = collector.step()
            episodes, infos = step.episodes, step.infos
            self.num_timesteps += self.n_envs
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._update_info_buffer(infos, step.episode_over)
            callback.update_locals(locals())
            if not callback.on_step():
                return False
        for episode in episodes.values():
            self._episode_num += 1
            self.diagnostics.add(episode, self.store.add(episode, goal_test_of(collector.env.venv)))
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """Update both levels as often as ``gradient_ratio`` and the steps since the last time say."""
        steps = self.num_timesteps - self._updated_at
        self._updated_at = self.num_timesteps
        if self.num_timesteps <= self.learning_starts:
            return
        levels = zip((self.high, self.low), self.replay_buffer, (self.high_settings, self.low_settings), strict=True)
        for level, buffer, settings in levels:
            updates = self._updates_of(settings, steps)
            if updates and buffer.size() >= settings["batch_size"]:
                level._current_progress_remaining = self._current_progress_remaining
                level.train(updates, settings["batch_size"])
        self._n_updates = self.low._n_updates
        if self.reachability is not None:
            loss = self.reachability.train_on(self.replay_buffer.low, max(steps // UPDATE_EVERY, 1))
            self.logger.record("reachability/loss", loss)

    def _updates_of(self, settings: Mapping[str, Any], steps: int) -> int:
        """How often a level with these settings is updated for so many environment steps."""
        ratio = self.gradient_ratio if settings["gradient_ratio"] is None else settings["gradient_ratio"]
        return int(ratio * steps)

    def dump_logs(self) -> None:
        """Write what was seen since the last time: SB3's keys, and per level what explains learning."""
        elapsed = max((time.time_ns() - self.start_time) / 1e9, 1e-9)
        self.logger.record("time/episodes", self._episode_num, exclude="tensorboard")
        self.logger.record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / elapsed))
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        if self.ep_info_buffer:
            self.logger.record("rollout/ep_rew_mean", safe_mean([info["r"] for info in self.ep_info_buffer]))
            self.logger.record("rollout/ep_len_mean", safe_mean([info["l"] for info in self.ep_info_buffer]))
        if self.ep_success_buffer:
            self.logger.record("rollout/success_rate", safe_mean(self.ep_success_buffer))
        for name, value in self.diagnostics.drain().items():
            self.logger.record(name, value)
        self.logger.record("train/n_updates", self._n_updates)
        self.logger.dump(step=self.num_timesteps)

    # ------------------------------------------------------------------ saving

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            "high", "low", "rng", "layout", "rules", "high_reward", "low_level_reward", "store", "diagnostics",
            "replay_buffer", "schedule", "rule", "reachability", "collector", "_resumed",
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

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """Load parameters of both levels in place, see SB3."""
        super().set_parameters(*args, **kwargs)
        for level in (self.high, self.low):
            level.refresh()

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Write both levels' replay buffers, and all else that learning goes on from, to one file of plain arrays.

        A model saved at the same moment (between two rollouts), loaded together with this file, goes on learning with
        ``learn(..., reset_num_timesteps=False)`` as if it had never stopped, bit for bit.
        """
        self.replay_buffer.save(path, resume.get_state(self))

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Read what :meth:`save_replay_buffer` wrote; only plain arrays are read, never pickled objects.

        :param truncate_last_traj: for SB3's sake; unfinished episodes are never in the buffers
        :raises ValueError: if the file was written for other spaces or sizes
        """
        self._resumed = self.replay_buffer.load(path)
