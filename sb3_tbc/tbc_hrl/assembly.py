"""The parts of an agent, made from its settings: rules, views, rewards, levels, schedules and replay buffers."""

from __future__ import annotations

import logging
import math

import numpy as np
from gymnasium import spaces

from sb3_tbc.aliases import Plain
from sb3_tbc.level.level import SACLevel
from sb3_tbc.replay.buffers import OptionReplayBuffer, SubgoalReplayBuffer
from sb3_tbc.settings import SettingError
from sb3_tbc.smdp.bounds import RewardRange, ValueBounds, high_level_bounds, low_level_bounds
from sb3_tbc.smdp.hindsight import HindsightSettings
from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.smdp.views import LevelViews
from sb3_tbc.tbc_hrl.collection import Exploration
from sb3_tbc.tbc_hrl.config import TBCConfig
from sb3_tbc.tbc_hrl.level_config import LevelConfig, learning_rate_of
from sb3_tbc.tbc_hrl.reachability import Reachability
from sb3_tbc.tbc_hrl.scheduling import DurationTeacher, FixedWindows, ReachRule

logger = logging.getLogger(__name__)


# ------------------------------------------------------------------------------- the semi-Markov process


def make_rules(config: TBCConfig, episode_length: int | None) -> OptionRules:
    """What ends a window.

    :param episode_length: time limit of the task, environment steps; None where it has none
    :raises ValueError: if ``dt_max`` is to be derived from an episode's length that is not known
    """
    dt_max, max_options = config.dt_max, int(config.max_options)
    if dt_max == -1:
        if episode_length is None:
            raise ValueError("dt_max=-1 needs an environment with max_episode_steps; pass dt_max in steps")
        dt_max = max(episode_length / max_options, 1.0)  # shorter episodes need fewer decisions than allowed
    return OptionRules(dt_max, config.dt_min, max_options, config.window_end, config.whole_budgets)


def make_views(config: TBCConfig, subgoals: SubgoalSpace, achieved_in_observation: bool) -> LevelViews:
    """What each level sees and chooses."""
    chooses_time = config.duration == "joint"
    return LevelViews(subgoals, achieved_in_observation, config.relative_subgoals, config.remaining_time, chooses_time)


def make_high_reward(config: TBCConfig, rules: OptionRules) -> HighLevelReward:
    """What the high level is rewarded for; time budgets that are all the same cost nothing."""
    return HighLevelReward(
        target=config.target,
        gamma=config.high.gamma,
        dt_ref=rules.dt_ref,
        dt_max=rules.dt_max,
        decision_cost=config.decision_cost,
        duration_cost=0.0 if config.duration == "fixed" else config.duration_cost,
        completion_bonus=config.completion_bonus,
    )


def fixed_budget(config: TBCConfig, rules: OptionRules) -> float:
    """The time budget of ``duration: fixed``."""
    return rules.dt_max if config.fixed_duration is None else config.fixed_duration


def cut_lengths(config: TBCConfig, rules: OptionRules) -> tuple[int, int]:
    """Fewest and most steps of a window that an episode is cut into anew: as of one that the high level may choose."""
    if config.duration == "fixed":
        return (steps := rules.lasts(fixed_budget(config, rules))), steps
    return rules.lasts(rules.dt_min), rules.lasts(rules.dt_max)


def hindsight_settings(config: TBCConfig, rules: OptionRules) -> HindsightSettings:
    """How episodes are rewritten for the high level."""
    return HindsightSettings(
        n_goals=config.n_hindsight_goals,
        goal_strategy=config.goal_strategy,
        testing_penalty=config.failed_test_reward,
        keep_original=config.keep_original,
        tolerance=config.relabel_tolerance,
        goals_met=config.goals_met,
        n_cuts=config.n_hindsight_cuts,
        cut_lengths=cut_lengths(config, rules),
        cuts_fraction=config.hindsight_cuts_fraction,
    )


