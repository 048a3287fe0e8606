"""What holds for every task: sizes, checkers, goals, seeds, resets without leaks, refusal of bad actions."""

import copy
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from making import ENGINES, make, random_actions
from sb3_tbc.tasks import TASKS
from scripted_policies import Roll, episode_length, sail_late, servo
from stable_baselines3.common.env_checker import check_env as sb3_check_env

STATE_SIZE = {  # paper's table 1, public benchmark
    "AntFourRooms": (111, 29),
    "Drawbridge": (85, 4),
    "Pendulum": (3, 3),
    "Platforms": (75, 13),
    "Tennis2D": (30, 14),
    "UR5Reacher": (48, 6),
}
ACTION_SIZE = {"AntFourRooms": 8, "Drawbridge": 1, "Pendulum": 1, "Platforms": 1, "Tennis2D": 3, "UR5Reacher": 3}
EPISODE_STEPS = {
    "AntFourRooms": 700,
    "Drawbridge": 1000,
    "Pendulum": 1000,
    "Platforms": 500,
    "Tennis2D": 500,
    "UR5Reacher": 600,
}
SIX = sorted(STATE_SIZE)
layouts = pytest.mark.parametrize("layout", ["paper", "compact"])
tasks = pytest.mark.parametrize("task", SIX)
all_ids = pytest.mark.parametrize("task", [*SIX, "UR5ReacherBullet"])


def equal(one, other):
    return all(np.array_equal(one[key], other[key]) for key in one)


def rollout(env, actions, **reset):
    """Observations, rewards and ends along ``actions``; stops where the episode ends."""
    trace = [env.reset(**reset)[0]]
    ends = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        trace.append(observation)
        ends.append((reward, terminated, truncated, info["is_success"]))
        if terminated or truncated:
            break
    return trace, ends


def test_there_are_six():
    assert set(SIX) <= set(TASKS)


@tasks
def test_sizes_are_table_1s(task):
    paper, compact = STATE_SIZE[task]
    env = make(task)
    assert env.observation_space["observation"].shape == (paper,)
    assert make(task, "compact").observation_space["observation"].shape == (compact,)
    assert env.action_space.shape == (ACTION_SIZE[task],)
    assert env.unwrapped.max_episode_steps == EPISODE_STEPS[task]


@layouts
@all_ids
@pytest.mark.filterwarnings("ignore")
def test_checkers_pass(task, layout):
    gymnasium_check_env(make(task, layout).unwrapped, skip_render_check=True)
    sb3_check_env(make(task, layout).unwrapped, skip_render_check=True)  # it does not look behind wrappers


@layouts
@tasks
def test_subgoal_space_fits_the_observations(task, layout):
    env = make(task, layout)
    subgoals, scale = env.unwrapped.subgoals, env.unwrapped.observation_scale
    trace, _ = rollout(env, random_actions(env, 40), seed=3)
    batch = {key: np.stack([observation[key] for observation in trace]) for key in trace[0]}
    assert scale.shape == env.observation_space["observation"].shape
    assert env.unwrapped.goal_scale.shape == env.observation_space["desired_goal"].shape
    achieved, local = subgoals.achieved(batch), subgoals.local(batch)
    assert achieved.shape == (len(trace), subgoals.dim)
    assert local.shape == (len(trace), subgoals.local_dim)
    np.testing.assert_array_equal(achieved[7], subgoals.achieved(trace[7]))
    np.testing.assert_array_equal(local[7], subgoals.local(trace[7]))
    assert subgoals.reached(achieved, achieved).all()
    assert (np.abs(subgoals.scale(achieved)) < 1.5).all()
    assert np.median(np.abs(local / subgoals.local_scale)) < 1.0
    assert (np.abs(batch["observation"] / scale) < 10.0).all()


@all_ids
def test_layouts_show_the_same_state(task):
    paper, compact = make(task), make(task, "compact")
    actions = random_actions(paper, 60)
    for one, other in zip(rollout(paper, actions, seed=1)[0], rollout(compact, actions, seed=1)[0], strict=True):
        for view in ("local", "achieved"):
            np.testing.assert_array_equal(
                getattr(paper.unwrapped.subgoals, view)(one), getattr(compact.unwrapped.subgoals, view)(other)
            )


