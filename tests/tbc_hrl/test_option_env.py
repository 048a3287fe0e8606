"""Any algorithm as the high level: the task as its options see it, vectorised as SB3 wants it."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from corridor import Corridor
from gymnasium.spaces import Box
from sb3_contrib import TQC, CrossQ, RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_tbc import TBCHRL
from sb3_tbc.errors import ConfigError, EnvironmentFault, NonFiniteError
from sb3_tbc.export.policy import extract
from sb3_tbc.smdp.hindsight import HindsightSettings, high_level_steps
from sb3_tbc.tbc_hrl.collection import TwoLevelRunner
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.tbc_hrl.option_env import OptionEnv

SMALL = {"policy_kwargs": {"net_arch": [16, 16]}, "seed": 0}


@pytest.fixture(scope="module")
def agent() -> TBCHRL:
    return TBCHRL("MultiInputPolicy", Corridor(), max_options=5, compile=False, seed=0).learn(300)


def options(agent: TBCHRL, n: int = 2, **kwargs: Any) -> OptionEnv:
    return OptionEnv(make_vec_env(Corridor, n, seed=3), agent, **kwargs)


def test_a_step_is_an_option(agent: TBCHRL) -> None:
    env = options(agent)
    first = env.reset()
    assert first.shape == (2, *env.observation_space.shape)  # type: ignore[misc]
    actions = np.array([[0.0, -0.5], [0.0, 1.0]])
    observation, rewards, dones, infos = env.step(actions)
    assert rewards.dtype == np.float32
    assert dones.dtype == bool
    budgets = agent.rules.budget(actions[:, 1])
    for index in range(2):
        option = infos[index]["option"]
        assert option["duration"] == np.ceil(budgets[index])
        expected = agent.high_reward.window_rewards(
            -np.ones(option["duration"]), np.array([0]), np.array([option["duration"]])
        )[0]
        expected -= agent.high_reward.duration_cost * budgets[index] / agent.rules.dt_max
        if not dones[index]:
            assert rewards[index] == pytest.approx(expected, rel=1e-6)
            assert observation[index, 2] == option["duration"]  # the corridor shows its steps
        assert infos[index]["discount"] == pytest.approx(agent.high_reward.gamma_step ** option["duration"])


def test_episodes_end_as_the_agents_do_and_monitors_see_it(agent: TBCHRL) -> None:
    """Far-off goals: each episode uses up its five options, and every monitor counts all of its steps."""
    vec = make_vec_env(lambda: Corridor(goal=0.99), 2)
    env = VecMonitor(OptionEnv(vec, agent))
    env.reset()
    lengths = np.zeros(2, dtype=int)
    for step in range(1, 16):
        before = lengths.copy()
        observation, _, dones, infos = env.step(np.array([[-1.0, -0.6], [-1.0, 0.2]]))
        lengths += [info["option"]["duration"] for info in infos]
        assert (dones == (step % 5 == 0)).all()
        for index in np.flatnonzero(dones):
            info = infos[index]
            assert info["TimeLimit.truncated"]
            assert info["terminal_observation"][2] == lengths[index]
            assert info["episode"]["l"] == 5  # options, as the outer monitor counts
            assert observation[index, 2] == 0.0
        lengths[dones] = 0
        assert (before < 51).all()
    episodes = vec.env_method("get_episode_lengths")
    assert [len(each) for each in episodes] == [3, 3]


class Shifted(gym.ObservationWrapper[Any, Any, Any]):
    """Shows every position 0.3 to the right of where the task has it; the spaces stay."""

    def observation(self, observation: Any) -> Any:
        return {key: part + 0.3 * (np.arange(len(part)) == 0) for key, part in observation.items()}


def test_last_windows_end_by_what_the_agent_sees_not_the_task_beneath_a_wrapper() -> None:
    made = make_vec_env(lambda: Corridor(goal=5.0), 1, wrapper_class=Shifted, seed=0)
    agent = TBCHRL("MultiInputPolicy", made, max_options=1, dt_max=40.0, window_end="reached", compile=False, seed=0)
    venv = make_vec_env(lambda: Corridor(goal=5.0), 1, wrapper_class=Shifted, seed=0)
    env, rng, durations = OptionEnv(venv, agent), np.random.default_rng(0), []
    env.reset()
    for _ in range(60):
        _, _, dones, infos = env.step(np.array([[rng.uniform(-1, 1), 1.0]]))
        option = infos[0]["option"]
        assert dones[0]
        assert option["reason"] == ("reached" if option["duration"] < 40 else "expired")
        assert "episode" in infos[0]
        durations.append(option["duration"])
    assert min(durations) < max(durations) == 40
    assert len(venv.env_method("get_episode_lengths")[0]) == 60


def test_success_terminates(agent: TBCHRL) -> None:
    env = OptionEnv(DummyVecEnv([lambda: Corridor(goal=0.0)]), agent)
    env.reset()
    _, _, dones, infos = env.step(np.array([[0.0, 1.0]]))
    assert dones[0]
    assert not infos[0]["TimeLimit.truncated"]
    assert infos[0]["is_success"]
    assert infos[0]["option"]["reason"] == "episode_end"


def test_processes_give_what_one_process_gives(agent: TBCHRL) -> None:
    traces = []
    for kind in (DummyVecEnv, SubprocVecEnv):
        env = OptionEnv(make_vec_env(Corridor, 2, seed=5, vec_env_cls=kind), agent)
        rng = np.random.default_rng(0)
        trace = [env.reset()]
        trace += [part for _ in range(8) for part in env.step(rng.uniform(-1, 1, (2, 2)))[:3]]
        traces.append(np.concatenate([np.ravel(part) for part in trace]))
        env.close()
    np.testing.assert_array_equal(*traces)


def test_wrapped_vectors_are_refused(agent: TBCHRL) -> None:
    with pytest.raises(ValueError, match="past VecMonitor"):
        OptionEnv(VecMonitor(make_vec_env(Corridor, 1)), agent)


@pytest.mark.parametrize("algorithm", [PPO, SAC, TQC, CrossQ])
def test_any_algorithm_is_the_high_level(agent: TBCHRL, algorithm: Any) -> None:
    short = {"n_steps": 16, "batch_size": 16} if algorithm is PPO else {"learning_starts": 8, "batch_size": 8}
    high = algorithm("MlpPolicy", options(agent), **SMALL, **short).learn(40)
    together = TBCHRL.from_levels(high, agent)
    result = evaluate_agent(together, DummyVecEnv([Corridor]), 3, seed=0)
    assert len(result.successes) == 3
    observation, _ = Corridor().reset(seed=0)
    views = agent.policy.views
    batch = {key: np.asarray(part)[None] for key, part in observation.items()}
    _, state = together.predict(observation, deterministic=True)
    wanted, _ = high.predict(views.high(batch), deterministic=True)
    assert state is not None
    np.testing.assert_allclose(state[0][0], views.subgoals.unscale(wanted[0, :-1].astype(np.float32)), rtol=1e-4)
    for what in (lambda: together.learn(10), lambda: together.save("/tmp/never.zip")):
        with pytest.raises(ValueError, match="from_levels cannot"):
            what()
    assert agent.foreign_high is None
    if algorithm in (SAC, TQC):
        policy = extract(together, "corridor")
        assert policy.mean_bounds[0] == np.inf
        assert policy.high.weights[0].shape == (4, 16)
    else:
        with pytest.raises(ConfigError, match="cannot be exported as a high level"):
            extract(together, "corridor")


class Halving(BaseFeaturesExtractor):
    """Networks behind it see half of everything."""

    def __init__(self, space: Any) -> None:
        super().__init__(space, space.shape[0])

    def forward(self, seen: Any) -> Any:
        return seen / 2


def test_a_high_level_behind_an_extractor_is_not_exported(agent: TBCHRL) -> None:
    policy = {**SMALL["policy_kwargs"], "features_extractor_class": Halving}  # type: ignore[dict-item]
    high = SAC("MlpPolicy", options(agent), policy_kwargs=policy, seed=0)
    with pytest.raises(ConfigError, match="a high level behind Halving cannot be exported"):
        extract(TBCHRL.from_levels(high, agent), "corridor")


@pytest.mark.parametrize("duration", ["joint", "rule", "fixed"])
def test_it_pays_what_the_agent_learns_from(duration: str) -> None:
    """The agent's own transitions of an episode, without hindsight, beside the rewards of the same options here."""
    settings: dict[str, Any] = {"max_options": 5, "duration": duration, "duration_cost": 2.0, "testing_fraction": 0.0}
    agent = TBCHRL("MultiInputPolicy", Corridor(), compile=False, seed=0, **settings)
    venv = DummyVecEnv([lambda: Corridor(goal=0.99)])
    venv.seed(3)
    runner = TwoLevelRunner(venv, agent.policy, np.random.default_rng(0), deterministic=True)
    (episode,) = runner.run(1, lambda episode: episode)
    no_hindsight = HindsightSettings(0, "future", -10.0, True, tolerance=-1.0)
    learnt = high_level_steps(
        episode, agent.views, agent.rules, agent.high_reward, no_hindsight, runner.env.judge.goal_test,
        np.random.default_rng(0),
    ).rewards  # fmt: skip
    env = OptionEnv(DummyVecEnv([lambda: Corridor(goal=0.99)]), agent)
    env.seed(3)
    env.reset()
    width = agent.views.high_action_space().shape[0]
    paid = [env.step(option.unit_action[None, :width])[1][0] for option in episode.options]
    assert len(paid) == 5
    np.testing.assert_allclose(learnt[:5], paid, rtol=1e-5)


