"""Recurrent SAC: what it replays, that it acts as it trains, remembers, is saved, and refuses what it cannot do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from numpy.testing import assert_allclose, assert_array_equal
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_tbc import NDBCSAC
from sb3_tbc.errors import ConfigError, NonFiniteError
from sb3_tbc.recurrent.cells import CELLS
from sb3_tbc.recurrent.sequences import SequenceReplayBuffer, Sequences

SMALL: dict[str, Any] = {"inter": 4, "command": 4, "motor": 2, "recurrent_command_synapses": 2}


class Recall(gym.Env[Any, Any]):
    """A cue at the first step; the action of the last step is to equal it. Without memory the best return is -1."""

    observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)
    length = 3

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.time, self.cue = 0, self.np_random.choice([-1.0, 1.0])
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        over = self.time == self.length
        return self._seen(), -abs(float(action[0]) / 2 - self.cue) if over else 0.0, over, False, {}

    def _seen(self) -> Any:
        return np.array([0.0 if self.time else self.cue, self.time / self.length], dtype=np.float32)


class AsDict(gym.ObservationWrapper[Any, Any, Any]):
    """The same as a dictionary."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        box = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = spaces.Dict({"cue": box, "time": box})

    def observation(self, observation: Any) -> Any:
        return {"cue": observation[:1], "time": observation[1:]}


def make(cell: str = "gru", env: Any = None, **kwargs: Any) -> NDBCSAC:
    if cell in ("ltc", "cfc"):
        pytest.importorskip("ncps")
    policy = {"net_arch": [16], "cell": cell, "hidden_size": 8, "cell_kwargs": SMALL if cell == "ndbc" else {}}
    given: dict[str, Any] = {
        "batch_size": 4,
        "learning_starts": 10,
        "buffer_size": 200,
        "replay_buffer_kwargs": {"sequence_length": 6, "burn_in": 2},
        "policy_kwargs": policy,
        "seed": 0,
    }
    env = Recall() if env is None else env
    name = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    return NDBCSAC(name, env, **{**given, **kwargs})


@pytest.mark.parametrize("cell", sorted(CELLS))
def test_every_cell_learns_acts_and_is_saved(cell: str, tmp_path: Path) -> None:
    model = make(cell).learn(60)
    assert model._n_updates == 50
    model.save(tmp_path / "agent")
    loaded = NDBCSAC.load(tmp_path / "agent", env=Recall())
    assert isinstance(loaded.policy.actor.features_extractor.cell, CELLS[cell])
    state = other = None
    for observation in np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32):
        action, state = model.predict(observation, state, deterministic=True)
        again, other = loaded.predict(observation, other, deterministic=True)
        assert_array_equal(action, again)
        assert action.shape == (1,)
    loaded.learn(30, reset_num_timesteps=False)
    assert loaded.num_timesteps == 90


def test_memory_lasts_from_call_to_call_and_ends_with_the_episode() -> None:
    model = make().learn(20)
    last = np.array([0.3, 0.6], dtype=np.float32)
    first = [np.array([cue, 0.0], dtype=np.float32) for cue in (-1.0, 1.0)]
    states = [model.predict(cue, None, deterministic=True)[1] for cue in first]
    actions = [model.predict(last, state, deterministic=True)[0] for state in states]
    assert not np.allclose(*actions)
    fresh = [model.predict(last, state, np.array([True]), deterministic=True)[0] for state in states]
    assert_array_equal(*fresh)
    assert_array_equal(fresh[0], model.predict(last, None, deterministic=True)[0])
    several = tuple(np.concatenate(parts) for parts in zip(*states, strict=True))
    both, _ = model.predict(np.stack([last, last]), several, np.array([False, True]), deterministic=True)
    assert_allclose(both, np.stack([actions[0], fresh[1]]), atol=1e-6)
    with pytest.raises(ValueError, match="state is of 2 environments, the observation of 1"):
        model.predict(last, several)
    with pytest.raises(ValueError, match=r"episode_start has one entry for each of 2 environments, got shape \(1,\)"):
        model.predict(np.stack([last, last]), several, np.array([True]))


