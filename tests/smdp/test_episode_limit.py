"""An episode that ends because the high level's decisions are used up ends for everyone who watches."""

from __future__ import annotations

import csv
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from corridor import Corridor
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecMonitor

from sb3_tbc import TBCHRL
from sb3_tbc.errors import ConfigError, EnvironmentFault
from sb3_tbc.smdp.episode_limit import EpisodeLimit, LastWindow, LimitingVecEnv, with_episode_limit
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.smdp.hierarchical_vec_env import HierarchicalVecEnv, Proposal
from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.smdp.views import LevelViews

SPACE = SubgoalSpace.from_slices(
    [-1.0], [1.0], [0.05], local=["observation"], local_scale=[1.0, 50.0, 100.0], names=["position"]
)


def far() -> gym.Env[Any, Any]:
    """A goal out of reach and no time limit that matters: only the budget of decisions ends episodes."""
    env = Corridor(1000, goal=5.0)
    env.subgoals = SPACE
    return env


def monitored(file: str | None = None) -> gym.Env[Any, Any]:
    return Monitor(far(), file)


def wrapped(file: str | None = None) -> gym.Env[Any, Any]:
    """The monitor is not the outermost wrapper."""
    return gym.wrappers.TimeLimit(monitored(file), 900)


def hierarchical(venv: Any, **rules: Any) -> HierarchicalVecEnv:
    rng = np.random.default_rng(0)
    n = lambda where: len(where)  # noqa: E731
    return HierarchicalVecEnv(
        venv,
        lambda seen, where: Proposal(rng.uniform(-1, 1, (n(where), 2)), np.zeros(n(where), bool)),
        LevelViews(SPACE),
        OptionRules(**{"dt_max": 6.0, "max_options": 3, **rules}),
    )


def episodes_of(env: HierarchicalVecEnv, steps: int = 60) -> tuple[list[Any], list[dict[str, Any]]]:
    """Finished episodes under random actions, and the infos of the steps that ended them."""
    rng = np.random.default_rng(1)
    env.reset()
    episodes, infos = [], []
    for _ in range(steps):
        step = env.advance(rng.uniform(-1, 1, (env.num_envs, 1)).astype(np.float32))
        for index, episode in step.episodes.items():
            episodes.append(episode)
            infos.append(step.infos[index])
            assert step.episode_over[index]
    return episodes, infos


VECTORS = {
    "dummy": lambda: DummyVecEnv([far, far]),
    "goal": lambda: GoalVecEnv([far, far]),
    "monitored": lambda: GoalVecEnv([monitored, monitored]),
    "wrapped twice": lambda: DummyVecEnv([lambda: Monitor(gym.wrappers.TimeLimit(far(), 900))] * 2),
    "processes": lambda: SubprocVecEnv([far, far], start_method="fork"),
    "monitored in processes": lambda: SubprocVecEnv([monitored, monitored], start_method="fork"),
    "wrapped in processes": lambda: SubprocVecEnv([wrapped, wrapped], start_method="fork"),
}


@pytest.mark.parametrize("kind", VECTORS)
@pytest.mark.parametrize("rules", [{}, {"window_end": "reached", "dt_min": 1.5}], ids=["timed", "reached"])
def test_everyone_sees_the_end(kind: str, rules: dict[str, Any]) -> None:
    venv = VecMonitor(VECTORS[kind]())
    venv.seed(0)
    episodes, infos = episodes_of(hierarchical(venv, **rules))
    venv.close()
    assert len(episodes) > 5
    for episode, info in zip(episodes, infos, strict=True):
        assert episode.budget_exhausted
        assert len(episode.options) == 3
        assert not episode.success
        assert not episode.terminated
        assert info["TimeLimit.truncated"]
        assert info["episode"]["l"] == episode.length <= 18
        assert np.isclose(info["episode"]["r"], episode.rewards.sum())
        last = info["terminal_observation"]["observation"]
        assert last[1] == episode.length  # not of the next episode
        if not rules:
            assert [o.duration for o in episode.options] == [max(1, np.ceil(o.time_budget)) for o in episode.options]