@all_ids
def test_batched_reward_equals_single(task):
    env = make(task).unwrapped
    rng = np.random.default_rng(0)
    desired = np.stack([env.reset(seed=s)[0]["desired_goal"] for s in range(30)])
    achieved = desired + np.array(env.goal_tolerance) * rng.uniform(-2, 2, desired.shape) * (rng.random((30, 1)) < 0.7)
    rewards = env.compute_reward(achieved, desired, {})
    single = [env.compute_reward(a, d, {}) for a, d in zip(achieved, desired, strict=True)]
    assert rewards.shape == (30,)
    assert set(rewards) == {0.0, -1.0}
    np.testing.assert_array_equal(rewards, single)
    np.testing.assert_array_equal(env.compute_reward(achieved[:, None], desired[:, None], None)[:, 0], rewards)
    np.testing.assert_array_equal(env.compute_terminated(achieved, desired, {}), rewards == 0)
    fast = [env._holds(a, d) for a, d in zip(achieved.tolist(), desired.tolist(), strict=True)]
    np.testing.assert_array_equal(fast, rewards == 0)
    with pytest.raises(ValueError, match="one shape"):
        env.compute_reward(achieved[:3], desired[:2])


@all_ids
def test_step_agrees_with_compute_functions(task):
    env = make(task).unwrapped
    env.reset(seed=0)
    for action in random_actions(env, 30):
        observation, reward, terminated, truncated, info = env.step(action)
        goals = observation["achieved_goal"], observation["desired_goal"], info
        assert isinstance(info["is_success"], bool)
        assert reward == env.compute_reward(*goals)
        assert terminated == env.compute_terminated(*goals)
        assert truncated == env.compute_truncated(*goals)


@pytest.mark.parametrize("task", [task for task in SIX if task != "Tennis2D"])  # which needs a second bounce
def test_success_terminates(task):
    """With the goal set to what the next action achieves, that step succeeds."""
    env = make(task).unwrapped
    action = random_actions(env, 1)[0]
    env.reset(seed=5)
    start = {"state": {key: value for key, value in env.task_state().items() if key in ("qpos", "qvel")}}
    achieved = rollout(env, [action], seed=5, options=start)[0][1]["achieved_goal"]
    goal = achieved + 0.7 * np.array(env.goal_tolerance)
    _, ends = rollout(env, [action], seed=5, options={"goal": goal, **start})
    assert ends == [(0.0, True, False, True)]


@all_ids
def test_time_limit_truncates(task):
    env = copy.deepcopy(make(task).unwrapped)
    env.spec = None  # as one that gymnasium.make has not built
    env.reset(seed=0)
    env._elapsed = env.max_episode_steps - 2
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    assert env.step(action)[2:4] == (False, False)
    observation, reward, terminated, truncated, info = env.step(action)
    assert (reward, terminated, truncated) == (-1.0, False, True)
    batch = np.repeat(observation["achieved_goal"][None], 2, 0), np.repeat(observation["desired_goal"][None], 2, 0)
    assert env.compute_truncated(*batch, info).all()


def assert_one_history(task, layout, n_steps):
    """Two environments with one seed agree to the bit, over the ends of episodes too."""
    one, other = make(task, layout), make(task, layout)
    assert equal(one.reset(seed=7)[0], other.reset(seed=7)[0])
    for action in random_actions(one, n_steps):
        (first, *ends), (second, *other_ends) = one.step(action), other.step(action)
        assert equal(first, second)
        assert ends == other_ends
        if ends[1] or ends[2]:
            assert equal(one.reset()[0], other.reset()[0])


@layouts
@all_ids
def test_one_seed_one_history(task, layout):
    assert_one_history(task, layout, 1000 if task != "AntFourRooms" else 200)


@pytest.mark.slow
@layouts
def test_one_seed_one_history_of_the_ant(layout):
    assert_one_history("AntFourRooms", layout, 1000)


@tasks
def test_seeds_differ(task):
    env = make(task)
    assert not equal(env.reset(seed=7)[0], env.reset(seed=8)[0]) or task == "Drawbridge"


