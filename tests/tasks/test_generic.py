"""Foreign goal environments: what they lack is explained, and what they have becomes a subgoal space."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from making import make
from points import Boxed, Dense, Point
from sb3_tbc.tasks import TASKS
from sb3_tbc.tasks.generic import DescribedGoalEnv, check_goal_env, describe_goal_env, subgoal_space_of
from sb3_tbc.tasks.probe import run_probe
from stable_baselines3.common.monitor import Monitor

from sb3_tbc.zoo.environments import make_env


@pytest.mark.parametrize("task", TASKS)
def test_our_own_tasks_lack_nothing(task):
    env = make(task)
    check_goal_env(env)
    subgoals = subgoal_space_of(env)
    assert subgoals is env.unwrapped.subgoals
    restored = pickle.loads(pickle.dumps(subgoals))
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(restored.achieved(observation), subgoals.achieved(observation))


class WithSubgoals(gym.Wrapper):
    """A wrapper that says what may be asked for."""

    def __init__(self, env):
        super().__init__(env)
        self.subgoals = describe_goal_env(Point(), names=["mine_x", "mine_y"]).subgoals


def test_a_wrappers_subgoals_count():
    gym.register("WithSubgoals-v0", lambda **_: WithSubgoals(Point()), max_episode_steps=30)
    try:
        for env in (make_env("WithSubgoals-v0"), gym.make("WithSubgoals-v0")):
            assert env.get_wrapper_attr("subgoals").names == ("mine_x", "mine_y")
            assert subgoal_space_of(env).names == ("mine_x", "mine_y")
    finally:
        del gym.registry["WithSubgoals-v0"]
    hidden = make("Pendulum", perturb={"hide_velocities": True})
    assert subgoal_space_of(hidden) is hidden.get_wrapper_attr("subgoals")


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
    with pytest.raises(ValueError, match=r"(?s)declare the largest actions.*one shape"):
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


def test_bounds_come_from_random_episodes_within_the_declared_box():
    tight = describe_goal_env(Point(bound=1.5)).subgoals  # goals up to 2 are asked for
    np.testing.assert_array_equal(tight.low, [-1.5, -1.5])
    np.testing.assert_allclose(tight.thresholds, 0.3)
    wide = describe_goal_env(Point(bound=100.0)).subgoals  # nothing is ever seen beyond 4
    assert (np.abs([wide.low, wide.high]) < 4.0).all()
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


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"thresholds": "near"}, "thresholds must be a number or a list of numbers, got 'near'"),
        ({"low": ["left", 0]}, "low must be a number or a list of numbers"),
        ({"n_probe_steps": 0}, "n_probe_steps must be a whole number of at least 1, got 0"),
        ({"n_probe_steps": 2.5}, "n_probe_steps must be a whole number"),
    ],
)
def test_what_is_given_is_checked_first(given, message):
    with pytest.raises(ValueError, match=message):
        describe_goal_env(Point(), **given)


def test_an_agent_names_what_measures_subgoals():
    from sb3_tbc import TBCHRL

    with pytest.raises(ValueError, match=r"no subgoal space: .*DescribedGoalEnv\(env\)"):
        TBCHRL("MultiInputPolicy", Point())
    assert TBCHRL("MultiInputPolicy", DescribedGoalEnv(Point()), max_options=4, compile=False).subgoals.dim == 2


class DenseWithTest(Dense):
    def _is_success(self, achieved_goal, desired_goal):
        return np.linalg.norm(achieved_goal - desired_goal, axis=-1) < 0.3


class DenseWithSingleTest(Dense):
    def _is_success(self, achieved_goal, desired_goal):
        return bool(np.linalg.norm(achieved_goal - desired_goal) < 0.3)


@pytest.mark.parametrize("kind", [DenseWithTest, DenseWithSingleTest])
def test_a_dense_reward_needs_the_tasks_success_test(kind):
    env = DescribedGoalEnv(kind())
    np.testing.assert_array_equal(env.subgoals.thresholds, [0.3])
    env.reset(seed=0)
    goals = np.zeros((2, 2)), np.array([[0.2, 0.0], [0.4, 0.0]])
    np.testing.assert_array_equal(env.compute_terminated(*goals), [True, False])
    np.testing.assert_allclose(env.compute_reward(*goals), [-0.2, -0.4])
    env.unwrapped.goal = env.unwrapped.position + 0.05
    _, reward, terminated, _, info = env.step(np.zeros(2))
    assert (terminated, info["is_success"]) == (True, True)
    assert -0.1 < reward < 0.0


def test_a_dense_reward_without_a_test_is_refused_or_takes_given_thresholds():
    with pytest.raises(ValueError, match=r"Dense cannot be used .* its reward is dense.*thresholds") as caught:
        describe_goal_env(Dense())
    assert "\n" not in str(caught.value)
    env = DescribedGoalEnv(Dense(), thresholds=0.25)
    assert env.compute_terminated(np.zeros(2), np.array([0.2, 0.0])) is True
    assert env.compute_terminated(np.zeros(2), np.array([0.3, 0.0])) is False


def test_rewards_that_contradict_themselves_are_refused():
    class Uneven(Point):
        def compute_reward(self, achieved_goal, desired_goal, info):
            return super().compute_reward(achieved_goal, desired_goal, info) * np.asarray(desired_goal)[..., 0] + 0.0

    class Better(Point):
        def compute_reward(self, achieved_goal, desired_goal, info):
            return -super().compute_reward(achieved_goal, desired_goal, info)

    class Always(Point):
        def compute_reward(self, achieved_goal, desired_goal, info):
            return np.zeros(np.shape(achieved_goal)[:-1])

    class Claims(Point):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, {**info, "success": True}

    class Raised(Point):
        def compute_reward(self, achieved_goal, desired_goal, info):
            base = super().compute_reward(achieved_goal, desired_goal, info)
            return base + np.abs(np.asarray(desired_goal)[..., 0])

    for kind, message in (
        (Better, "away from a goal, but only"),
        (Always, "for every observed pair of goals"),
        (Claims, "its info contradicts its reward"),
        (Raised, "not the same everywhere"),
    ):
        with pytest.raises(ValueError, match=f"{kind.__name__} cannot be used .*{message}"):
            describe_goal_env(kind())


def test_the_check_asks_as_training_does():
    class Costly(Point):
        extra = {"cost": 1.0}  # noqa: RUF012

        def compute_reward(self, achieved_goal, desired_goal, info):
            return super().compute_reward(achieved_goal, desired_goal, info) - info["cost"]

    class Hidden(Costly):
        def compute_reward(self, achieved_goal, desired_goal, info):
            return Point.compute_reward(self, achieved_goal, desired_goal, info) - info.get("cost", 0.0)

    with pytest.raises(ValueError, match=r"fails \(KeyError: 'cost'\)"):
        check_goal_env(Costly())
    with pytest.raises(ValueError, match="must not depend on info or on wrappers"):
        check_goal_env(Hidden())
    with pytest.raises(ValueError, match="must not depend on info or on wrappers"):
        check_goal_env(gym.wrappers.TransformReward(Point(), lambda reward: 2 * reward))


def test_a_crash_may_cost_more_than_the_goal_says():
    class Crashing(Point):
        def step(self, action):
            observation, reward, *_ = super().step(action)
            return observation, reward - 5.0 * (self.steps == 3), self.steps == 3, False, {}

    check_goal_env(Crashing())


def test_arrays_that_are_used_again_are_copied():
    class Same(Point):
        def _see(self):
            fresh = super()._see()
            if not hasattr(self, "held"):
                self.held = fresh
            for key, value in fresh.items():
                self.held[key][:] = value
            return self.held

    one, other = describe_goal_env(Same()), describe_goal_env(Point())
    np.testing.assert_array_equal(one.subgoals.low, other.subgoals.low)
    np.testing.assert_array_equal(one.observation_scale, other.observation_scale)


def test_randomness_from_elsewhere_is_noticed():
    class Loose(Point):
        def step(self, action):
            return super().step(np.asarray(action) * np.random.default_rng().uniform(0.5, 1.0))

    with pytest.warns(UserWarning, match=r"Loose differs between two episodes.*self\.np_random"):
        check_goal_env(Loose())


def test_probing_leaves_the_random_stream_alone():
    one, other = Point(), Point()
    one.reset(seed=7)
    other.reset(seed=7)
    describe_goal_env(one)
    np.testing.assert_array_equal(one.reset()[0]["desired_goal"], other.reset()[0]["desired_goal"])


def test_user_wrappers_and_changed_attributes_count():
    class Half(gym.ObservationWrapper):
        """Shows goals at half their size; records no constructor arguments, so no copy of it can be made."""

        def observation(self, observation):
            return {**observation, **{key: 0.5 * observation[key] for key in ("achieved_goal", "desired_goal")}}

        def compute_reward(self, achieved_goal, desired_goal, info):
            return self.unwrapped.compute_reward(2 * achieved_goal, 2 * desired_goal, info)

    plain, half = DescribedGoalEnv(Point()), DescribedGoalEnv(Half(Point()))
    np.testing.assert_allclose(half.subgoals.high, 0.5 * plain.subgoals.high)
    np.testing.assert_allclose(half.subgoals.thresholds, [0.15])
    env = Boxed()
    env.slack = 0.7
    np.testing.assert_allclose(DescribedGoalEnv(env).subgoals.thresholds, [0.3, 0.7])


def test_success_is_read_under_either_name():
    class Says(Point):
        name = "success"

        def step(self, action):
            observation, reward, *rest, _ = super().step(action)
            return observation, reward, *rest, {self.name: reward == 0.0}

    for name in ("success", "is_success"):
        env = DescribedGoalEnv(Says())
        env.unwrapped.name = name
        env.reset(seed=0)
        assert env.step(np.zeros(2))[4]["is_success"] is False
        env.unwrapped.goal = env.unwrapped.position.copy()
        assert env.step(np.zeros(2))[4]["is_success"] is True


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


def test_a_monitor_beneath_sees_the_episodes_that_end_with_success(tmp_path):
    """SB3 evaluates by what the Monitor sees: an agent that always succeeded was evaluated for ever."""
    log = tmp_path / "monitor.csv"
    env = DescribedGoalEnv(Monitor(Point(), str(log), info_keywords=("is_success",)), n_probe_steps=200)
    for steps in (1, 3):
        env.reset(seed=steps)
        for _ in range(steps - 1):
            assert "episode" not in env.step(np.zeros(2))[4]
        env.unwrapped.goal = env.unwrapped.position.copy()
        _, reward, terminated, _, info = env.step(np.zeros(2))
        assert (reward, terminated, info["is_success"], info["episode"]["l"]) == (0.0, True, True, steps)
    assert len(log.read_text().splitlines()) == 2 + 2  # the random episodes of the description are not among them
    patient = DescribedGoalEnv(Monitor(Point()), terminate_on_success=False)
    patient.reset(seed=0)
    patient.unwrapped.goal = patient.unwrapped.position.copy()
    assert patient.step(np.zeros(2))[2] is False


def test_wrappers_between_that_hide_the_end_from_a_monitor_are_refused():
    with pytest.raises(ValueError, match=r"the Monitor beneath TimeLimit does not see .* directly around the Monitor"):
        DescribedGoalEnv(TimeLimit(Monitor(Point()), 20))
    DescribedGoalEnv(Monitor(TimeLimit(Point(), 20)))


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


def test_a_description_can_be_shared_and_travels():
    first = DescribedGoalEnv(Point())
    again = DescribedGoalEnv(Point(), description=pickle.loads(pickle.dumps(first.description)))
    np.testing.assert_array_equal(again.subgoals.low, first.subgoals.low)
    again.reset(seed=0)
    assert again.compute_terminated(np.zeros(2), np.zeros(2)) is True


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


def test_observations_that_are_not_finite_are_named():
    class Nan(Point):
        def _see(self):
            return super()._see() | {"desired_goal": np.array([np.nan, 0.0])}

    with pytest.raises(ValueError, match=r"'desired_goal'. of Nan is not finite"):
        describe_goal_env(Nan())


@pytest.mark.parametrize("wrong", [np.full(4, np.nan), np.zeros(3)])
def test_a_bad_step_of_random_episodes_is_left_out(wrong):
    """What becomes of such steps is for the agent to say (``on_bad_step``)."""

    class Once(Point):
        always = False

        def step(self, action):
            seen, *rest = super().step(action)
            return ({**seen, "observation": wrong} if self.always or self.steps == 7 else seen), *rest

    probe = run_probe(Once(), 100)
    assert 0 < len(probe.after) < 100
    assert probe.seen["observation"].shape[1:] == (4,)
    assert np.isfinite(probe.seen["observation"]).all()
    Once.always = True
    with pytest.raises(ValueError, match=r"'observation'. of Once (is not finite|has shape .3,.*) in every step"):
        run_probe(Once(), 100)


def test_a_reward_is_one_number():
    class Array(Point):
        def step(self, action):
            seen, reward, *rest = super().step(action)
            return seen, np.array([reward]), *rest

    with pytest.raises(ValueError, match=r"the reward of Array is no number but an array of shape \(1,\)"):
        run_probe(Array(), 100)