def exploration(config: TBCConfig) -> Exploration:
    """How both levels act while they learn."""
    return Exploration(config.random_fraction, config.testing_fraction, config.deterministic_testing)


# -------------------------------------------------------------------------------------------- time budgets


def make_reachability(config: TBCConfig, subgoals: SubgoalSpace, rules: OptionRules, seed: int) -> Reachability | None:
    """The estimate of steps to a subgoal, where the rule of equation 1 is used or taught; else None."""
    if config.duration != "rule" and not config.duration_loss_coef:
        return None
    horizon = math.ceil(rules.dt_max / max(config.kappa, 0.1))  # what is further away is clipped anyway
    return Reachability(subgoals, rules.dt_ref, horizon, seed=seed)


def make_schedule(
    config: TBCConfig, views: LevelViews, rules: OptionRules, reachability: Reachability | None
) -> FixedWindows | ReachRule | None:
    """Who sets time budgets (paper, section 4.1); None where the high level does."""
    if config.duration == "fixed":
        return FixedWindows(rules, fixed_budget(config, rules))
    if config.duration == "rule" and reachability is not None:
        return ReachRule(views, rules, reachability, config.kappa)
    return None


# -------------------------------------------------------------------------------------------------- levels


def make_high_bounds(
    config: TBCConfig, reward: HighLevelReward, rules: OptionRules, rewards: RewardRange | None
) -> ValueBounds | None:
    """What the high level's targets are clipped to; None: they are not clipped.

    :param rewards: of an environment step; None where they are not known, which leaves targets free
    """
    if config.high.target_bounds != "auto":
        return _given_bounds(config.high)
    if rewards is None:
        logger.warning(
            "the environment does not say its reward_range, so the high level's targets are not bounded; give the "
            "environment an attribute reward_range = (low, high), or set high.target_bounds to [low, high]"
        )
        return None
    tested = config.testing_fraction > 0
    known = RewardRange(*rewards)  # a plain list in agents that were loaded
    return high_level_bounds(reward, rules, known, config.failed_test_reward if tested else None)


def make_low_bounds(config: TBCConfig, reward: LowLevelReward) -> ValueBounds | None:
    """What the low level's targets are clipped to; None: they are not clipped."""
    if config.low.target_bounds != "auto":
        return _given_bounds(config.low)
    return low_level_bounds(reward, config.low.gamma)


def _given_bounds(level: LevelConfig) -> ValueBounds | None:
    return None if isinstance(level.target_bounds, str) else ValueBounds(*level.target_bounds)


def make_high_level(
    config: TBCConfig, views: LevelViews, observations: spaces.Dict, seed: int, bounds: ValueBounds | None
) -> SACLevel:
    """The level that chooses subgoals and time budgets.

    :param observations: the task's
    """
    policy_kwargs = config.high.policy_kwargs.to_kwargs()
    if policy_kwargs["negative_critic"] is None:
        policy_kwargs["negative_critic"] = not config.bonus_beyond_cost
    seen, chosen = views.high_space(observations), views.high_action_space()
    return _make_level("high", config, config.high, seen, chosen, policy_kwargs, seed, bounds)


def make_low_level(
    config: TBCConfig, views: LevelViews, actions: spaces.Box, seed: int, bounds: ValueBounds | None
) -> SACLevel:
    """The level that executes subgoals; its actor is the circuit unless its ``policy_kwargs["ndbc"]`` is None.

    :param actions: the task's
    """
    policy_kwargs = config.low.policy_kwargs.to_kwargs()
    circuit = policy_kwargs["ndbc"]
    if circuit is not None:
        if circuit["motor"] is None:
            circuit["motor"] = actions.shape[0]
        if circuit["input_scale"] is None:
            circuit["input_scale"] = views.low_scale().tolist()
    if policy_kwargs["gru"] is not None:
        policy_kwargs["gru"] = {"hidden_size": policy_kwargs["gru"], "input_scale": views.low_scale().tolist()}
    if policy_kwargs["negative_critic"] is None:
        policy_kwargs["negative_critic"] = config.low_reward == "step"
    unit_actions = spaces.Box(-1.0, 1.0, actions.shape, np.float32)
    return _make_level("low", config, config.low, views.low_space(), unit_actions, policy_kwargs, seed, bounds)


