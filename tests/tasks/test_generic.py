"""Foreign goal environments: what they lack is explained, and what they have becomes a subgoal space."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from making import make
from sb3_tbc.tasks import TASKS
from sb3_tbc.tasks.generic import DescribedGoalEnv, check_goal_env, describe_goal_env, subgoal_space_of


class Point(gym.Env):
    """A point in the plane; the observation holds position and velocity."""

    def __init__(self, bound=np.inf, hidden=False, threshold=None):
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        goal = spaces.Box(-bound, bound, (2,), np.float64)
        size = 2 if hidden else 4
        self.observation_space = spaces.Dict(
            observation=spaces.Box(-np.inf, np.inf, (size,), np.float64), achieved_goal=goal, desired_goal=goal
        )
        self.hidden = hidden
        self.max_episode_steps = 30
        if threshold is not None:
            self.distance_threshold = threshold

    def _see(self):
        state = self.velocity if self.hidden else np.concatenate([self.velocity, self.position])
        return {
            "observation": state.copy(),
            "achieved_goal": self.position.copy(),
            "desired_goal": self.goal.copy(),
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.velocity = self.np_random.uniform(-0.1, 0.1, 2), np.zeros(2)
        self.goal = self.np_random.uniform(-2.0, 2.0, 2)
        self.steps = 0
        return self._see(), {}

    def step(self, action):
        self.velocity = 0.5 * self.velocity + 0.1 * np.asarray(action, float)
        self.position = self.position + self.velocity
        self.steps += 1
        observation = self._see()
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
        return observation, float(reward), False, self.steps >= 30, {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.where(np.linalg.norm(achieved_goal - desired_goal, axis=-1) < 0.3, 0.0, -1.0)


@pytest.mark.parametrize("task", TASKS)
def test_our_own_tasks_lack_nothing(task):
    env = make(task)
    check_goal_env(env)
    subgoals = subgoal_space_of(env)
    assert subgoals is env.unwrapped.subgoals
    restored = pickle.loads(pickle.dumps(subgoals))
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(restored.achieved(observation), subgoals.achieved(observation))


def test_check_names_every_problem():
    with pytest.raises(ValueError, match=r"(?s)CartPole-v1.*Discrete.*achieved_goal.*compute_reward"):
        check_goal_env(gym.make("CartPole-v1"))
    env = Point()
    del env.max_episode_steps
    with pytest.raises(ValueError, match="max_episode_steps=N"):
        check_goal_env(env)
    check_goal_env(TimeLimit(Point(), 30))
    env = Point()
    env.action_space = spaces.Box(-np.inf, np.inf, (2,))
    env.observation_space["achieved_goal"] = spaces.Box(-1, 1, (3,))
    with pytest.raises(ValueError, match=r"(?s)RescaleAction.*one shape"):
        check_goal_env(env)


def test_check_finds_rewards_that_cannot_be_recomputed():
    env = Point()
    env.compute_reward = lambda achieved, desired, info: np.where(np.linalg.norm(achieved - desired) < 0.3, 0.0, -1.0)
    with pytest.raises(ValueError, match="vectorise"):
        check_goal_env(env)

    class Liar(Point):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            return observation, reward - 5.0, *rest

    with pytest.raises(ValueError, match="must agree"):
        check_goal_env(Liar())


def test_bounds_come_from_box_or_from_random_episodes():
    finite = describe_goal_env(Point(bound=3.0)).subgoals
    np.testing.assert_array_equal(finite.low, [-3, -3])
    np.testing.assert_allclose(finite.thresholds, 0.3)
    sampled = describe_goal_env(Point()).subgoals
    assert (sampled.low < -1.8).all()
    assert (sampled.high > 1.8).all()
    assert (np.abs([sampled.low, sampled.high]) < 4.0).all()
    again = describe_goal_env(Point()).subgoals
    np.testing.assert_array_equal(sampled.low, again.low)
    given = describe_goal_env(Point(), low=[-1, -2], high=[1, 2], thresholds=[0.1, 0.2], names=["x", "y"]).subgoals
    np.testing.assert_array_equal(given.high, [1, 2])
    np.testing.assert_array_equal(given.thresholds, [0.1, 0.2])
    assert given.names == ("x", "y")
    with pytest.raises(ValueError, match="shape of achieved_goal"):
        describe_goal_env(Point(), low=[-1, -1, -1])
    with pytest.raises(ValueError, match="low < high"):
        describe_goal_env(Point(), low=[2, 2], high=[1, 1])


def test_distance_threshold_is_euclidean():
    subgoals = describe_goal_env(Point(threshold=0.5)).subgoals
    assert subgoals.groups == ((0, 1),)
    assert subgoals.reached(np.array([0.3, 0.3]), np.zeros(2))
    assert not subgoals.reached(np.array([0.4, 0.4]), np.zeros(2))
    one = describe_goal_env(Point(), thresholds=0.2).subgoals
    assert one.groups == ((0, 1),)


class Boxed(Point):
    """Coordinates count one by one, the second not at all if ``slack`` is infinite."""

    slack = 0.5

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.where((np.abs(achieved_goal - desired_goal) < [0.3, self.slack]).all(axis=-1), 0.0, -1.0)


class Dense(Point):
    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)


def test_thresholds_come_from_rewards_where_nothing_is_declared():
    subgoals = describe_goal_env(Point(bound=4.0)).subgoals
    assert subgoals.groups == ((0, 1),)
    np.testing.assert_array_equal(subgoals.thresholds, [0.3])
    subgoals = describe_goal_env(Boxed(bound=4.0)).subgoals
    assert subgoals.groups == ((0,), (1,))
    np.testing.assert_array_equal(subgoals.thresholds, [0.3, 0.5])
    same = Boxed(bound=4.0)
    same.slack = 0.3
    assert describe_goal_env(same).subgoals.groups == ((0,), (1,))
    blind = Boxed(bound=4.0)
    blind.slack = np.inf
    for env in (blind, Dense(bound=4.0)):  # rewards that do not tell: 5 % of each range
        np.testing.assert_allclose(describe_goal_env(env).subgoals.thresholds, [0.4, 0.4])


def test_low_level_sees_the_achieved_goal():
    inside, hidden = describe_goal_env(Point()), describe_goal_env(Point(hidden=True))
    assert inside.achieved_in_observation
    assert not hidden.achieved_in_observation
    observation, _ = Point(hidden=True).reset(seed=0)
    assert hidden.subgoals.local(observation).shape == (4,)
    np.testing.assert_array_equal(hidden.subgoals.local(observation)[:2], observation["achieved_goal"])
    assert inside.subgoals.local_dim == 4


def test_wrapper_adds_success_and_ends_episodes():
    env = DescribedGoalEnv(Point())
    assert env.max_episode_steps == 30
    assert env.get_wrapper_attr("subgoals").dim == 2
    env.reset(seed=0)
    assert env.step(np.zeros(2))[4]["is_success"] is False
    env.unwrapped.goal = env.unwrapped.position.copy()
    _, reward, terminated, _, info = env.step(np.zeros(2))
    assert (reward, terminated, info["is_success"]) == (0.0, True, True)
    patient = DescribedGoalEnv(Point(), terminate_on_success=False)
    patient.reset(seed=0)
    patient.unwrapped.goal = patient.unwrapped.position.copy()
    assert patient.step(np.zeros(2))[2] is False


def test_wrapper_brings_rewards_to_zero_and_minus_one():
    class Paying(Point):
        def compute_reward(self, achieved_goal, desired_goal, info):
            return 1.0 + super().compute_reward(achieved_goal, desired_goal, info)

    env = DescribedGoalEnv(Paying())
    env.reset(seed=0)
    assert env.step(np.zeros(2))[1] == -1.0
    goals = np.array([[0.0, 0.0], [0.0, 0.0]]), np.array([[0.1, 0.0], [1.0, 0.0]])
    np.testing.assert_array_equal(env.compute_reward(*goals, {}), [0.0, -1.0])
    np.testing.assert_array_equal(env.compute_terminated(*goals, {}), [True, False])
    assert env.compute_reward(goals[0][0], goals[1][1], {}) == -1.0
    assert not DescribedGoalEnv(Paying(), terminate_on_success=False).compute_terminated(*goals, {}).any()


def test_description_is_found_once_per_environment_and_arguments(monkeypatch):
    from sb3_tbc.tasks import generic

    calls = []
    describe = generic.describe_goal_env
    monkeypatch.setattr(
        generic, "describe_goal_env", lambda env, **given: calls.append(given) or describe(env, **given)
    )
    for low in (-3, -3, -2):
        DescribedGoalEnv(make("Pendulum"), n_probe_steps=5, low=[low, -9])
    assert [given["low"] for given in calls] == [[-3, -9], [-2, -9]]
    DescribedGoalEnv(Point(), n_probe_steps=5)
    DescribedGoalEnv(Point(), n_probe_steps=5)
    assert len(calls) == 4  # without a spec there is nothing to tell environments apart by


def test_a_maze_of_gymnasium_robotics():
    import gymnasium_robotics

    gym.register_envs(gymnasium_robotics)
    env = DescribedGoalEnv(gym.make("PointMaze_UMaze-v3"), n_probe_steps=400)
    assert env.subgoals.dim == 2
    np.testing.assert_allclose(env.subgoals.thresholds, [0.45])
    assert env.achieved_in_observation
    assert env.max_episode_steps == 300
    env.reset(seed=0)
    _, reward, _, _, info = env.step(env.action_space.sample())
    assert (reward, info["is_success"]) == (-1.0, False)