def test_levels_that_do_not_fit_are_refused(agent: TBCHRL) -> None:
    with pytest.raises(ValueError, match="train it in OptionEnv"):
        TBCHRL.from_levels(SAC("MlpPolicy", "Pendulum-v1", **SMALL), agent)


def test_it_can_be_copied_and_so_can_what_was_put_together(agent: TBCHRL) -> None:
    env = options(agent)
    env.reset()
    actions = np.zeros((2, 2))
    twin = copy.deepcopy(env)
    np.testing.assert_array_equal(env.step(actions)[0], twin.step(actions)[0])
    together = TBCHRL.from_levels(PPO("MlpPolicy", env, n_steps=8, batch_size=8), agent)
    seen = Corridor().reset(seed=0)[0]
    np.testing.assert_array_equal(
        copy.deepcopy(together).predict(seen, deterministic=True)[0], together.predict(seen, deterministic=True)[0]
    )


class Bad(Corridor):
    """Its third step is no number, or has no goal."""

    missing = False

    def step(self, action: Any) -> Any:
        observation, *rest = super().step(action)
        if self.steps == 3:
            observation["achieved_goal"] = observation["achieved_goal"] * np.nan
            if self.missing:
                del observation["achieved_goal"]
        return observation, *rest


@pytest.mark.parametrize(("missing", "words"), [(False, "is not finite"), (True, "got nothing")])
def test_nothing_wrong_gets_through(agent: TBCHRL, missing: bool, words: str) -> None:
    env = OptionEnv(DummyVecEnv([Bad]), agent)
    env.venv.set_attr("missing", missing)
    env.envs[0].unwrapped.missing = missing
    env.seed(3)  # a goal that the first three steps do not reach
    env.reset()
    with pytest.raises((NonFiniteError, EnvironmentFault), match=f"environment 0, step 3 of its option: .*{words}"):
        env.step(np.array([[0.0, 1.0]]))


