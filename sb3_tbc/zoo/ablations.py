"""Ablations of TBC-HRL, with network widths that give them as many parameters as the full model (table 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

from stable_baselines3.common.torch_layers import get_actor_critic_arch

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError
from sb3_tbc.level.level import SACLevel
from sb3_tbc.ndbc.diagnostics import mlp_parameters
from sb3_tbc.settings import merge
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.zoo.algorithms import build_model
from sb3_tbc.zoo.config import RunConfig
from sb3_tbc.zoo.environments import make_envs

TOLERANCE = 0.005
"""Largest relative difference of parameter counts (the paper's 0.5 %)."""
WIDEST = 512


class Matched(NamedTuple):
    """An ablated run with its widths, and the trainable parameters of the full and of the ablated model."""

    run: RunConfig
    full: int
    ablated: int

    def __str__(self) -> str:
        return f"{self.ablated:,} parameters, the full model {self.full:,} ({self.ablated / self.full - 1:+.2%})"


def parameter_count(model: TBCHRL) -> int:
    """Trainable parameters of both levels' actors and critics (targets and averages are copies of these)."""
    networks = (network for level in (model.high, model.low) for network in (level.policy.actor, level.policy.critic))
    return sum(parameter.numel() for network in networks for parameter in network.parameters())


def match_parameters(run: RunConfig, full: RunConfig, env_id: str) -> Matched:
    """Give an ablated run the hidden widths with which it has as many parameters as the full one.

    An ablation without the circuit gets a low-level MLP actor with as many parameters as the circuit had. One without
    some inputs or outputs gets wider last hidden layers in the critics.

    :param run: the ablated configuration
    :param full: the same without the ablation
    :param env_id: environment of the task
    :raises ConfigError: if no widths match within 0.5 %
    """
    reference = _build(full, env_id)
    wanted = parameter_count(reference)
    ablated = _build(run, env_id)
    missing = wanted - parameter_count(ablated)
    if reference.low.state_dim and not ablated.low.state_dim:
        change = _fit_actor(ablated.low, missing, wanted)
    else:
        change = _widen_critics(ablated, missing)
    matched = replace(run, model=merge(run.model, change))
    count = parameter_count(_build(matched, env_id))
    if abs(count - wanted) > TOLERANCE * wanted:
        raise ConfigError(f"no widths give the ablation {wanted:,} parameters within 0.5 %; the nearest have {count:,}")
    return Matched(matched, wanted, count)


def _build(run: RunConfig, env_id: str) -> TBCHRL:
    env = make_envs(env_id, 1, 0, run.env_kwargs)
    try:
        model = build_model(replace(run, model=merge(run.model, {"compile": False})), env, seed=0)
    finally:
        env.close()
    if not isinstance(model, TBCHRL):
        raise ConfigError(f"{run.algo} has no two levels to ablate")
    return model


def _hidden(level: SACLevel) -> tuple[list[int], list[int]]:
    pi, qf = get_actor_critic_arch(level.policy.net_arch)
    return list(pi), list(qf)


def _net_arch(level: str, pi: Sequence[int], qf: Sequence[int]) -> Plain:
    return {level: {"policy_kwargs": {"net_arch": {"pi": list(pi), "qf": list(qf)}}}}


def _fit_actor(level: SACLevel, missing: int, total: int) -> Plain:
    """Widths of the low level's MLP actor, as even as the count allows."""
    pi, qf = _hidden(level)
    inputs, outputs = level.observation_space.shape[0], 2 * level.action_space.shape[0]
    wanted = mlp_parameters([inputs, *pi, outputs]) + missing
    found = []
    for width in range(1, WIDEST):
        below = [width] * (len(pi) - 1)
        rest = mlp_parameters([inputs, *below])
        last = max(round((wanted - rest - outputs) / ((below or [inputs])[-1] + 1 + outputs)), 1)
        error = abs(mlp_parameters([inputs, *below, last, outputs]) - wanted)
        found.append((error > 0.2 * TOLERANCE * total, abs(width - last), error, [*below, last]))
    return _net_arch("low", min(found)[-1], qf)


def _widen_critics(model: TBCHRL, missing: int) -> Plain:
    """Add to the last hidden layer of each level's critics."""
    (low_pi, low_qf), (high_pi, high_qf) = _hidden(model.low), _hidden(model.high)
    per_unit = [
        len(level.policy.critic.q_networks) * (_before_last(level, qf) + 2)
        for level, qf in ((model.low, low_qf), (model.high, high_qf))
    ]
    low, high = min(
        product(range(WIDEST // 8), repeat=2),
        key=lambda add: (abs(missing - add[0] * per_unit[0] - add[1] * per_unit[1]), sum(add)),
    )
    low_qf[-1] += low
    high_qf[-1] += high
    return merge(_net_arch("low", low_pi, low_qf), _net_arch("high", high_pi, high_qf))


def _before_last(level: SACLevel, qf: Sequence[int]) -> int:
    """Width of the layer below a critic's last hidden layer."""
    if len(qf) > 1:
        return qf[-2]
    return int(level.observation_space.shape[0] + level.action_space.shape[0])