@all_ids
def test_given_goals_and_states_leave_the_rest_of_a_seed_as_it_is(task):
    env = make(task)
    given = {"Tennis2D": {"ball_shot": [6.0, 1.2, 0.0, -5.0, 0.1, 0.0]}}
    first, later = env.reset(seed=5)[0], [env.reset()[0] for _ in range(2)]
    started = env.reset(seed=5, options={"goal": first["desired_goal"]})[0]
    assert equal(started, first)
    for options in ({"goal": first["desired_goal"]}, {"state": given.get(task, {})}):
        env.reset(seed=5, options=options)
        assert all(equal(env.reset()[0], one) for one in later)


@all_ids
def test_observations_are_not_aliased(task):
    env = make(task)
    trace, _ = rollout(env, random_actions(env, 5), seed=0)
    copies = [{key: value.copy() for key, value in observation.items()} for observation in trace]
    rollout(env, random_actions(env, 5, seed=1), seed=1)
    for one, other in zip(trace, copies, strict=True):
        assert equal(one, other)
    before = env.reset(seed=2)[0]
    before["desired_goal"][:] = 99.0
    assert not np.any(env.step(random_actions(env, 1)[0])[0]["desired_goal"] == 99.0)


@all_ids
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**31), before=st.integers(1, 120), after=st.integers(1, 60))
def test_nothing_leaks_over_reset(task, seed, before, after):
    """An episode after another equals the same episode in a fresh environment."""
    used, fresh = make(task), make(task)
    rollout(used, random_actions(used, before, seed), seed=seed)
    actions = random_actions(used, after, seed + 1)
    (first, ends), (second, other_ends) = rollout(used, actions, seed=seed + 1), rollout(fresh, actions, seed=seed + 1)
    assert all(equal(a, b) for a, b in zip(first, second, strict=True))
    assert ends == other_ends
    state, other = used.unwrapped.task_state(), fresh.unwrapped.task_state()
    assert all(np.array_equal(state[key], other[key], equal_nan=True) for key in state)


@all_ids
def test_bad_actions_are_refused(task):
    env = make(task)
    env.reset(seed=0)
    size = env.action_space.shape[0]
    for bad in ([np.nan] * size, [np.inf] * size, [-np.inf] * size):
        with pytest.raises(ValueError, match="finite"):
            env.step(np.array(bad))
    for bad in (0.0, np.zeros(size + 1), np.zeros((1, size)), [], np.array(["left"] * size), [None] * size):
        with pytest.raises(ValueError, match="shape"):
            env.step(bad)
    assert np.isfinite(env.step([0] * size)[0]["observation"]).all()  # plain integers are numbers


@all_ids
def test_large_actions_are_clipped(task):
    wild, mild = make(task), make(task)
    actions = random_actions(wild, 50)
    bound = wild.action_space.high
    first, _ = rollout(wild, np.sign(actions) * 1e30, seed=0)
    second, _ = rollout(mild, np.sign(actions) * bound, seed=0)
    assert all(equal(a, b) for a, b in zip(first, second, strict=True))


@all_ids
@pytest.mark.slow
def test_ten_thousand_hostile_steps(task):
    """Extreme, NaN, infinite and misshapen actions: an error or clipping, and finite observations throughout."""
    env = make(task)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    size = env.action_space.shape[0]
    hostile = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-308, 0.0, 1.0, -1.0])
    for _ in range(10_000):
        action = rng.choice(hostile, size=size + (rng.random() < 0.05))
        if rng.random() < 0.7:
            action = rng.choice([-1e9, -1.0, 0.0, 1.0, 1e9], size=size)
        try:
            observation, _, terminated, truncated, _ = env.step(action)
        except ValueError:
            continue
        assert all(np.isfinite(value).all() for value in observation.values())
        if terminated or truncated:
            env.reset()


@all_ids
def test_user_mistakes_say_what_is_allowed(task):
    with pytest.raises(ValueError, match="paper"):
        make(task, "tall")
    with pytest.raises(ValueError, match="rgb_array"):
        make(task, render_mode="ascii")
    env = make(task)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())
    for options, word in (
        ({"gaol": 1}, "goal"),
        ({"state": {"speed": 1}}, "speed"),
        ({"goal": [np.nan]}, "finite"),
        ({"goal": "left"}, "finite numbers of shape .*'left'"),
    ):
        with pytest.raises(ValueError, match=word):
            env.reset(options=options)
    for options in ([1.0], {"state": 5}):
        with pytest.raises(TypeError, match="must be a dictionary with keys of"):
            env.reset(options=options)
    with pytest.raises(ValueError, match=r"legacy_quirks must be true or false, got 'no'"):
        make(task, legacy_quirks="no")
    with pytest.raises(TypeError, match=r"perturb must be a dictionary .*action_delay"):
        make(task, perturb=5)