class Wider(Corridor):
    """Its third step, or its second reset, shows a goal of shape (1, 1), which would fit by broadcasting."""

    at_reset = False

    def step(self, action: Any) -> Any:
        observation, *rest = super().step(action)
        if self.steps == 3 and not self.at_reset:
            observation["achieved_goal"] = observation["achieved_goal"].reshape(1, 1)
        return observation, *rest

    def reset(self, **kwargs: Any) -> Any:
        observation, info = super().reset(**kwargs)
        if self.at_reset and self.episode > 1:
            observation["achieved_goal"] = observation["achieved_goal"].reshape(1, 1)
        return observation, info


class WiderLater(Wider):
    at_reset = True


@pytest.mark.parametrize(
    ("task", "when"),
    [(Wider, "environment 0, step 3 of its option"), (WiderLater, "environment 0, reset")],
    ids=["step", "reset"],
)
def test_worker_processes_hand_on_nothing_of_another_shape(agent: TBCHRL, task: type[Corridor], when: str) -> None:
    env = OptionEnv(SubprocVecEnv([task, task]), agent)
    env.seed(3)
    try:
        env.reset()
        with pytest.raises(EnvironmentFault, match=rf"{when}: .*must have shape \(1,\).*got shape \(1, 1\)"):
            act(env)
    finally:
        env.close()


