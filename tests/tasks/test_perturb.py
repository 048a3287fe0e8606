"""Stress variants: off by default, seeded, and each disturbs what it says."""

import numpy as np
import pytest
from making import make
from sb3_tbc.tasks.perturb import Perturb

SIX = ["AntFourRooms", "Drawbridge", "Pendulum", "Platforms", "Tennis2D", "UR5Reacher"]


def trace(env, n=20, seed=0, action_seed=0):
    rng = np.random.default_rng(action_seed)
    actions = rng.uniform(env.action_space.low, env.action_space.high, (n, *env.action_space.shape))
    seen = [env.reset(seed=seed)[0]]
    for action in actions:
        seen.append(env.step(action)[0])
    return seen


def stack(seen, key="observation"):
    return np.stack([observation[key] for observation in seen])


def test_off_by_default():
    for perturb in (None, {}):
        assert not isinstance(make("Pendulum", perturb=perturb), Perturb)


@pytest.mark.parametrize("task", SIX)
def test_neutral_perturbation_changes_nothing(task):
    names = make(task).unwrapped.dynamics_names
    neutral = {"observation_noise": 0.0, "action_delay": 0, "dynamics_scale": dict.fromkeys(names, 1.0)}
    np.testing.assert_array_equal(stack(trace(make(task, perturb=neutral))), stack(trace(make(task))))


@pytest.mark.parametrize("task", SIX)
def test_seeded(task):
    perturb = {
        "observation_noise": 0.05,
        "action_delay": 2,
        "dynamics_scale": {"actuator": [0.5, 1.5]},
        "goal_switch": 0.0 if task == "Drawbridge" else 0.3,
    }
    env = make(task, perturb=perturb)
    one, other = trace(env), trace(make(task, perturb=perturb))
    for key in one[0]:
        np.testing.assert_array_equal(stack(one, key), stack(other, key))
        np.testing.assert_array_equal(stack(one, key), stack(trace(env), key))  # nothing stays from the episode before
    assert not np.array_equal(stack(one), stack(trace(env, seed=1)))
    assert env.spec.id == f"sb3_tbc/{task}-v0"
    assert env.unwrapped.subgoals.dim > 0


def test_noise_has_the_stated_size_and_spares_goals():
    seen, clean = trace(make("UR5Reacher", perturb={"observation_noise": 0.1}), 200), trace(make("UR5Reacher"), 200)
    noise = (stack(seen) - stack(clean)) / make("UR5Reacher").unwrapped.observation_scale
    assert abs(noise[:, -6:].std() - 0.1) < 0.01
    np.testing.assert_array_equal(noise[20, :-6], noise[19, 6:])  # a frame keeps its noise
    np.testing.assert_array_equal(stack(seen, "achieved_goal"), stack(clean, "achieved_goal"))


def test_delay_shifts_actions():
    late, prompt = make("Drawbridge", perturb={"action_delay": 3}), make("Drawbridge")
    late.reset()
    prompt.reset()
    for action in (0.0, 0.0, 0.0):
        prompt.step(np.array([action]))
    for action in (1.0, -0.5, 0.3):
        late.step(np.array([action]))
    for action in (1.0, -0.5, 0.3):
        seen, expected = late.step(np.zeros(1)), prompt.step(np.array([action]))
        np.testing.assert_array_equal(seen[0]["observation"], expected[0]["observation"])
    with pytest.raises(ValueError, match="finite"):
        late.step(np.array([np.nan]))


@pytest.mark.parametrize("task", SIX)
def test_every_named_quantity_matters(task):
    plain = stack(trace(make(task), 60))
    for name in make(task).unwrapped.dynamics_names:
        if (task, name) in {("Drawbridge", "bridge"), ("UR5Reacher", "friction"), ("AntFourRooms", "friction")}:
            continue  # later in the episode, or on contact
        changed = stack(trace(make(task, perturb={"dynamics_scale": {name: 1.4}}), 60))
        assert not np.array_equal(plain, changed), name
        assert np.isfinite(changed).all()


def test_scaled_pendulum_follows_its_equation():
    """Falling from the horizontal, twice the mass under half gravity accelerates half as fast."""
    start = {"state": {"qpos": [np.pi / 2], "qvel": [0.0]}}
    speeds = []
    for scale in ({"damping": 1e-9}, {"damping": 1e-9, "mass": 2.0, "gravity": 0.5}):
        env = make("Pendulum", perturb={"dynamics_scale": scale})
        env.reset(options=start)
        speeds.append(env.unwrapped.task_state()["qvel"][0])
    assert speeds[1] == pytest.approx(speeds[0] / 2, rel=1e-6)