@all_ids
def test_goals_of_another_length_are_refused(task):
    """Some goal tests would compare them all the same: of the first entries, or of a batch as if it were one goal."""
    env = make(task).unwrapped
    dim = env.observation_space["desired_goal"].shape[0]
    for shape in ((), (dim + 1,), (5, dim + 1)):
        for function in (env.compute_reward, env.compute_terminated, env.compute_truncated):
            with pytest.raises(ValueError, match=rf"ends with \({dim},\)"):
                function(np.zeros(shape), np.zeros(shape), {})


def test_drawbridge_reference_times():
    env = make("Drawbridge", "compact")
    assert episode_length(env, sail_late(0)) == 854
    assert episode_length(env, sail_late(254)) == 704
    assert episode_length(env, sail_late(253)) > 704


def test_drawbridges_state_is_of_one_moment():
    """Recordings of the original have the angle of the step they name; observations keep that of the step before."""
    env = make("Drawbridge")
    env.reset()
    for _ in range(800):
        env.step(np.zeros(1))
        state = env.unwrapped.task_state()
        step, angle = state["current_step"][0], state["drawbridge_angle_deg"][0]
        assert angle == -min(max(step - 500, 0) * 0.4, 90.0)


def test_platforms_can_be_solved():
    env = make("Platforms", "compact")
    assert [episode_length(env, Roll(), seed=seed) is not None for seed in range(3)] == [True] * 3


def test_ur5_reacher_can_be_solved():
    env = make("UR5Reacher", "compact")
    lengths = [episode_length(env, servo, seed=seed) for seed in range(10)]
    assert None not in lengths


@pytest.mark.slow
def test_random_policy_does_not_solve_ant_four_rooms():
    env = make("AntFourRooms")
    rng = np.random.default_rng(0)
    assert episode_length(env, lambda _: rng.uniform(-1, 1, 8), seed=0) is None


def test_start_distributions():
    """Goals and starts lie where the task says, and differ from reset to reset."""
    env = make("AntFourRooms", "compact")
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        goal, start = observation["desired_goal"], observation["achieved_goal"]
        assert (np.abs(goal[:2]) >= 3).all()
        assert (np.abs(goal[:2]) <= 6.5).all()
        assert tuple(np.sign(goal[:2])) != tuple(np.sign(start[:2]))
    env = make("UR5Reacher", "compact")
    for seed in range(50):
        pan, lift, elbow = env.reset(seed=seed)[0]["desired_goal"]
        assert abs(pan) > np.pi / 4
        assert 0.089159 - 0.425 * np.sin(lift) - 0.39225 * np.sin(lift + elbow) > 0.15


def test_importing_the_package_stays_light():
    code = (
        "import sys, sb3_tbc.tasks;"
        "heavy = {'mujoco', 'Box2D', 'pybullet', 'matplotlib', 'imageio', 'gymnasium_robotics'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip().endswith("[]")


@pytest.mark.parametrize(
    ("task", "module", "extra"),
    [("Platforms", "Box2D", "box2d"), ("Tennis2D", "Box2D", "box2d"), ("UR5ReacherBullet", "pybullet", "bullet")],
)
def test_missing_engine_names_the_extra(task, module, extra, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf"pip install 'sb3_tbc\[{extra}\]'"):
        gym.make(f"sb3_tbc/{task}-v0")


@all_ids
def test_vector_environments(task):
    if task in ENGINES:
        pytest.importorskip(ENGINES[task])
    envs = gym.make_vec(f"sb3_tbc/{task}-v0", num_envs=2, vectorization_mode="sync")
    observations, _ = envs.reset(seed=3)
    assert observations["observation"].shape == (2, *envs.single_observation_space["observation"].shape)
    rewards = envs.step(envs.action_space.sample())[1]
    assert rewards.shape == (2,)
    envs.close()
