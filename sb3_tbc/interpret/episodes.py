"""Held-out episodes of an agent, whole or lesioned: what every unit did at every step, and how each episode ended."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.interpret.units import Lesion, Units, stack
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.smdp.options import Episode
from sb3_tbc.smdp.spaces import GoalObservation
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.collection import TwoLevelRunner
from sb3_tbc.zoo.environments import make_env, refuse_other_spaces
from sb3_tbc.zoo.runner import HELD_OUT

MAX_SIDE_BY_SIDE = 160
"""Number of environments that step together: acting costs about the same for one as for many."""


class Trace(NamedTuple):
    """One episode of T steps with N units."""

    episode: Episode
    inputs: FloatArray  # (T, inputs), what the low level saw
    before: FloatArray  # (T, state_dim), its memory before each step
    activations: FloatArray  # (T, N), after each step

    @property
    def windows(self) -> list[slice]:
        """The steps of each option."""
        return [slice(o.start, o.start + o.duration) for o in self.episode.options]

    @property
    def phase(self) -> FloatArray:
        """How far each step's window has run, 0 at its first step, below 1 at its last, ``(T,)``."""
        return np.concatenate([np.arange(o.duration) / o.duration for o in self.episode.options])

    @property
    def subgoal(self) -> FloatArray:
        """The live subgoal of each step, ``(T, subgoal_dim)``, task units."""
        return np.concatenate([np.tile(o.subgoal, (o.duration, 1)) for o in self.episode.options])

    @property
    def steps_left(self) -> FloatArray:
        """Steps left of the time budget before each step, ``(T,)``."""
        return np.concatenate([o.time_budget - np.arange(o.duration) for o in self.episode.options])


class Outcome(NamedTuple):
    """How episodes ended, one entry per episode."""

    success: FloatArray  # 0 or 1
    subgoals: FloatArray  # share of windows that reached their subgoal
    length: FloatArray  # steps


class HeldOutEpisodes:
    """Episodes that training never saw: the same starts and goals for every lesion.

    :param model: the agent, deterministic
    :param env_id: its environment
    :param env_kwargs: arguments of the environment
    :param n_episodes: how many
    :param seed: episode i starts from ``seed + i``
    :raises ConfigError: when they begin, if the environment is none that the agent can act in
    """

    def __init__(self, model: TBCHRL, env_id: str, env_kwargs: Plain, n_episodes: int, seed: int = HELD_OUT) -> None:
        self.model, self.n_episodes, self.seed = model, n_episodes, seed
        self.make_env = partial(make_env, env_id, **env_kwargs)
        self._venvs: dict[int, _SeededVecEnv] = {}

    def record(self, units: Units, lesion: Lesion) -> list[Trace]:
        """Every episode under one lesion, with all that the units did."""
        return self._run(units, [lesion] * self.n_episodes, list(range(self.n_episodes)))

    def record_one(self, units: Units, lesion: Lesion) -> list[Trace]:
        """The first episode alone, under one lesion."""
        return self._run(units, [lesion], [0])

    def outcomes(self, units: Units, lesions: Sequence[Lesion]) -> list[Outcome]:
        """How all episodes end under each of several lesions."""
        rows = [(lesion, i) for lesion in lesions for i in range(self.n_episodes)]
        episodes: list[Episode] = []
        for start in range(0, len(rows), MAX_SIDE_BY_SIDE):
            chunk = rows[start : start + MAX_SIDE_BY_SIDE]
            traces = self._run(units, [lesion for lesion, _ in chunk], [i for _, i in chunk])
            episodes += [trace.episode for trace in traces]
        n = self.n_episodes
        return [outcome_of(episodes[k : k + n]) for k in range(0, len(episodes), n)]

    def _run(self, units: Units, lesions: Sequence[Lesion], which: Sequence[int]) -> list[Trace]:
        if len(which) not in self._venvs:
            self._venvs[len(which)] = _SeededVecEnv([self.make_env] * len(which))
            refuse_other_spaces(self.model, self._venvs[len(which)])
        venv = self._venvs[len(which)]
        venv.start_from([self.seed + i for i in which])
        return run_once(self.model, units, venv, stack(lesions))

    def close(self) -> None:
        """Free the environments."""
        for venv in self._venvs.values():
            venv.close()


def outcome_of(episodes: Sequence[Episode]) -> Outcome:
    """How episodes ended."""
    return Outcome(
        np.array([float(e.success) for e in episodes]),
        np.array([np.mean([o.reached for o in e.options]) for e in episodes]),
        np.array([float(e.length) for e in episodes]),
    )


def run_once(model: TBCHRL, units: Units, venv: VecEnv, lesion: Lesion) -> list[Trace]:
    """One whole episode in every environment.

    :param lesion: one row per environment
    """
    runner = _LesionedRunner(model, units, venv, lesion)
    runner.reset()
    finished: dict[int, Episode] = {}
    while len(finished) < venv.num_envs:
        finished = runner.step().episodes | finished  # of each environment the first
    columns = [np.stack(part) for part in zip(*runner.log, strict=True)]
    return [Trace(e, *(part[: e.length, i] for part in columns)) for i, e in sorted(finished.items())]


class _LesionedRunner(TwoLevelRunner):
    """The deterministic agent with a lesioned low level, all of whose units are recorded."""

    def __init__(self, model: TBCHRL, units: Units, venv: VecEnv, lesion: Lesion) -> None:
        rng = np.random.default_rng(0)  # both levels act by their means and draw nothing
        super().__init__(venv, model.policy, rng, deterministic=True)
        self.units, self.lesion = units, lesion
        self.log: list[tuple[FloatArray, FloatArray, FloatArray]] = []

    def begin(self, observation: GoalObservation) -> None:
        """Begin episodes; units may have other memory than the trained low level."""
        super().begin(observation)
        self.membrane = np.zeros((self.env.num_envs, self.units.state_dim), dtype=np.float32)

    def act(self) -> tuple[FloatArray, FloatArray]:
        """Act with the lesion, and record."""
        unit, after, activations = self.units.step(self.observation, self.membrane, self.lesion)
        self.log.append((self.observation, self.membrane, activations.astype(np.float32)))
        return unit, after


class _SeededVecEnv(GoalVecEnv):
    """Goal environments whose next episodes start from given seeds, which may repeat."""

    def start_from(self, seeds: Sequence[int]) -> None:
        """Give every environment the seed of its next reset."""
        self._seeds = list(seeds)
