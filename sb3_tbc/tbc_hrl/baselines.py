"""The paper's hierarchical baselines as modes of the same code."""

from __future__ import annotations

from typing import ClassVar

from sb3_tbc.tbc_hrl.config import HACConfig, HiTSConfig, TBCConfig
from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL


class HiTS(TBCHRL):
    """Hierarchical RL with timed subgoals (Guertler, Buechler, Martius 2021).

    Windows run their full time, the reward is per decision, the low level is an MLP. Settings as :class:`TBCHRL`, with
    the defaults of :class:`~sb3_tbc.tbc_hrl.config.HiTSConfig`.
    """

    config_class: ClassVar[type[TBCConfig]] = HiTSConfig


class HAC(TBCHRL):
    """Hierarchical actor-critic (Levy et al. 2019) on two levels of SAC, as in the public graph_rl.

    The high level chooses a subgoal and no time. The low level keeps control until it reaches the subgoal or has used
    up its own budget of actions (``fixed_duration``, by default the episode's length divided by ``max_options``), pays
    1 for every step, and sees no time. Failed options become the subgoal that was achieved, goals of both levels are
    relabelled, tests of subgoals are penalised. Settings as :class:`TBCHRL`, with the defaults of
    :class:`~sb3_tbc.tbc_hrl.config.HACConfig`.
    """

    config_class: ClassVar[type[TBCConfig]] = HACConfig
