"""Environments, vectors of them and wrappers, as SB3's users give them."""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from contract import corridor, every_algorithm, make, shows, two_levels
from corridor import Corridor
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.results_plotter import plot_results
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
)

from sb3_tbc import SubgoalSpace


@shows("yes", "env: an id, an environment, a vector")
@every_algorithm
def test_single_environments_are_wrapped(algo: str) -> None:
    for env in ("sb3_tbc/Pendulum-v0", gym.make("sb3_tbc/Pendulum-v0"), corridor(), DummyVecEnv([corridor])):
        model = make(algo, env)
        assert model.get_env().num_envs == 1  # type: ignore[union-attr]
    assert make(algo).get_env().env_is_wrapped(Monitor) == [True]  # type: ignore[union-attr]


@shows("yes", "DummyVecEnv", "SubprocVecEnv", "make_vec_env")
@every_algorithm
@pytest.mark.parametrize("kind", [DummyVecEnv, partial(SubprocVecEnv, start_method="fork")], ids=["here", "processes"])
def test_vectors(algo: str, kind: Any) -> None:
    venv = make_vec_env(corridor, 2, vec_env_cls=kind)
    model = make(algo, venv).learn(240)
    venv.close()
    assert model.num_timesteps == 240
    assert model._n_updates > 0


def with_functions() -> Corridor:
    """A corridor whose subgoal space is made of functions without a name."""
    env = Corridor(20)
    achieved, local = (lambda seen: np.asarray(seen["achieved_goal"])), (lambda seen: np.asarray(seen["observation"]))
    env.subgoals = SubgoalSpace([-1.0], [1.0], [0.05], achieved, local, [1.0, 50.0, 100.0], ["position"])
    return env


@shows("yes", "SubgoalSpace of lambdas in SubprocVecEnv")
@two_levels
def test_functions_travel_between_processes(algo: str) -> None:
    venv = SubprocVecEnv([with_functions, with_functions], start_method="fork")
    assert make(algo, venv).learn(60).num_timesteps == 60
    venv.close()


class Scaled(VecEnvWrapper):
    """Gives ten times the rewards."""

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        seen, rewards, dones, infos = self.venv.step_wait()
        return seen, 10.0 * rewards, dones, infos


@shows("yes", "Monitor", "VecMonitor", "VecEnvWrapper", "load_results, plot_results")
@every_algorithm
def test_monitors_see_every_episode(algo: str, tmp_path: Path) -> None:
    inner = Monitor(corridor(5.0), str(tmp_path / "inner"))
    venv = VecMonitor(Scaled(DummyVecEnv([lambda: inner])), str(tmp_path / "outer"))
    model = make(algo, venv).learn(100)
    with (tmp_path / "inner.monitor.csv").open() as file:
        file.readline()
        lengths = [int(row["l"]) for row in csv.DictReader(file)]
    assert len(lengths) == model._episode_num >= 5
    assert [info["r"] for info in model.ep_info_buffer] == [-10.0 * length for length in lengths]
    results = load_results(str(tmp_path))
    assert len(results) == 2 * len(lengths)
    plot_results([str(tmp_path)], 100, "timesteps", algo)


@shows("yes", "VecCheckNan", "VecTransposeImage")
@two_levels
def test_wrappers_that_change_nothing(algo: str) -> None:
    for wrap in (VecCheckNan, VecTransposeImage):
        assert make(algo, wrap(DummyVecEnv([corridor]))).learn(60)._n_updates > 0


