"""SB3's callbacks while each algorithm learns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contract import corridor, every_algorithm, make, shows
from stable_baselines3.common import callbacks as sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv


class Counting(sb3.BaseCallback):
    """Counts what it is called for."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = self.starts = self.ends = self.rollouts = 0

    def _on_training_start(self) -> None:
        self.starts += 1

    def _on_rollout_start(self) -> None:
        self.rollouts += 1

    def _on_step(self) -> bool:
        self.steps += 1
        return True

    def _on_training_end(self) -> None:
        self.ends += 1


@shows("yes", "BaseCallback", "EventCallback", "CallbackList")
@every_algorithm
def test_a_callback_is_called_at_each_point(algo: str) -> None:
    counting, every = Counting(), Counting()
    event = sb3.EveryNTimesteps(10, every)
    model = make(algo, make_vec_env(corridor, 2)).learn(60, callback=[counting, event])
    assert isinstance(event, sb3.EventCallback)
    assert (counting.steps, counting.starts, counting.ends) == (30, 1, 1)
    assert counting.rollouts >= 1
    assert every.steps == 6
    assert counting.num_timesteps == model.num_timesteps == 60


@shows("yes", "callback.locals")
@every_algorithm
def test_locals_are_sb3s(algo: str) -> None:
    ends: list[int] = []

    class Look(sb3.BaseCallback):
        def _on_step(self) -> bool:
            given = self.locals
            assert given["rewards"].shape == given["dones"].shape == (2,)
            assert given["actions"].shape == (2, 1)
            assert given["new_obs"]["observation"].shape == (2, 3)
            assert len(given["infos"]) == 2
            assert self.training_env is self.model.get_env()
            for index in np.flatnonzero(given["dones"]):
                ends.append(given["infos"][index]["episode"]["l"])
            return True

    model = make(algo, make_vec_env(lambda: corridor(5.0), 2)).learn(100, callback=Look())
    assert ends
    assert len(ends) == model._episode_num
    assert ends == [info["l"] for info in model.ep_info_buffer]


@shows("yes", "CheckpointCallback")
@every_algorithm
def test_checkpoints(algo: str, tmp_path: Path) -> None:
    callback = sb3.CheckpointCallback(50, str(tmp_path), save_replay_buffer=True)
    model = make(algo).learn(100, callback=callback)
    loaded = type(model).load(tmp_path / "rl_model_50_steps.zip", env=corridor())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_50_steps.pkl")
    assert loaded.num_timesteps == 50
    loaded.learn(20, reset_num_timesteps=False)


@shows("yes", "EvalCallback", "StopTrainingOnRewardThreshold", "StopTrainingOnNoModelImprovement")
@every_algorithm
def test_evaluations(algo: str, tmp_path: Path) -> None:
    evaluation = sb3.EvalCallback(
        Monitor(corridor(5.0)), eval_freq=20, n_eval_episodes=2, log_path=str(tmp_path), verbose=0,
        best_model_save_path=str(tmp_path), callback_after_eval=sb3.StopTrainingOnNoModelImprovement(1, 1),
    )  # fmt: skip
    model = make(algo).learn(500, callback=evaluation)
    assert model.num_timesteps == 60  # the third evaluation is the second without improvement
    with np.load(tmp_path / "evaluations.npz") as told:
        assert told["timesteps"].tolist() == [20, 40, 60]
        assert (told["results"] == -20.0).all()
    assert (tmp_path / "best_model.zip").is_file()
    best = sb3.EvalCallback(
        Monitor(corridor()), callback_on_new_best=sb3.StopTrainingOnRewardThreshold(-1e9), eval_freq=10, verbose=0
    )
    assert make(algo).learn(500, callback=best).num_timesteps == 10


@shows("yes", "StopTrainingOnMaxEpisodes")
@every_algorithm
def test_stops_after_so_many_episodes(algo: str) -> None:
    stop = sb3.StopTrainingOnMaxEpisodes(3)
    model = make(algo, lambda_env()).learn(5000, callback=stop)
    assert stop.n_episodes == 3
    assert 3 <= model.num_timesteps <= 60


def lambda_env() -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(corridor(5.0))])


@shows("yes", "ConvertCallback", "EveryNTimesteps", "LogEveryNTimesteps", "ProgressBarCallback")
@every_algorithm
def test_the_others_run(algo: str) -> None:
    seen: list[int] = []

    def note(given: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.append(given["self"].num_timesteps)
        return True

    model = make(algo)
    model.learn(40, callback=[sb3.ConvertCallback(note), sb3.LogEveryNTimesteps(15)], progress_bar=True)
    assert seen == list(range(1, 41))


@shows("yes", "callback returns False")
@every_algorithm
@pytest.mark.parametrize("no", [False, np.bool_(False)])
def test_a_callback_stops_learning(algo: str, no: Any) -> None:
    assert make(algo).learn(500, callback=lambda _, __: no).num_timesteps == 1