class BadReset(Corridor):
    """A later reset gives no number, or not the goal that its space has."""

    good, shape = 1, (1,)

    def reset(self, **kwargs: Any) -> Any:
        observation, info = super().reset(**kwargs)
        if self.episode > self.good:
            observation["desired_goal"] = np.full(self.shape, np.nan)
        return observation, info


def act(env: OptionEnv) -> None:
    for _ in range(6):
        env.step(np.ones((2, 2)))


@pytest.mark.parametrize("good", [0, 1])
@pytest.mark.parametrize(("shape", "words"), [((1,), "is not finite"), ((2,), "must have shape")])
def test_no_episode_begins_badly(agent: TBCHRL, good: int, shape: tuple[int, ...], words: str) -> None:
    env = OptionEnv(DummyVecEnv([Corridor, BadReset]), agent)
    env.venv.envs[1].unwrapped.good, env.venv.envs[1].unwrapped.shape = good, shape  # type: ignore[attr-defined]
    if good:
        env.reset()
    with pytest.raises((NonFiniteError, EnvironmentFault), match=f"environment 1, reset: .*desired_goal.*{words}"):
        act(env) if good else env.reset()


def test_options_that_are_none_are_refused(agent: TBCHRL) -> None:
    env = options(agent)
    env.reset()
    for given in (np.zeros((1, 1)), np.zeros((7, 2))):
        with pytest.raises(ValueError, match="options need unit actions"):
            env.step(given)
    with pytest.raises(NonFiniteError, match="the high level's subgoals and time budgets are not finite"):
        env.step(np.full((env.num_envs, 2), np.nan))


def test_what_does_not_fit_is_refused(agent: TBCHRL) -> None:
    high = PPO("MlpPolicy", VecNormalize(options(agent)), n_steps=8, batch_size=8)
    with pytest.raises(ValueError, match="trained behind VecNormalize"):
        TBCHRL.from_levels(high, agent)
    with pytest.raises(ValueError, match="low must be a TBCHRL"):
        TBCHRL.from_levels(agent, high)  # type: ignore[arg-type]
    for venv, given in ((Corridor(), agent), (make_vec_env(Corridor, 1), high)):
        with pytest.raises(ValueError, match="needs a vector of environments and a TBCHRL"):
            OptionEnv(venv, given)  # type: ignore[arg-type]
    remembering = RecurrentPPO("MlpLstmPolicy", options(agent), n_steps=8, batch_size=8)
    with pytest.raises(ValueError, match="RecurrentPPO remembers"):
        TBCHRL.from_levels(remembering, agent)
    other = make_vec_env(lambda: gym.wrappers.TransformAction(Corridor(), lambda a: a[:1], Box(-1, 1, (2,))), 1)
    with pytest.raises(ValueError, match="Action spaces do not match"):
        OptionEnv(other, agent)