@pytest.mark.parametrize("cell", sorted(CELLS))
def test_a_sequence_is_remembered_as_it_was_lived(cell: str) -> None:
    """Unrolled in one go, with an episode's start in the middle, as acted step by step; and one step more."""
    model, rng = make(cell), np.random.default_rng(1)
    inputs = th.tensor(rng.uniform(-1, 1, (2, 5, 3)), dtype=th.float32)
    starts = th.tensor([[True, False, False, True, False], [False] * 5])
    memory = model.policy.actor.features_extractor
    state, expected = th.zeros(2, memory.cell.state_dim), []
    for t in range(5):
        state = memory.cell(inputs[:, t], state * ~starts[:, t, None])
        expected.append(memory.features(inputs[:, t], state))
    kept = th.ones(2, 5, dtype=th.bool)
    found = memory(Sequences(inputs, starts, kept))
    th.testing.assert_close(found, th.stack(expected, dim=1).flatten(0, 1), atol=1e-5, rtol=1e-4)
    last = kept.clone()
    last[:, :-1] = False
    later = th.tensor(rng.uniform(-1, 1, (2, 3)), dtype=th.float32)
    found = memory(Sequences(inputs, starts, last, later))
    th.testing.assert_close(found, memory.features(later, memory.cell(later, state)), atol=1e-5, rtol=1e-4)


def filled(steps: int, size: int = 60, n_envs: int = 2, burn_in: int = 2) -> SequenceReplayBuffer:
    """A buffer whose numbers tell where they come from: observation = step, action = step / 1000."""
    space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    buffer = SequenceReplayBuffer(
        size, space, spaces.Box(-1, 1, (1,), np.float32), "cpu", n_envs, sequence_length=6, burn_in=burn_in
    )
    for t in range(steps):
        numbers = np.full((n_envs, 1), float(t))
        ends = np.full(n_envs, t % 7 == 6)
        buffer.note_starts(np.full(n_envs, t % 7 == 0))
        infos = [{"TimeLimit.truncated": bool(t % 14 == 6)}] * n_envs
        buffer.add(numbers, numbers + 0.5, numbers / 1000, numbers[:, 0], ends, infos)
    return buffer


@pytest.mark.parametrize("steps", [3, 29, 30, 47, 100])
def test_sequences_are_pieces_of_what_happened(steps: int) -> None:
    np.random.seed(0)  # noqa: NPY002
    buffer = filled(steps)  # of 30 rows for each environment
    batch = buffer.sample(200)
    now, then = batch.observations, batch.next_observations
    assert isinstance(now, Sequences)
    assert isinstance(then, Sequences)
    time = now.inputs[..., 0]
    assert time.shape == (200, min(steps, 6))
    assert (time.diff(dim=1) == 1).all()
    assert time.min() >= max(0, steps - 30)
    assert time.max() == steps - 1
    assert_array_equal(now.starts, time % 7 == 0)
    before = th.where(now.starts, 0.0, (time - 1) / 1000)
    th.testing.assert_close(now.inputs[..., 1], before)
    begun = (time % 7 == 0).int().cummax(dim=1).values.bool()
    assert_array_equal(now.kept, begun | (th.arange(time.shape[1]) >= 2))
    learnt = time[now.kept]
    th.testing.assert_close(batch.rewards[:, 0], learnt)
    th.testing.assert_close(batch.actions[:, 0], learnt / 1000)
    assert then.later is not None
    th.testing.assert_close(then.later, th.stack((learnt + 0.5, learnt / 1000), dim=1))
    assert_array_equal(batch.dones[:, 0], learnt % 14 == 13)  # those of a time limit are no ends


def test_all_steps_are_drawn() -> None:
    np.random.seed(0)  # noqa: NPY002
    times = filled(100, burn_in=0).sample(2000).observations.inputs[..., 0]  # type: ignore[attr-defined]
    assert set(times.unique().tolist()) == set(range(71, 100))  # of the oldest row, the action before it is lost