def _make_level(
    name: str,
    config: TBCConfig,
    level: LevelConfig,
    observations: spaces.Box,
    actions: spaces.Box,
    policy_kwargs: Plain,
    seed: int,
    bounds: ValueBounds | None,
) -> SACLevel:
    actor_rate = level.actor_learning_rate
    return SACLevel(
        observations,
        actions,
        learning_rate=learning_rate_of(level.learning_rate),
        actor_learning_rate=None if actor_rate is None else learning_rate_of(actor_rate),
        ent_coef_learning_rate=level.ent_coef_learning_rate,
        gamma=level.gamma,
        tau=level.tau,
        ent_coef=level.ent_coef,
        target_entropy=level.target_entropy,
        policy_kwargs={**policy_kwargs, "critic_norm": level.critic_norm},
        seed=seed,
        compile=config.compile,
        name=name,
        label_coef=config.duration_loss_coef if name == "high" else 0.0,
        earlier_steps=config.sequence_length - 1 if name == "low" else 0,
        average_decay=level.average_decay,
        bounds=bounds,
        actor_q=level.actor_q,
    )


# -------------------------------------------------------------------------------------------------- replay


def refuse_small_buffers(config: TBCConfig, episode_length: int | None) -> None:
    """Refuse, before any step, buffers that do not hold what one episode may give: learning would end at that episode.

    :param episode_length: time limit of the task, environment steps; None where it has none
    :raises SettingError: naming the level and the smallest size
    """
    # of each option: a failed test, the copy in hindsight, the original, and one for each hindsight goal. Of what cuts
    # add, a buffer takes as much as it holds
    copies = 2 + config.keep_original + config.n_hindsight_goals
    rows = {"high": int(config.max_options) * copies, "low": episode_length or 0}
    for name, size in (("high", config.high.buffer_size), ("low", config.low.buffer_size)):
        if size < rows[name]:
            raise SettingError(
                f"{name}.buffer_size",
                f"of {size} does not hold an episode, which may give the {name} level {rows[name]} transitions here: "
                "raise it to that at least",
            )


def make_high_buffer(
    config: TBCConfig,
    seed: int,
    high: SACLevel,
    views: LevelViews,
    rules: OptionRules,
    reachability: Reachability | None,
) -> OptionReplayBuffer:
    """Replay of options, with time budgets to learn from where the reachability estimate teaches them."""
    teacher = None
    if reachability is not None and config.duration_loss_coef > 0:
        teacher = DurationTeacher(ReachRule(views, rules, reachability, config.kappa), high.acting)
    return OptionReplayBuffer(
        config.high.buffer_size,
        high.observation_space,
        high.action_space,
        seed=seed,
        context=None if teacher is None else views.subgoals,
        teacher=teacher,
    )


def make_low_buffer(
    config: TBCConfig, seed: int, low: SACLevel, views: LevelViews, reward: LowLevelReward
) -> SubgoalReplayBuffer:
    """Replay of the low level's steps, which draws their hindsight subgoals."""
    own = config.low
    strategy = own.goal_strategy or config.goal_strategy
    if strategy == "event":  # it ends windows, and says nothing about the points within one
        strategy = "future"
    return SubgoalReplayBuffer(
        own.buffer_size,
        low.observation_space,
        low.action_space,
        views=views,
        rules=reward.rules,
        state_dim=low.state_dim,
        gamma=own.gamma,
        n_hindsight_goals=config.n_hindsight_goals if own.n_hindsight_goals is None else own.n_hindsight_goals,
        seed=seed,
        reward=reward,
        hindsight=strategy if config.low_reward == "step" else "timed",
        sequence_length=config.sequence_length,
        reach_pairs=config.duration == "rule" or config.duration_loss_coef > 0,
    )
