"""Evaluation: success inside the time limit and, with two levels, inside the high level's action budget."""

from __future__ import annotations

from typing import Annotated, NamedTuple, cast

import numpy as np
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_tbc.aliases import Env
from sb3_tbc.arrays import BoolArray, FloatArray, IntArray
from sb3_tbc.settings import Range, hints, read
from sb3_tbc.smdp.episode_limit import with_episode_limit
from sb3_tbc.smdp.goal_spaces import goal_parts
from sb3_tbc.smdp.guard import GuardedVecEnv
from sb3_tbc.smdp.options import Episode
from sb3_tbc.tbc_hrl.arguments import SB3Arguments
from sb3_tbc.tbc_hrl.checks import refuse_vec_normalize
from sb3_tbc.tbc_hrl.collection import TwoLevelRunner
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL


class EvaluationResult(NamedTuple):
    """One entry per evaluated episode, in the order of the environments and of their episodes."""

    successes: BoolArray
    lengths: IntArray  # environment steps
    rewards: FloatArray  # undiscounted sums
    subgoal_success: FloatArray  # share of options that reached their subgoal
    mean_window: FloatArray  # mean option length, environment steps
    decisions: IntArray  # options used
    budget_exhausted: BoolArray  # the episode failed because its action budget was used up

    @property
    def success_rate(self) -> float:
        """Share of successful episodes."""
        return float(self.successes.mean())

    @property
    def mean_length_success(self) -> float | None:
        """Mean length of the successful episodes, None if there is none."""
        return float(self.lengths[self.successes].mean()) if self.successes.any() else None


Agent = TBCHRL | FlatSAC
"""What can be trained and evaluated here."""


Row = tuple[float, ...]
"""The figures of one episode, in the order of :class:`EvaluationResult`'s fields."""


def evaluate_agent(
    model: Agent,
    env: VecEnv | Env,
    n_eval_episodes: int = 100,
    seed: int | None = None,
    deterministic: bool = True,
) -> EvaluationResult:
    """Evaluate an agent of any of our algorithms, see :func:`evaluate_hierarchical`."""
    if isinstance(model, FlatSAC):
        return evaluate_flat(model, env, n_eval_episodes, seed, deterministic)
    return evaluate_hierarchical(model, env, n_eval_episodes, seed, deterministic)


def evaluate_flat(
    model: FlatSAC,
    env: VecEnv | Env,
    n_eval_episodes: int = 100,
    seed: int | None = None,
    deterministic: bool = True,
) -> EvaluationResult:
    """As :func:`evaluate_hierarchical`, for an agent without subgoals: these figures are NaN, decisions are 0."""
    n_eval_episodes, given = _checked(n_eval_episodes, seed), _vector(env)
    refuse_vec_normalize(given)
    check_for_correct_spaces(given, model.observation_space, model.action_space)
    venv: VecEnv = GuardedVecEnv(with_episode_limit(given), model.on_bad_step)
    if seed is not None:
        venv.seed(seed)
    observation = venv.reset()
    totals = np.zeros((2, venv.num_envs))  # steps, rewards
    results: list[list[Row]] = [[] for _ in range(venv.num_envs)]
    per_env = -(-n_eval_episodes // venv.num_envs)
    while min(len(rows) for rows in results) < per_env:
        actions, _ = model.predict(observation, deterministic=deterministic)  # type: ignore[arg-type]
        observation, rewards, dones, infos = venv.step(actions)
        totals += np.stack([np.ones(venv.num_envs), rewards])
        for index in np.flatnonzero(dones):
            results[index].append((infos[index]["is_success"], *totals[:, index], np.nan, np.nan, 0, False))
            totals[:, index] = 0.0
    return _columns([rows[i] for i in range(per_env) for rows in results][:n_eval_episodes])


def evaluate_hierarchical(
    model: TBCHRL,
    env: VecEnv | Env,
    n_eval_episodes: int = 100,
    seed: int | None = None,
    deterministic: bool = True,
) -> EvaluationResult:
    """Run whole episodes and count successes as the paper does (section 5.1).

    Every environment of the vector runs the same number of episodes (rounded up, the surplus is left out), so that
    short episodes are not over-represented.

    :param model: a trained agent
    :param env: a goal environment or a vector of them
    :param n_eval_episodes: episodes to run
    :param seed: seeds the environments (environment i gets ``seed + i``), for episode-by-episode comparisons
    :param deterministic: use the means of both levels (and the averaged actors)
    :raises ValueError: if ``n_eval_episodes`` is no number of episodes, ``seed`` is no seed, or the environment is
        none that the agent can act in
    """
    n_eval_episodes, venv = _checked(n_eval_episodes, seed), _vector(env)
    refuse_vec_normalize(venv)
    same = goal_parts(venv.observation_space) == goal_parts(model.observation_space)  # it sees nothing else
    if not same or venv.action_space != model.action_space:
        check_for_correct_spaces(venv, model.observation_space, model.action_space)
    runner = TwoLevelRunner(venv, model.policy, np.random.default_rng(seed), deterministic, model.config.on_bad_step)
    if seed is not None:
        venv.seed(seed)
    return _columns(runner.run(n_eval_episodes, _row))


def _checked(n_eval_episodes: int, seed: int | None) -> int:
    """The number of episodes.

    :raises SettingError: if it is none, or the seed is none
    """
    read(seed, hints(SB3Arguments)["seed"], "seed")
    return cast(int, read(n_eval_episodes, Annotated[int, Range(1)], "n_eval_episodes"))


def _vector(env: VecEnv | Env) -> VecEnv:
    return env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])


def _columns(rows: list[Row]) -> EvaluationResult:
    types = (bool, np.int64, np.float64, np.float64, np.float64, np.int64, bool)
    columns = zip(zip(*rows, strict=True), types, strict=True)
    return EvaluationResult(*(np.array(column, dtype=kind) for column, kind in columns))


def _row(episode: Episode) -> Row:
    """What :class:`EvaluationResult` holds of an episode, in its order."""
    options = episode.options
    return (
        episode.success,
        episode.length,
        episode.rewards.sum(),
        float(np.mean([option.reached for option in options])),
        float(np.mean([option.duration for option in options])),
        len(options),
        episode.budget_exhausted,
    )