def test_all_kinds_of_vectors_give_the_same_episodes() -> None:
    lengths = []
    for kind in VECTORS:
        venv = VECTORS[kind]()
        venv.seed(3)
        episodes, _ = episodes_of(hierarchical(venv, window_end="reached"), 40)
        venv.close()
        lengths.append([(e.length, e.options[-1].reached) for e in episodes])
    assert all(each == lengths[0] for each in lengths)
    assert any(reached for _, reached in lengths[0])  # the last window of some episode ended early


class Kept(gym.ObservationWrapper):
    """A wrapper of observations that keeps their space, and here the observations, too."""

    def observation(self, observation: Any) -> Any:
        return {key: np.array(part) for key, part in observation.items()}


class Halved(gym.ObservationWrapper):
    """What the task sees is not what the agent sees, although the spaces are the same."""

    def observation(self, observation: Any) -> Any:
        return {**observation, "achieved_goal": 0.5 * observation["achieved_goal"]}


@pytest.mark.parametrize("there", [False, True])
def test_a_step_in_which_the_task_hears_late_of_the_end_is_taken_back(there: bool) -> None:
    kind = partial(SubprocVecEnv, start_method="fork") if there else DummyVecEnv
    told = []
    for env in (far, lambda: Kept(far())):
        venv = kind([env] * 2)
        venv.seed(3)
        episodes, infos = episodes_of(hierarchical(venv, window_end="reached"), 40)
        venv.close()
        assert all(e.budget_exhausted and not e.success and not e.terminated for e in episodes)
        assert all(not i["is_success"] and i["TimeLimit.truncated"] for i in infos)
        assert all(
            i["terminal_observation"]["observation"][1] == e.length for e, i in zip(episodes, infos, strict=True)
        )
        told.append([(e.length, e.options[-1].reached) for e in episodes])
    n = min(map(len, told))
    assert told[0][:3] == told[1][:3]  # later ones have had an action less
    assert n > 5
    assert any(reached for _, reached in told[1])


def test_what_a_wrapper_of_observations_shows_ends_the_last_window() -> None:
    episodes, _ = episodes_of(hierarchical(DummyVecEnv([lambda: Halved(far())] * 2), window_end="reached"), 200)
    last = [(episode, episode.options[-1]) for episode in episodes]
    assert any(option.reached and option.duration < option.time_budget for _, option in last)
    for episode, option in last:
        seen = episode.achieved_goal[option.start + 1 : episode.length + 1, 0]
        there = np.flatnonzero(np.abs(seen - option.subgoal[0]) < 0.05)
        assert option.reached == (len(there) > 0)
        if len(there):
            assert option.duration == there[0] + 1


class EndsAtItsGoal(gym.Wrapper):
    """Ends episodes that the task itself would go on with."""

    def step(self, action: Any) -> Any:
        observation, reward, _, truncated, info = self.env.step(action)
        return observation, reward, info["is_success"], truncated, info


