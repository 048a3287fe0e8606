"""The parts of an agent, made from its settings: the two levels, their replay buffers, what hindsight does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gymnasium import spaces

from sb3_tbc.level.level import SACLevel
from sb3_tbc.level.policies import LevelPolicy
from sb3_tbc.replay.buffers import OptionReplayBuffer, SubgoalReplayBuffer
from sb3_tbc.smdp.hindsight import HindsightSettings
from sb3_tbc.tbc_hrl.config import DEFAULT_WIRING, learning_rate_of
from sb3_tbc.tbc_hrl.scheduling import DurationTeacher

if TYPE_CHECKING:
    from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL


def make_high_level(model: TBCHRL, observation: spaces.Box, action: spaces.Box, seed: int) -> SACLevel:
    """The level that chooses subgoals and time budgets.

    :param observation: what it sees, :meth:`~sb3_tbc.smdp.views.LevelViews.high_space`
    :param action: what it chooses, :meth:`~sb3_tbc.smdp.views.LevelViews.high_action_space`
    """
    settings = model.high_settings
    return _make_level(
        model, "high", settings, observation, action, settings["policy_kwargs"], seed, model.duration_loss_coef
    )


def make_low_level(model: TBCHRL, observation: spaces.Box, action: spaces.Box, seed: int) -> SACLevel:
    """The level that executes subgoals; its actor is the circuit unless its ``policy_kwargs["ndbc"]`` is None."""
    policy_kwargs = dict(model.low_settings["policy_kwargs"])
    default = {**DEFAULT_WIRING, "motor": action.shape[0]} if model.default_circuit else None
    circuit = policy_kwargs.get("ndbc", default)
    scale = {"input_scale": model.layout.low_scale().tolist()}
    policy_kwargs["ndbc"] = None if circuit is None else {**scale, **circuit}
    policy_kwargs.setdefault("negative_critic", model.low_reward == "step")
    return _make_level(model, "low", model.low_settings, observation, action, policy_kwargs, seed)


def _make_level(
    model: TBCHRL,
    name: str,
    settings: Mapping[str, Any],
    observation: spaces.Box,
    action: spaces.Box,
    policy_kwargs: Mapping[str, Any],
    seed: int,
    label_coef: float = 0.0,
) -> SACLevel:
    gamma, actor_rate = settings["gamma"], settings["actor_learning_rate"]
    return SACLevel(
        LevelPolicy, observation, action, None, learning_rate_of(settings["learning_rate"]), gamma, settings["tau"],
        settings["ent_coef"], settings["target_entropy"], dict(policy_kwargs), seed=seed, device=model.device,
        compile=model.compile, ent_coef_learning_rate=settings["ent_coef_learning_rate"],
        actor_learning_rate=None if actor_rate is None else learning_rate_of(actor_rate), name=name,
        label_coef=label_coef, average_decay=settings["average_decay"],
    )  # fmt: skip


def make_high_buffer(model: TBCHRL, observation: spaces.Box, action: spaces.Box, seed: int) -> OptionReplayBuffer:
    """Replay of options, with time budgets to learn from where the reachability estimate teaches them."""
    taught = model.subgoals if model.duration_loss_coef else None
    buffer = OptionReplayBuffer(
        model.high_settings["buffer_size"], observation, action, device=model.device, seed=seed, context=taught
    )
    if model.duration_loss_coef:
        buffer.teacher = DurationTeacher(model.rule, model.high)
    return buffer


def make_low_buffer(model: TBCHRL, observation: spaces.Box, action: spaces.Box, seed: int) -> SubgoalReplayBuffer:
    """Replay of the low level's steps, which draws their hindsight subgoals."""
    settings, untimed = model.low_settings, model.low_reward == "step"
    buffer = SubgoalReplayBuffer(
        settings["buffer_size"], observation, action, layout=model.layout, rules=model.rules,
        state_dim=model.low.state_dim, gamma=settings["gamma"],
        n_hindsight_goals=settings.get("n_hindsight_goals", model.n_hindsight_goals),
        near_misses=settings.get("near_misses", 0.0),
        device=model.device, seed=seed, reward=model.low_level_reward,
        hindsight=settings.get("goal_strategy", model.goal_strategy) if untimed else "timed",
        sequence_length=model.sequence_length, reach_pairs=model.reachability is not None,
    )  # fmt: skip
    buffer.advance = model.low.advance
    return buffer


def hindsight_settings(model: TBCHRL) -> HindsightSettings:
    """How episodes are rewritten for the high level; a failed test costs ``max_options`` unless the user says what."""
    penalty = -float(model.max_options) if model.testing_penalty is None else model.testing_penalty
    return HindsightSettings(
        int(model.n_hindsight_goals), model.goal_strategy, penalty, model.keep_original, model.relabel_tolerance,
        model.goals_met,
    )  # fmt: skip
