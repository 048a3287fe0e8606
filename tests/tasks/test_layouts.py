"""Agents and environments of different layouts: the error says which layout to use, and commands find it themselves."""

import gymnasium as gym
import numpy as np
import pytest
from making import make
from sb3_tbc.tasks import TASKS
from sb3_tbc.tasks.layouts import SIZES, layout_cure, layout_of

from sb3_tbc import TBCHRL
from sb3_tbc.evaluate import identify


@pytest.mark.parametrize("task", TASKS)
def test_sizes_are_the_tasks_own(task):
    for layout, size in SIZES[task].items():
        env = make(task, layout)
        assert env.observation_space["observation"].shape == (size,)
    assert layout_of(task, SIZES[task]["compact"]) in ("compact", "paper")
    assert layout_of(task, 1) is None


def test_nothing_is_said_where_nothing_is_known():
    assert layout_cure(5, 6) == ""
    assert layout_cure(29, 29) == ""
    assert 'observation="compact"' in layout_cure(29, 111)
    assert "Drawbridge" in layout_cure(85, 4)


@pytest.fixture(scope="module")
def agent(tmp_path_factory):
    model = TBCHRL("MultiInputPolicy", make("AntFourRooms", "compact"), compile=False, seed=0)
    path = tmp_path_factory.mktemp("agent") / "ant.zip"
    model.save(path)
    return model, path


def test_predict_says_what_it_expects_and_got(agent):
    model, _ = agent
    observation, _ = make("AntFourRooms").reset(seed=0)
    with pytest.raises(ValueError, match=r'\(29,\).*got \(111,\).*AntFourRooms.*observation="compact"'):
        model.predict(observation)
    right, _ = make("AntFourRooms", "compact").reset(seed=0)
    with pytest.raises(ValueError, match=r"desired_goal of shape \(3,\).*got \(2,\)"):
        model.predict({**right, "desired_goal": np.zeros(2)})
    model.predict(right)


def test_loading_into_another_layout_says_which_one_fits(agent):
    _, path = agent
    with pytest.raises(ValueError, match=r'29 entries, the environment gives 111.*observation="compact"'):
        TBCHRL.load(path, env=make("AntFourRooms"))
    with pytest.raises(ValueError, match="29 entries, the environment gives 3") as caught:
        TBCHRL.load(path, env=gym.make("sb3_tbc/Pendulum-v0"))
    assert "looks like" not in str(caught.value)
    TBCHRL.load(path, env=make("AntFourRooms", "compact"))


def test_commands_find_the_layout_of_an_agent_saved_from_python(agent):
    _, path = agent
    info = identify(path, "AntFourRooms")
    assert info["env_kwargs"] == {"observation": "compact"}