class GoesOn(Corridor):
    """A corridor that does not end at its goal, and in which all actions lead to it in its sixth step."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, _ = super().step(np.ones(1))
        return observation, reward, False, truncated, {"is_success": terminated}


@pytest.mark.parametrize("venv", [DummyVecEnv, partial(SubprocVecEnv, start_method="fork")], ids=["here", "there"])
def test_success_in_the_last_step_of_the_last_window_counts(venv: Any) -> None:
    env = hierarchical(venv([lambda: EndsAtItsGoal(GoesOn(30, goal=0.6))]), dt_max=2.0, dt_min=1.5)
    episodes, infos = episodes_of(env, 20)
    env.close()
    assert [episode.length for episode in episodes] == [6, 6, 6]
    for episode, info in zip(episodes, infos, strict=True):
        assert episode.success
        assert episode.terminated
        assert not episode.budget_exhausted
        assert info["is_success"]


def test_the_monitors_file_holds_every_episode(tmp_path: Any) -> None:
    there = partial(SubprocVecEnv, start_method="fork")
    kinds = {"here": (GoalVecEnv, monitored), "there": (there, monitored), "beneath": (there, wrapped)}
    for name, (kind, env) in kinds.items():
        path = tmp_path / name
        venv = kind([partial(env, str(path))])
        episodes, _ = episodes_of(hierarchical(venv), 40)
        venv.close()
        with path.with_suffix(".monitor.csv").open() as file:
            file.readline()
            rows = list(csv.DictReader(file))
        assert [int(row["l"]) for row in rows] == [episode.length for episode in episodes]
        assert len(rows) > 2


class Doubled(VecEnvWrapper):
    """Changes what the agent sees."""

    def _of(self, observation: Any) -> Any:
        return {**observation, "achieved_goal": 0.5 * observation["achieved_goal"]}

    def reset(self) -> Any:
        return self._of(self.venv.reset())

    def step_wait(self) -> Any:
        observation, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = self._of(info["terminal_observation"])
        return self._of(observation), rewards, dones, infos


@pytest.mark.parametrize("window_end", ["timed", "reached"])
def test_nothing_goes_past_a_wrapper_of_the_vector(window_end: str) -> None:
    """What it shows is all that is recorded, even where the task does not see what the agent sees."""
    env = hierarchical(Doubled(VECTORS["monitored"]()), window_end=window_end)
    episodes, _ = episodes_of(env)
    assert len(episodes) > 5
    for episode in episodes:
        np.testing.assert_allclose(episode.achieved_goal[:, 0], 0.5 * episode.observation[:, 0], atol=1e-6)
        assert len(episode.options) <= 3
        assert sum(option.duration for option in episode.options) == episode.length


class Skipping(gym.Wrapper):
    """Four of the task's steps make one of the agent's."""

    def step(self, action: Any) -> Any:
        for _ in range(4):
            observation, reward, terminated, truncated, info = self.env.step(action)
            if terminated or truncated:
                break
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("rules", [{}, {"window_end": "reached", "dt_min": 1.5}], ids=["timed", "reached"])
def test_windows_count_the_agents_steps_and_not_frames(there: bool, rules: dict[str, Any]) -> None:
    kind = partial(SubprocVecEnv, start_method="fork") if there else DummyVecEnv
    env = hierarchical(kind([lambda: Monitor(Skipping(far()))] * 2), **rules)
    episodes, _ = episodes_of(env)
    env.close()
    options = [option for episode in episodes for option in episode.options]
    assert all(episode.budget_exhausted and len(episode.options) == 3 for episode in episodes)
    assert all(o.duration == max(1, np.ceil(o.time_budget)) or (rules and o.reached) for o in options)
    assert len(episodes) > 5


class WholeBatch(DummyVecEnv):
    """A vector whose simulator cannot begin one episode alone."""

    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> Any:
        if method_name == "reset":
            raise NotImplementedError
        return super().env_method(method_name, *args, **kwargs)


def test_a_vector_that_cannot_reset_one_environment_is_told_so() -> None:
    env = hierarchical(LimitingVecEnv(WholeBatch([far, far])))
    with pytest.raises(ConfigError, match="WholeBatch cannot reset one environment alone"):
        episodes_of(env)


def test_an_end_of_the_tasks_own_is_not_called_a_used_up_budget() -> None:
    env = hierarchical(DummyVecEnv([lambda: Corridor(4, goal=5.0)]))
    episodes, infos = episodes_of(env)
    assert {episode.length for episode in episodes if not episode.budget_exhausted} == {4}
    assert all(e.budget_exhausted == ("budget_exhausted" in i) for e, i in zip(episodes, infos, strict=True))


def test_the_limit_is_put_in_once_and_beneath_the_wrappers() -> None:
    venv = VECTORS["wrapped twice"]()
    for _ in range(2):
        assert with_episode_limit(venv) is venv
    inner = venv.envs[0].env.env
    assert isinstance(inner, EpisodeLimit)
    assert isinstance(inner.env, Corridor)
    bare = SubprocVecEnv([far], start_method="fork")
    outer = VecMonitor(bare)
    assert with_episode_limit(outer) is outer
    assert isinstance(outer.venv, LimitingVecEnv)
    outer.close()


def test_a_reset_forgets_what_was_announced() -> None:
    env = EpisodeLimit(far())
    env.reset(seed=0)
    env.announce_last_window(LastWindow(False))
    assert not any(env.step(np.zeros(1))[3] for _ in range(5))
    env.announce_last_window(LastWindow(True))
    assert env.step(np.zeros(1))[3]
    env.reset()
    assert not any(env.step(np.zeros(1))[3] for _ in range(5))


def test_faults_of_a_task_name_environment_and_step() -> None:
    class Faulty(Corridor):
        fault = ""

        def step(self, action: Any) -> Any:
            observation, *rest, info = super().step(action)
            if self.steps == 2 and self.fault == "raise":
                raise RuntimeError("simulator lost")
            if self.steps == 2 and self.fault == "shape":
                observation["observation"] = np.zeros(1)
            if self.steps == 2 and self.fault == "key":
                del observation["achieved_goal"]
            return observation, *rest, None if self.steps == 2 and self.fault == "info" else info

    cases = {
        "raise": (EnvironmentFault, "environment 1 failed at step 2 of its episode: RuntimeError: simulator lost"),
        "shape": (
            EnvironmentFault,
            r"environment 1, step 2 .*'observation'. must have shape \(3,\) .* shape \(1,\)",
        ),
        "key": (EnvironmentFault, r"environment 1, step 2 .*'achieved_goal'. .* got nothing"),
        "info": (EnvironmentFault, "environment 1, step 2 .* info must be a dictionary, got None"),
    }
    for fault, (error, message) in cases.items():
        venv = DummyVecEnv([lambda: Corridor(30, 5.0), lambda: Faulty(30, 5.0)])
        venv.envs[1].fault = fault
        env = hierarchical(venv)
        env.reset()
        env.advance(np.zeros((2, 1), np.float32))
        with pytest.raises(error, match=message):
            env.advance(np.zeros((2, 1), np.float32))


def test_an_environment_that_reuses_its_arrays_keeps_the_last_observation() -> None:
    class Reusing(Corridor):
        held: Any = None

        def _observation(self) -> Any:
            new = {key: np.asarray(part, float) for key, part in super()._observation().items()}
            self.held = self.held or new
            for key, part in new.items():
                self.held[key][:] = part
            return self.held

    records = []
    for kind in (Corridor, Reusing):
        for vector in (DummyVecEnv, GoalVecEnv):
            venv = vector([lambda kind=kind: kind(7, goal=5.0)])
            venv.seed(0)
            episodes, _ = episodes_of(hierarchical(venv, max_options=50))
            records.append(np.concatenate([episode.observation for episode in episodes]))
    for record in records[1:]:
        np.testing.assert_array_equal(record, records[0])


@pytest.mark.parametrize("value", ["no", np.nan, [False], np.array([True, False]), None, 0.5])
@pytest.mark.parametrize("place", ["terminated", "truncated"])
def test_ends_are_true_or_false(place: str, value: Any) -> None:
    """A text, NaN or a list would count as true, and end an episode that goes on."""

    class Vague(Corridor):
        def step(self, action: Any) -> Any:
            seen, reward, *ends, info = super().step(action)
            ends[place == "truncated"] = value
            return seen, reward, *ends, info

    model = TBCHRL("MultiInputPolicy", Vague(), max_options=5, compile=False, seed=0)
    with pytest.raises(
        EnvironmentFault, match=f"environment 0, step 1 of its episode: {place} must be True or False, got"
    ):
        model.learn(5)


@pytest.mark.parametrize("kind", [bool, np.bool_, int, lambda x: np.array([x])])
def test_ends_may_be_numbers(kind: Any) -> None:
    class Numbers(Corridor):
        def step(self, action: Any) -> Any:
            seen, reward, terminated, truncated, info = super().step(action)
            return seen, reward, kind(terminated), kind(truncated), info

    assert TBCHRL("MultiInputPolicy", Numbers(5), max_options=5, compile=False, seed=0).learn(12)._episode_num >= 2
