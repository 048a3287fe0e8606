"""From names to environments: ids of other packages, given subgoals, errors in one line."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_tbc.errors import ConfigError
from sb3_tbc.zoo.config import load_config, parse_overrides
from sb3_tbc.zoo.environments import make_envs, resolve_env

MAZE = "gymnasium_robotics:PointMaze_UMaze-v3"


class Broken(gym.Env[Any, Any]):
    """Fails while it is made, as foreign code may."""

    def __init__(self, error: Exception | None = None) -> None:
        assert error is not None
        raise error


@pytest.fixture
def broken_id() -> Any:
    gym.register("Broken-v0", Broken)
    yield "Broken-v0"
    del gym.registry["Broken-v0"]


def test_ids_of_gymnasium_robotics_need_no_module() -> None:
    assert resolve_env("PointMaze_UMaze-v3") == ("PointMaze_UMaze-v3", MAZE)
    assert resolve_env(MAZE) == ("PointMaze_UMaze-v3", MAZE)
    assert resolve_env("FetchReach-v4") == ("FetchReach-v4", "gymnasium_robotics:FetchReach-v4")
    assert resolve_env("Pendulum") == ("Pendulum", "sb3_tbc/Pendulum-v0")
    assert resolve_env("CartPole-v1") == ("CartPole-v1", "CartPole-v1")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("PointMaze_UMase-v3", "did you mean 'PointMaze_UMaze-v3'"),
        ("Pendulun", "did you mean 'Pendulum'"),
        ("PandaReach-v3", "panda_gym:PandaReach-v3"),
        ("parking-v0", "highway_env:parking-v0"),
        ("no_such_module:Env-v0", "cannot import module 'no_such_module'"),
    ],
)
def test_unknown_names(name: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(gym.registry, name, raising=False)  # another test may have imported its package
    with pytest.raises(ConfigError, match=message):
        resolve_env(name)


def test_what_to_install_without_gymnasium_robotics(monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_tbc.zoo import environments

    known = {i: s for i, s in gym.registry.items() if not i.startswith(("Fetch", "PointMaze", "AntMaze"))}
    monkeypatch.setattr(environments.gym, "registry", known)
    monkeypatch.setattr(environments, "home_of", lambda env_id: None)
    with pytest.raises(ConfigError, match="pip install gymnasium-robotics"):
        resolve_env("FetchReach-v4")


class Nested(gym.Env[Any, Any]):
    """Goals are dictionaries, as in FrankaKitchen."""

    inner = gym.spaces.Dict({"kettle": gym.spaces.Box(-1, 1, (2,))})
    observation_space = gym.spaces.Dict(
        {"observation": gym.spaces.Box(-1, 1, (2,)), "achieved_goal": inner, "desired_goal": inner}
    )
    action_space = gym.spaces.Box(-1, 1, (1,))


def test_spaces_within_spaces_are_refused_before_a_vector_is_made_of_them() -> None:
    gym.register("Nested-v0", Nested)
    try:
        with pytest.raises(
            ConfigError, match=r"'Nested-v0' cannot be used: its observation\['achieved_goal'\] must be"
        ):
            make_envs("Nested-v0", 1, 0)
    finally:
        del gym.registry["Nested-v0"]


def test_errors_of_an_environment_take_one_line(broken_id: str) -> None:
    with pytest.raises(ConfigError, match=r"AssertionError in test_environments.py, line \d+: assert"):
        make_envs(broken_id, 1, 0)
    with pytest.raises(ConfigError, match=r"with \{'error'.*RuntimeError in test_environments.py.*: no luck"):
        make_envs(broken_id, 1, 0, {"error": RuntimeError("no luck")})
    with pytest.raises(ConfigError, match=r"'Broken-v0' with .*: wrong$"):
        make_envs(broken_id, 1, 0, {"error": ValueError("wrong")})


def test_subgoals_of_the_configuration_reach_the_environment() -> None:
    items = ["subgoals.low:[-1, -2]", "subgoals.high:[1, 2]", "subgoals.thresholds:0.3", "subgoals.names:[x, y]"]
    run = load_config("tbc-hrl", "PointMaze_UMaze-v3", overrides=parse_overrides([*items, "subgoals.n_probe_steps:99"]))
    assert "subgoals" not in run.model
    env = make_envs(MAZE, 1, 0, run.env_kwargs)
    subgoals = env.get_attr("subgoals")[0]
    np.testing.assert_array_equal(subgoals.low, [-1, -2])
    np.testing.assert_array_equal(subgoals.high, [1, 2])
    np.testing.assert_array_equal(subgoals.thresholds, [0.3])
    assert (subgoals.groups, subgoals.names) == (((0, 1),), ("x", "y"))


def test_random_episodes_run_once_for_environments_made_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_tbc.tasks import generic

    asked = []
    probe = generic.run_probe
    monkeypatch.setattr(generic, "run_probe", lambda *args: asked.append(args[1:]) or probe(*args))
    given = {"n_probe_steps": 31}
    make_envs(MAZE, 3, 0, {"subgoals": given}).close()
    make_envs(MAZE, 2, 9, {"subgoals": given}).close()
    assert len(asked) == 1
    make_envs(MAZE, 1, 0, {"subgoals": given, "max_episode_steps": 77}).close()
    make_envs(MAZE, 1, 0, {"subgoals": {**given, "low": [-9.0, -9.0]}}).close()
    assert len(asked) == 3


def test_a_missing_time_limit_is_cured_from_the_command_line() -> None:
    override = parse_overrides(["env_kwargs.max_episode_steps:40"])
    with pytest.raises(ConfigError, match=r"no time limit.*--hyperparams env_kwargs.max_episode_steps:N"):
        make_envs(MAZE, 1, 0, {"max_episode_steps": -1})
    env = make_envs(MAZE, 1, 0, load_config("tbc-hrl", "PointMaze_UMaze-v3", overrides=override).env_kwargs)
    assert env.get_attr("max_episode_steps") == [40]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"low": [-1.0], "high": [1.0]}, "shape of achieved_goal"),
        ({"low": [2.0, 2.0], "high": [1.0, 1.0]}, "low < high"),
        ({"thresholds": [0.1, 0.1, 0.1]}, "one positive threshold"),
        ({"thresholds": -1.0}, "one positive threshold"),
    ],
)
def test_subgoals_that_do_not_fit(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_envs(MAZE, 1, 0, {"subgoals": {"n_probe_steps": 10, **given}})


def test_a_task_keeps_its_own_subgoals() -> None:
    with pytest.raises(ConfigError, match="defines its own subgoal space"):
        make_envs("sb3_tbc/Pendulum-v0", 1, 0, {"subgoals": {"thresholds": 0.1}})


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ("subgoals.treshold:1", "unknown setting 'subgoals.treshold'; did you mean 'thresholds'"),
        ("subgoals.low:1", r"subgoals.low must be a list .* or null, got 1"),
        ("subgoals.low:[a]", r"subgoals.low must be a list \(each entry a number\) .* got \['a'\]"),
        ("subgoals.high:[.inf]", r"subgoals.high must be a list .* got \[inf\]"),
        ("subgoals.high:[]", r"subgoals.high must be a list .* got \[\]"),
        ("subgoals.thresholds:x", "subgoals.thresholds must be a number or a list"),
        ("subgoals:3", "subgoals must be a section with some of the keys low, high"),
    ],
)
def test_subgoals_are_checked_as_they_are_read(item: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_overrides([item])