def test_actions_before_are_known_in_a_larger_buffer_too(tmp_path: Path) -> None:
    np.random.seed(0)  # noqa: NPY002
    filled(47).save(tmp_path / "replay.npz")  # a full ring of steps 17 to 46
    larger = filled(0, size=100)
    larger.load(tmp_path / "replay.npz")
    now: Any = larger.sample(500).observations
    time = now.inputs[..., 0]
    assert time.min() == 18  # the action of step 16 is gone
    th.testing.assert_close(now.inputs[..., 1], th.where(now.starts, 0.0, (time - 1) / 1000))


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ((np.zeros((2, 8)), np.zeros((1, 1))), r"last action is of shape \(2, 1\) here, got \(1, 1\)"),
        ((np.zeros((2, 1)), np.zeros((2, 1))), r"memory is of shape \(2, 8\) here, got \(2, 1\)"),
        (np.zeros((2, 8, 1)), "what predict returned .*got ndarray"),
        ((np.zeros((2, 8)),), "what predict returned .*got tuple"),
    ],
)
def test_a_state_of_another_shape_is_refused(state: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make().predict(np.zeros((2, 2)), state, np.zeros(2, bool))


def test_a_buffer_emptied_within_an_episode_is_learnt_from() -> None:
    model = make().learn(20)  # episodes have three steps
    model.replay_buffer.reset()  # type: ignore[union-attr]
    model.learn(1, reset_num_timesteps=False)
    assert model._n_updates == 11
    now: Any = model.replay_buffer.sample(5).observations  # type: ignore[union-attr]
    assert now.inputs.shape == (5, 1, 3)
    assert not now.starts.any()
    assert not now.inputs[..., 2].any()  # the action before is gone


@pytest.mark.parametrize("n_envs", [1, 3])
def test_collection_notes_starts_and_actions(n_envs: int) -> None:
    env = make_vec_env(Recall, n_envs)
    model = make(env=env, action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)), learning_starts=6).learn(30)
    model.learn(10, reset_num_timesteps=False)
    model.learn(2 * n_envs)  # a new start of everything: an episode begins where none ended
    buffer: Any = model.replay_buffer
    rows = buffer.pos
    assert_array_equal(buffer.starts[:rows], buffer.observations[:rows, :, 1] == 0.0)
    assert_array_equal(buffer.dones[:rows, 0], np.isclose(buffer.next_observations[:rows, 0, 1], 1.0))
    assert model._state is not None
    assert_array_equal(model._state[1], buffer.actions[rows - 1])
    assert np.abs(buffer.actions[:rows]).max() <= 1.0


def test_pieces_of_learning_give_what_one_call_gives() -> None:
    whole, pieces = make().learn(45), make()
    for _ in range(9):
        pieces.learn(5, reset_num_timesteps=False)
    for name, value in whole.policy.state_dict().items():
        assert_array_equal(pieces.policy.state_dict()[name], value, err_msg=name)


def test_dictionaries_of_observations_are_joined(tmp_path: Path) -> None:
    model = make(env=AsDict(Recall())).learn(40)
    plain = make().learn(40)
    for name, value in plain.policy.state_dict().items():
        assert_array_equal(model.policy.state_dict()[name], value, err_msg=name)
    action, _ = model.predict({"cue": np.zeros(1), "time": np.zeros(1)}, deterministic=True)
    assert action.shape == (1,)
    with pytest.raises(ValueError, match="observation does not fit"):
        model.predict({"cue": np.zeros(1)})
    with pytest.raises(ValueError, match="observation does not fit"):
        plain.predict(np.zeros(4))
    with pytest.raises(ValueError, match=r"obs, info = env\.reset"):
        plain.predict((np.zeros(2), {}))


def test_tools_of_sb3_pass_the_state_on(tmp_path: Path) -> None:
    callback = EvalCallback(make_vec_env(Recall, 2), eval_freq=20, best_model_save_path=str(tmp_path), verbose=0)
    model = make(verbose=0).learn(40, callback=callback)
    assert (tmp_path / "best_model.zip").is_file()
    mean, _ = evaluate_policy(model, make_vec_env(Recall, 2, seed=1), 4)
    assert -2.0 <= float(np.mean(mean)) <= 0.0


def test_normalised_observations_are_normalised_when_replayed() -> None:
    env = VecNormalize(make_vec_env(Recall, 1))
    model = make(env=env).learn(40)
    assert np.isin(model.replay_buffer.observations[:40, 0, 0], [-1.0, 0.0, 1.0]).all()  # type: ignore[union-attr]
    seen = model.replay_buffer.sample(8, env=env).observations.inputs[..., :2]  # type: ignore[union-attr, attr-defined]
    assert not np.isin(seen[..., 0].numpy(), [-1.0, 0.0, 1.0]).any()
    with pytest.raises(ValueError, match="VecNormalize around a Box alone"):
        make(env=VecNormalize(DummyVecEnv([lambda: AsDict(Recall())]))).learn(10)


