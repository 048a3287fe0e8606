"""Configurations, run folders and the results ledger, on which the commands rest."""

from __future__ import annotations


def register() -> None:
    """Make TBC-HRL, HiTS and HAC known to RL Baselines3 Zoo, see :func:`sb3_tbc.zoo.rl_zoo.register`.

    :raises MissingExtraError: if rl_zoo3 is not installed
    """
    from sb3_tbc.zoo import rl_zoo  # not before it is asked for: it needs all algorithms

    rl_zoo.register()