@shows("yes", "VecVideoRecorder")
def test_films_are_recorded(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    venv = DummyVecEnv([partial(gym.make, "sb3_tbc/Pendulum-v0", render_mode="rgb_array")])
    recorder = VecVideoRecorder(venv, str(tmp_path), record_video_trigger=lambda step: step == 0, video_length=5)
    make("hits", recorder).learn(20)
    recorder.close()
    assert list(tmp_path.glob("*.mp4"))


@shows("refused", "VecNormalize", "VecFrameStack", "VecExtractDictObs")
@every_algorithm
@pytest.mark.parametrize(
    ("wrap", "words"),
    [
        (VecNormalize, "VecNormalize moves the subgoal space"),
        (partial(VecFrameStack, n_stack=2), "VecFrameStack.* makes achieved_goal of shape"),
        (partial(VecExtractDictObs, key="observation"), "must be a Dict with the keys"),
    ],
)
def test_wrappers_that_change_what_a_subgoal_is(algo: str, wrap: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(algo, wrap(DummyVecEnv([corridor])))


class GoalsOutside(gym.Wrapper):  # type: ignore[type-arg]
    """Makes a goal environment of one that has no goals: they are known to the wrapper alone."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.inner = corridor(5.0)
        self.observation_space, self.subgoals = self.inner.observation_space, self.inner.subgoals

    def _seen(self, position: Any) -> dict[str, Any]:
        goal = np.array([5.0])
        return {"observation": np.r_[position, 0.0, 0.0], "achieved_goal": np.array(position), "desired_goal": goal}

    def reset(self, **kwargs: Any) -> Any:
        position, info = self.env.reset(**kwargs)
        return self._seen(position), info

    def step(self, action: Any) -> Any:
        position, *rest = self.env.step(action)
        return self._seen(position), *rest

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return self.inner.compute_reward(achieved_goal, desired_goal, info)


class NoGoals(gym.Env):  # type: ignore[type-arg]
    """A point without goals and without an end of its own."""

    observation_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.position = np.zeros(1)
        return self.position.copy(), {}

    def step(self, action: Any) -> Any:
        self.position = np.clip(self.position + 0.1 * action, -1, 1)
        return self.position.copy(), -1.0, False, False, {}


@shows("yes", "gymnasium.Wrapper", "TimeLimit, gymnasium.make(max_episode_steps=)")
@every_algorithm
@pytest.mark.parametrize("processes", [False, True])
def test_a_wrapper_may_bring_the_goals_and_the_limit(algo: str, processes: bool) -> None:
    def build() -> Any:
        return Monitor(gym.wrappers.TimeLimit(GoalsOutside(NoGoals()), 20))

    venv = SubprocVecEnv([build], start_method="fork") if processes else DummyVecEnv([build])
    model = make(algo, venv).learn(100)
    venv.close()
    assert model._episode_num >= 5  # the budget of actions, or the time limit, ends each
    assert max(info["l"] for info in model.ep_info_buffer) <= 20
    if algo != "sac":
        assert model.dt_max == 4.0


@shows("yes", "environments without compute_terminated or is_success")
@every_algorithm
def test_a_reward_says_enough(algo: str) -> None:
    assert make(algo, gym.wrappers.TimeLimit(GoalsOutside(NoGoals()), 20)).learn(60).num_timesteps == 60


@shows("refused", "environments without goals, discrete, whole-number or two-dimensional actions")
@every_algorithm
def test_what_is_no_goal_environment(algo: str) -> None:
    class Discrete(Corridor):
        def __init__(self) -> None:
            super().__init__(20)
            self.action_space = spaces.Discrete(3)

    class Square(Corridor):
        def __init__(self) -> None:
            super().__init__(20)
            self.action_space = spaces.Box(-1, 1, (2, 2), np.float32)

    class Whole(Corridor):
        def __init__(self) -> None:
            super().__init__(20)
            self.action_space = spaces.Box(-1, 1, (1,), np.int64)

    refused = (NoGoals(), "must be a Dict"), (Discrete(), "Box"), (Square(), "one dimension"), (Whole(), "real numbers")
    for env, words in refused:
        with pytest.raises((ValueError, AssertionError), match=words):
            make(algo, env)


class AlsoLight(gym.ObservationWrapper):  # type: ignore[type-arg]
    """Adds a part to a goal observation."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        parts = cast(spaces.Dict, env.observation_space).spaces
        self.observation_space = spaces.Dict({**parts, "light": spaces.Box(0, 1, (2,), np.float64)})

    def observation(self, observation: Any) -> Any:
        return {**observation, "light": np.zeros(2)}


@shows("yes", "further parts of an observation")
@two_levels
def test_what_two_levels_do_not_see_is_told(algo: str) -> None:
    with pytest.warns(UserWarning, match="does not see 'light' of an observation"):
        assert make(algo, AlsoLight(corridor())).learn(30).num_timesteps == 30
    space = SubgoalSpace([-1.0], [1.0], [0.05], lambda o: o["achieved_goal"], lambda o: o["light"], [1.0, 1.0], ["x"])
    with (
        pytest.warns(UserWarning, match="does not see 'light'"),
        pytest.raises(ValueError, match=r"local map reads the part 'light' .* put its entries into 'observation'"),
    ):
        make(algo, AlsoLight(Corridor(20)), subgoals=space)


@shows("refused", "observations and rewards that are NaN")
@every_algorithm
@pytest.mark.parametrize("part", ["observation", "reward", "last observation"])
def test_what_is_not_finite_is_named(algo: str, part: str) -> None:
    class Bad(Corridor):
        def step(self, action: Any) -> Any:
            seen, reward, terminated, truncated, info = super().step(action)
            now = self.steps == 3 if part != "last observation" else truncated
            if now and part != "reward":
                seen["observation"][0] = np.nan
            return seen, (np.nan if now and part == "reward" else reward), terminated, truncated, info

    at = 3 if part != "last observation" else 4
    words = f"environment 1, step {at} of its episode: .*{part.split()[-1]}"
    with pytest.raises(FloatingPointError, match=words):
        make(algo, DummyVecEnv([lambda: Corridor(4, 5.0), lambda: Bad(4, 5.0)])).learn(60)


@shows("yes", "check_env")
@pytest.mark.parametrize("task", ["Pendulum", "Drawbridge"])
def test_our_tasks_pass_sb3s_checker(task: str) -> None:
    check_env(gym.make(f"sb3_tbc/{task}-v0"), skip_render_check=True)