class Square(gym.ObservationWrapper[Any, Any, Any]):
    """The same as a matrix."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(-1.0, 1.0, (2, 1), np.float32)

    def observation(self, observation: Any) -> Any:
        return observation.reshape(2, 1)


def test_matrices_are_normalised_as_vectors_are() -> None:
    samples = []
    for wrapper in (None, Square):
        env = VecNormalize(make_vec_env(Recall, 2, seed=0, wrapper_class=wrapper))
        model = make(env=env).learn(60)
        np.random.seed(0)  # noqa: NPY002, as the buffer draws
        samples.append(model.replay_buffer.sample(8, env=env).observations.inputs)  # type: ignore[union-attr, attr-defined]
    th.testing.assert_close(samples[0], samples[1])


def test_an_adaptive_step_follows_the_weights(tmp_path: Path) -> None:
    circuit = {**SMALL, "synapses": "paper", "time_constants": None, "initial_gains": (1.0, 1.1)}
    circuit["adaptive_step"] = {"refresh_every": 5, "eta": 20.0}
    model = make("ndbc", policy_kwargs={"net_arch": [16], "cell": "ndbc", "hidden_size": 8, "cell_kwargs": circuit})
    net = model.actor.features_extractor.cell.net
    before = net.sub_steps
    with th.no_grad():
        net.cell.raw_conductance.add_(100.0)  # as long training might
    model.learn(20)
    assert net.updates == model._n_updates == 10
    assert net.sub_steps > before
    model.save(tmp_path / "agent.zip")
    assert NDBCSAC.load(tmp_path / "agent.zip").actor.features_extractor.cell.net.sub_steps == net.sub_steps


class Row(gym.ActionWrapper[Any, Any, Any]):
    """Its action is a matrix of one row."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.action_space = spaces.Box(-2.0, 2.0, (1, 2), np.float32)

    def action(self, action: Any) -> Any:
        return action[0, :1]


def test_noise_has_the_shape_of_the_actions() -> None:
    noise = NormalActionNoise(np.zeros((1, 2)), np.full((1, 2), 0.1))
    model = make(env=make_vec_env(Recall, 2, wrapper_class=Row), action_noise=noise).learn(40)
    assert model.predict(np.zeros((2, 2), np.float32))[0].shape == (2, 1, 2)


def test_replay_fills_a_buffer_of_just_its_size(tmp_path: Path) -> None:
    made = make(buffer_size=100).learn(60)
    made.save_replay_buffer(tmp_path / "replay.npz")
    made.save(tmp_path / "agent.zip")
    for size in (60, 61):
        loaded = NDBCSAC.load(tmp_path / "agent.zip", env=Recall(), buffer_size=size)
        loaded.load_replay_buffer(tmp_path / "replay.npz")
        buffer, before = loaded.replay_buffer, made.replay_buffer
        assert buffer is not None and before is not None  # noqa: PT018
        assert buffer.size() == 60
        assert_array_equal(buffer.observations[:60], before.observations[:60])


