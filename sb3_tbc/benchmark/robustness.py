"""``python -m sb3_tbc.benchmark robustness``: success of agents under noise, late actions and changed physics.

Each agent acts in the same disturbed episodes of its task. The disturbances are those of
:class:`~sb3_tbc.tasks.perturb.Perturb`: noise on observations, actions that take effect late, and each physical
quantity of the task at 0.7 and 1.3 times its value. They come on top of what the agent was trained with, such as hidden
velocities; of a disturbance that it was trained with, the value tried counts. How smoothly an agent acts is measured
beside it: the mean change of a unit action from one step to the next, in the same episodes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError
from sb3_tbc.evaluate import identify
from sb3_tbc.settings import merge
from sb3_tbc.smdp.options import Episode
from sb3_tbc.stats import wilson_interval
from sb3_tbc.tbc_hrl.collection import TwoLevelRunner
from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL
from sb3_tbc.zoo.algorithms import load_two_levels
from sb3_tbc.zoo.environments import NAMESPACE, make_env
from sb3_tbc.zoo.runner import evaluation_envs

NOISES = (0.01, 0.03, 0.1)
"""Standard deviations of observation noise, in units of the task's ``observation_scale``."""
DELAYS = (1, 2, 4)
"""Steps by which actions are late."""
FACTORS = (0.7, 1.3)
"""Factors for each physical quantity."""


class Robustness(NamedTuple):
    """An agent under one disturbance."""

    disturbance: str
    agent: str
    successes: int
    episodes: int
    roughness: float  # mean change of a unit action between two steps

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the success rate over episodes (Wilson)."""
        return wilson_interval(self.successes, self.episodes)


def disturbances(names: Sequence[str]) -> Iterator[tuple[str, Plain]]:
    """Titles and arguments of :class:`~sb3_tbc.tasks.perturb.Perturb`, beginning with none.

    :param names: physical quantities of the task
    """
    yield "none", {}
    for noise in NOISES:
        yield f"noise {noise:g}", {"observation_noise": noise}
    for delay in DELAYS:
        yield f"actions {delay} late", {"action_delay": delay}
    for name in names:
        for factor in FACTORS:
            yield f"{name} x {factor:g}", {"dynamics_scale": {name: factor}}


def roughness(episodes: Sequence[Episode]) -> float:
    """Mean absolute change of a unit action from one step to the next; NaN where no episode has two steps."""
    changes = [np.abs(np.diff(episode.actions, axis=0)).ravel() for episode in episodes]
    together = np.concatenate(changes)
    return float(together.mean()) if len(together) else float("nan")


def episodes_under(model: TBCHRL, env_id: str, env_kwargs: Mapping[str, object], n: int, seed: int) -> list[Episode]:
    """Episodes of an agent that acts as in an evaluation, in the order of environments and their episodes."""
    venv = evaluation_envs(env_id, n, seed, dict(env_kwargs))
    try:
        runner = TwoLevelRunner(venv, model.policy, np.random.default_rng(seed), deterministic=True)
        return runner.run(n, lambda episode: episode)
    finally:
        venv.close()


def measure(path: Path, n_episodes: int, seed: int, env_id: str | None = None, trust: bool = False) -> list[Robustness]:
    """One agent under every disturbance of its task.

    :param path: the agent's ``.zip``
    :param env_id: the task, by default the one on which the agent was trained
    :raises ConfigError: for an agent of one level, and for a task that cannot be disturbed
    """
    info = identify(path, env_id, trust)
    env_id, env_kwargs = str(info["env_id"]), info["env_kwargs"]
    if not env_id.startswith(NAMESPACE):
        raise ConfigError(f"{path} acts in {env_id}; only this package's tasks can be disturbed")
    model = load_two_levels(path, trust=trust)
    env = make_env(env_id, **env_kwargs)
    names: tuple[str, ...] = env.unwrapped.dynamics_names  # type: ignore[attr-defined]
    env.close()
    own = env_kwargs.get("perturb") or {}
    rows = []
    for title, disturbed in disturbances(names):
        episodes = episodes_under(model, env_id, {**env_kwargs, "perturb": merge(own, disturbed)}, n_episodes, seed)
        successes = sum(episode.success for episode in episodes)
        rows.append(Robustness(title, str(path), successes, len(episodes), roughness(episodes)))
    return rows


def robustness(arguments: argparse.Namespace) -> tuple[list[str], Plain]:
    """All agents side by side, as lines and figures.

    :raises ConfigError: if two agents were trained on different tasks
    """
    given = [identify(path, arguments.env, arguments.trust)["env_id"] for path in arguments.models]
    if len(set(given)) > 1:
        raise ConfigError(f"agents of different tasks cannot be compared, got {', '.join(given)}")
    tables = [
        measure(path, arguments.n_episodes, arguments.seed, arguments.env, arguments.trust) for path in arguments.models
    ]
    lines = [f"agent {i}: {table[0].agent}" for i, table in enumerate(tables)]
    head = "".join(f"{f'success {i}':>11}{f'95 % Wilson {i}':>15}{f'rough {i}':>9}" for i in range(len(tables)))
    lines.append(f"{'disturbance':<20}{head}")
    for together in zip(*tables, strict=True):
        cells = "".join(_cells(row) for row in together)
        lines.append(f"{together[0].disturbance:<20}{cells}")
    figures = [{**row._asdict(), "interval": list(row.interval)} for table in tables for row in table]
    return lines, {"n_episodes": arguments.n_episodes, "seed": arguments.seed, "rows": figures}


def _cells(row: Robustness) -> str:
    low, high = row.interval
    return f"{row.successes / row.episodes:>11.2f}{f'{low:.2f} to {high:.2f}':>15}{row.roughness:>9.3f}"
