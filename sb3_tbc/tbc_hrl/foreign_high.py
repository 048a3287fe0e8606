"""Another algorithm's policy in the place of an agent's high level."""

from __future__ import annotations

import copy
from typing import TypeVar, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_tbc.arrays import FloatArray
from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.tbc_hrl.actor import TwoLevelActor
from sb3_tbc.tbc_hrl.two_level_saving import TwoLevelSaving

Agent = TypeVar("Agent", bound=TwoLevelSaving)


class ForeignHigh:
    """Proposes options as an algorithm's policy does; it is not trained any more.

    :param algorithm: trained in an :class:`~sb3_tbc.tbc_hrl.option_env.OptionEnv`
    """

    def __init__(self, algorithm: BaseAlgorithm) -> None:
        self.algorithm = algorithm

    def act(
        self, observations: FloatArray, states: FloatArray, deterministic: bool, rng: object, average: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Unit subgoals and time budgets ``(n, action_dim)``, and the empty states.

        :param observations: the high level's, ``(n, high_dim)``
        :param rng: not used; the algorithm draws from its own random numbers
        :param average: not used
        """
        unit, _ = self.algorithm.predict(observations, deterministic=deterministic)
        return np.clip(unit, -1.0, 1.0).astype(np.float32), states

    def notice_changes(self) -> None:
        """Nothing: the algorithm acts from its weights themselves."""


def refuse_reconsidering(rules: OptionRules) -> None:
    """Check that an agent's high level can be replaced by another algorithm.

    :param rules: the agent's
    :raises ValueError: if that high level also ends windows
    """
    if rules.may_be_reconsidered:
        raise ValueError(
            "with window_end='reconsider' an agent's own high level ends windows, which another algorithm cannot do in "
            "its place: use an agent with window_end='timed' or 'reached'"
        )


def put_together(high: BaseAlgorithm, low: Agent) -> Agent:
    """A copy of an agent whose options another algorithm proposes.

    :param low: a :class:`~sb3_tbc.tbc_hrl.tbc_hrl.TBCHRL`
    :raises ValueError: if the algorithm's observations or actions are not those of the agent's high level, or were
        normalised; if it has a memory; or if that high level ends windows before their time
    """
    if not isinstance(low, TwoLevelSaving):
        raise ValueError(f"low must be a TBCHRL, whose low level executes the options, got {type(low).__name__}")
    if high.get_vec_normalize_env() is not None:
        raise ValueError(
            "high was trained behind VecNormalize, whose statistics are no part of it: train it on OptionEnv as it is"
        )
    views, space = low.policy.views, low.observation_space
    refuse_reconsidering(low.policy.rules)
    wanted = views.high_space(cast(spaces.Dict, space)), views.high_action_space()
    given = high.observation_space, high.action_space
    if given[0].shape != wanted[0].shape or given[1].shape != wanted[1].shape:
        raise ValueError(
            f"high must observe {wanted[0].shape} and act {wanted[1].shape}, got {given[0].shape} and "
            f"{given[1].shape}: train it in OptionEnv(venv, agent) with this agent"
        )
    if high.predict(np.zeros((1, *wanted[0].shape), np.float32), deterministic=True)[1] is not None:
        raise ValueError(
            f"{type(high).__name__} remembers, and an agent carries no memory of a high level from option to option: "
            "use an algorithm whose predict needs no state"
        )
    agent = copy.copy(low)
    agent.policy = copy.copy(low.policy)
    agent.policy.actor = TwoLevelActor(ForeignHigh(high), low.low.acting, low.policy.memory)  # type: ignore[arg-type]
    agent.foreign_high = high
    return agent