def test_the_replay_buffer_is_saved_as_plain_arrays(tmp_path: Path) -> None:
    model = make(buffer_size=30).learn(40)
    model.save_replay_buffer(tmp_path / "replay.npz")
    with np.load(tmp_path / "replay.npz", allow_pickle=False) as arrays:
        assert len(arrays["starts"]) == 30
    same, larger = make(buffer_size=30), make(buffer_size=50)
    for other in (same, larger):
        other.load_replay_buffer(tmp_path / "replay.npz")
        np.random.seed(0)  # noqa: NPY002
        expected = model.replay_buffer.sample(20)  # type: ignore[union-attr]
        assert other.replay_buffer.size() == 30  # type: ignore[union-attr]
        newest = (other.replay_buffer.pos - 1) % other.replay_buffer.buffer_size  # type: ignore[union-attr]
        assert_array_equal(
            other.replay_buffer.actions[newest],  # type: ignore[union-attr]
            model.replay_buffer.actions[model.replay_buffer.pos - 1],  # type: ignore[union-attr]
        )
    np.random.seed(0)  # noqa: NPY002
    found = same.replay_buffer.sample(20)  # type: ignore[union-attr]
    th.testing.assert_close(found.actions, expected.actions)
    with pytest.raises(ValueError, match="does not fit"):
        make(buffer_size=20).load_replay_buffer(tmp_path / "replay.npz")
    with pytest.raises(ValueError, match="does not fit"):
        make(env=make_vec_env(Recall, 2)).load_replay_buffer(tmp_path / "replay.npz")


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: make("lstm"), "cell must be one of 'ndbc', 'gru', 'ltc', 'cfc', got 'lstm'"),
        (lambda: make(policy_kwargs={"cell": "gru", "cell_kwargs": {"inter": 3}}), "do not fit the cell 'gru'"),
        (lambda: make(policy_kwargs={"cell_kwargs": {"intre": 3}}), "inter"),
        (lambda: make(use_sde=True), "has no use_sde"),
        (lambda: make(n_steps=3), "has no n_steps"),
        (lambda: make(optimize_memory_usage=True), "has no optimize_memory_usage"),
        (lambda: make(replay_buffer_class=HerReplayBuffer), "must be a SequenceReplayBuffer"),
        (lambda: make(replay_buffer_kwargs={"sequence_length": 4, "burn_in": 4}), "burn_in < sequence_length"),
        (lambda: make(buffer_size=5), "raise buffer_size"),
        (
            lambda: make(policy_kwargs={"share_features_extractor": True}),
            "leave policy_kwargs share",
        ),
        (
            lambda: make(policy_kwargs={"features_extractor_class": CombinedExtractor}),
            "class=.* out",
        ),
        (
            lambda: make(policy_kwargs={"features_extractor_kwargs": {"a": 1}}),
            "extractor_kwargs=.* out",
        ),
        (lambda: make(env=gym.make("FrozenLake-v1")), "Box|supported"),
        (lambda: make(env=_Picture()), "neither images nor discrete"),
    ],
)
def test_what_it_cannot_do_is_refused_in_one_line(build: Callable[[], Any], said: str) -> None:
    with pytest.raises((ValueError, AssertionError), match=said):
        build()


def test_loading_changes_what_the_constructor_takes(tmp_path: Path) -> None:
    make(action_noise=NormalActionNoise(np.zeros(1), np.ones(1))).save(tmp_path / "agent")
    sequences = {"sequence_length": 8, "burn_in": 1}
    changes = {"train_freq": 3, "gradient_steps": 2, "action_noise": None, "replay_buffer_kwargs": sequences}
    model = NDBCSAC.load(tmp_path / "agent", env=Recall(), use_sde=False, n_steps=1, trust=True, **changes)
    assert model.action_noise is None
    fixed = NDBCSAC.load(tmp_path / "agent", env=Recall(), trust=True, ent_coef=0.5).learn(12)
    assert (fixed.log_ent_coef, fixed.ent_coef_tensor.item()) == (None, 0.5)
    assert model.replay_buffer.sequence_length == 8  # type: ignore[union-attr]
    assert model.learn(30)._n_updates == 2 * 7  # after steps 12, 15, ..., 30
    for given, said in (
        ({"use_sde": True}, "has no use_sde"),
        ({"replay_buffer_class": None}, "must be a SequenceReplayBuffer"),
        ({"actor_learning_rate": 1.0}, "did you mean 'learning_rate'"),
        ({"ent_coef_learning_rate": 1.0}, "nothing that loading can change"),
        ({"average_decay": 0.5}, "nothing that loading can change"),
        ({"subgoals": 1}, "nothing that loading can change"),
        ({"gradient_ratio": 1.0}, "nothing that loading can change"),
    ):
        with pytest.raises(ValueError, match=said):
            NDBCSAC.load(tmp_path / "agent", env=Recall(), trust=True, **given)


class _Picture(Recall):
    observation_space = spaces.Box(0, 255, (3, 36, 36), np.uint8)