def test_goals_switch_consistently():
    env = make("Pendulum", perturb={"goal_switch": 0.5})
    env.reset(seed=0)
    goals = []
    for _ in range(40):
        observation, reward, terminated, _, info = env.step(env.action_space.sample())
        goals.append(observation["desired_goal"])
        assert reward == env.unwrapped.compute_reward(observation["achieved_goal"], goals[-1], info)
        assert terminated == info["is_success"]
    assert 8 < len(np.unique(goals, axis=0)) < 35


@pytest.mark.parametrize(
    ("task", "perturb", "word"),
    [
        ("Pendulum", {"noise": 0.1}, "observation_noise"),
        ("Pendulum", {"observation_noise": -1.0}, "observation_noise"),
        ("Pendulum", {"observation_noise": np.nan}, "observation_noise"),
        ("Pendulum", {"action_delay": 1.5}, "whole number"),
        ("Pendulum", {"action_delay": 1000}, "from 0 to 999, .* got 1000"),
        ("Pendulum", {"goal_switch": 2.0}, "goal_switch"),
        ("Pendulum", {"dynamics_scale": {"colour": 1.0}}, "mass"),
        ("Pendulum", {"dynamics_scale": {"mass": [2.0, 1.0]}}, "range"),
        ("Pendulum", {"dynamics_scale": {"mass": 0.0}}, "positive"),
        ("Pendulum", {"dynamics_scale": {"mass": True}}, "positive"),
        ("Pendulum", {"observation_noise": True}, "observation_noise"),
        ("Pendulum", {"action_delay": True}, "whole number"),
        ("Drawbridge", {"goal_switch": 0.1}, "always the same"),
    ],
)
def test_mistakes_are_explained(task, perturb, word):
    with pytest.raises(ValueError, match=word):
        make(task, perturb=perturb)


def test_values_of_another_kind_are_explained():
    with pytest.raises(TypeError, match=r"dynamics_scale must map names of \['mass', .*got 1.2"):
        make("Pendulum", perturb={"dynamics_scale": 1.2})
    with pytest.raises(ValueError, match=r"hide_velocities must be true or false, got 'no'"):
        make("Pendulum", perturb={"hide_velocities": "no"})


def test_numbers_of_numpy_are_numbers():
    one = {"observation_noise": np.float32(0.5), "dynamics_scale": {"mass": np.float32(2.0), "gravity": np.ones(2)}}
    other = {"observation_noise": 0.5, "dynamics_scale": {"mass": 2.0, "gravity": [1.0, 1.0]}}
    np.testing.assert_array_equal(*(stack(trace(make("Pendulum", perturb=p))) for p in (one, other)))


@pytest.mark.parametrize("layout", ["paper", "compact"])
@pytest.mark.parametrize("task", ["Pendulum", "UR5Reacher", "UR5ReacherBullet"])
def test_hidden_velocities_show_nowhere_and_rewards_stay(task, layout):
    hidden = make(task, layout, perturb={"hide_velocities": True, "observation_noise": 0.1})
    plain = make(task, layout, perturb={"observation_noise": 0.1})
    seen, whole = trace(hidden, 40), trace(plain, 40)
    shown = stack(seen)
    frames = shown.reshape(len(shown), -1, hidden.unwrapped.frame_dim)
    moving = list(hidden.unwrapped.velocity_entries)
    assert not frames[..., moving].any()
    still = [i for i in range(frames.shape[-1]) if i not in moving]
    others = stack(whole).reshape(frames.shape)[..., still]
    np.testing.assert_array_equal(frames[..., still], others)
    np.testing.assert_array_equal(stack(seen, "achieved_goal"), stack(whole, "achieved_goal"))
    subgoals = hidden.get_wrapper_attr("subgoals")
    batch = {key: stack(seen, key) for key in seen[0]}
    assert subgoals.local(batch).shape == (41, subgoals.local_dim)
    assert subgoals.local_dim == hidden.unwrapped.subgoals.local_dim - len(moving)
    np.testing.assert_array_equal(subgoals.achieved(batch), batch["achieved_goal"])


def test_velocities_cannot_be_hidden_everywhere():
    with pytest.raises(ValueError, match="hide_velocities must be false for Drawbridge"):
        make("Drawbridge", perturb={"hide_velocities": True})


def test_an_agent_learns_without_velocities():
    from sb3_tbc import TBCHRL

    env = make("Pendulum", perturb={"hide_velocities": True}, max_episode_steps=60)
    model = TBCHRL("MultiInputPolicy", env, max_options=4, memory="episode", compile=False, seed=0)
    assert model.subgoals.local_dim == 2
    model.learn(130)