@pytest.mark.parametrize("cell", sorted(CELLS))
def test_what_is_learnt_reaches_back_through_the_sequence(cell: str) -> None:
    memory = make(cell).policy.actor.features_extractor
    inputs = th.rand(1, 5, 3, requires_grad=True)
    starts = th.tensor([[False, True, False, False, False]])
    kept = th.tensor([[False] * 4 + [True]])
    memory(Sequences(inputs, starts, kept))[:, :8].sum().backward()
    assert inputs.grad is not None
    reached = inputs.grad[0].abs().sum(dim=1) > 0
    assert reached.tolist() == [False, True, True, True, True]  # to the episode's start and no further


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["gru", "ndbc"])
def test_learns_what_needs_memory(cell: str) -> None:
    """Without memory the best return is -1; both ways of missing the cue cost the same."""
    model = make(cell, learning_rate=3e-3, train_freq=2, ent_coef=0.01, gamma=0.9, batch_size=32, buffer_size=5000)
    model.learn(3000)
    mean, _ = evaluate_policy(model, make_vec_env(Recall, 2, seed=1), 20)
    assert float(np.mean(mean)) > -0.3


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"batch_size": 0}, "batch_size must be a whole number from 1"),
        ({"gamma": 1.5}, "gamma must be a number from 0 to 1, got 1.5"),
        ({"gamma": np.nan}, "gamma must"),
        ({"tau": 2}, "tau must be a number above 0 and at most 1"),
        ({"ent_coef": -1}, "ent_coef must"),
        ({"learning_rate": "x"}, "learning_rate must be a number"),
        ({"target_update_interval": 0}, "target_update_interval must"),
        ({"gradient_steps": 1.5}, "gradient_steps must"),
        ({"seed": -1}, "seed must"),
        ({"policy_kwargs": {"hidden_size": 0}}, "policy_kwargs.hidden_size must"),
        ({"policy_kwargs": {"n_critics": 0}}, "policy_kwargs.n_critics must"),
        (
            {"replay_buffer_kwargs": {"sequence_length": 8.5}},
            "burn_in and sequence_length are whole numbers, got 8 and 8.5",
        ),
    ],
)
def test_values_that_sb3_takes_without_a_word_are_refused(given: dict[str, Any], said: str) -> None:
    """Of an empty batch, or a discount above one, nothing is learnt; SB3 looks at neither."""
    with pytest.raises(ConfigError, match=said):
        NDBCSAC("MlpPolicy", Recall(), **{"buffer_size": 100, **given})


def test_a_schedule_and_numbers_of_numpy_are_taken() -> None:
    NDBCSAC("MlpPolicy", Recall(), lambda left: 1e-3 * left, buffer_size=np.int64(100), gamma=np.float32(0.9))


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (spaces.Box(-3, 3, (1,), np.int32), "its actions must be real numbers"),
        (spaces.Box(-np.inf, np.inf, (1,), np.float32), "its action bounds must be finite"),
        (spaces.Box(1.0, 1.0, (1,), np.float32), "its lowest actions must be below its highest"),
    ],
)
def test_actions_that_a_squashed_gaussian_cannot_give_are_refused(space: spaces.Box, said: str) -> None:
    env = Recall()
    env.action_space = space
    with pytest.raises(ConfigError, match=f"NDBCSAC cannot act in this environment: {said}"):
        NDBCSAC("MlpPolicy", env, buffer_size=100)


@pytest.mark.parametrize(
    ("noise", "error", "said"),
    [
        (NormalActionNoise(np.zeros(3), np.ones(3)), ConfigError, "action_noise must give 1 numbers, .* got 3"),
        (NormalActionNoise(np.zeros(1), np.full(1, np.nan)), NonFiniteError, "its action noise is not finite"),
    ],
)
def test_noise_that_does_not_fit_is_called_by_its_name(noise: Any, error: type[Exception], said: str) -> None:
    model = NDBCSAC("MlpPolicy", Recall(), buffer_size=100, action_noise=noise)
    with pytest.raises(error, match=said):
        model.learn(1)


def test_a_state_that_is_not_finite_is_named_unless_an_episode_begins() -> None:
    model = NDBCSAC("MlpPolicy", Recall(), buffer_size=100, seed=0)
    seen = np.zeros((2, 2), np.float32)
    _, (memory, last_action) = model.policy.predict(seen)
    broken = memory.copy()
    broken[1] = np.nan
    for state, what in (((broken, last_action), "memory"), ((memory, last_action * np.inf), "last action")):
        with pytest.raises(NonFiniteError, match=f"environment [01]: its {what} is not finite"):
            model.predict(seen, state)
    assert np.isfinite(model.predict(seen, (broken, last_action), np.array([False, True]))[0]).all()
