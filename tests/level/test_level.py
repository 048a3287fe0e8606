"""One level: acting in NumPy, saving and loading, guards."""

import copy
import pickle
import time
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_tbc.errors import HierarchyError, NonFiniteError
from sb3_tbc.level.level import SACLevel
from sb3_tbc.replay.batch import LevelBatch

OBSERVATIONS = spaces.Box(-np.inf, np.inf, (6,), np.float32)
ACTIONS = spaces.Box(-1.0, 1.0, (3,), np.float32)
NDBC = {"inter": 6, "command": 5, "motor": 3, "sensory_fanout": 3, "inter_fanout": 3,
        "recurrent_command_synapses": 4, "motor_fanin": 3, "sub_steps": 2}  # fmt: skip
GRU = {"hidden_size": 5, "input_scale": [2.0] * 6}
ACTORS = pytest.mark.parametrize("actor", [{}, {"ndbc": NDBC}, {"gru": GRU}], ids=["mlp", "ndbc", "gru"])


class RandomBuffer:
    def __init__(self, state_dim: int, seed: int = 0) -> None:
        self.state_dim = state_dim
        self.generator = th.Generator().manual_seed(seed)

    def sample_burst(self, gradient_steps: int, batch_size: int) -> LevelBatch:
        def draw(width: int) -> th.Tensor:
            return th.randn(gradient_steps, batch_size, width, generator=self.generator)

        dones, discounts = (draw(1) > 1).float(), th.full((gradient_steps, batch_size, 1), 0.97)
        states = (0.3 * draw(self.state_dim), 0.3 * draw(self.state_dim))
        return LevelBatch(draw(6), th.tanh(draw(3)), draw(6), draw(1), dones, discounts, *states, draw(0))


def make_level(actor: dict | None = None, **kwargs: object) -> SACLevel:
    policy_kwargs = {"net_arch": [8, 7], "mean_bound": 3.0, **(actor or {}), **kwargs.pop("policy_kwargs", {})}
    arguments = {"seed": 1, "compile": False, "learning_rate": 1e-2, "name": "low", **kwargs}
    level = SACLevel(OBSERVATIONS, ACTIONS, policy_kwargs=policy_kwargs, **arguments)
    level.replay_buffer = RandomBuffer(level.state_dim)
    return level


def inputs(level: SACLevel, n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    obs = rng.standard_normal((n, 6), dtype=np.float32)
    return obs, 0.3 * rng.standard_normal((n, level.state_dim), dtype=np.float32)


@ACTORS
@pytest.mark.parametrize("average", [False, True])
def test_act_is_the_actor(actor: dict, average: bool) -> None:
    level = make_level(actor)
    obs, states = inputs(level)
    for _ in range(2):
        level.train(3, 16)
        actions, next_states = level.acting.act(obs, states, True, np.random.default_rng(0), average)
        torch_actor = level.policy.average_actor if average else level.actor
        mean, _, expected = torch_actor.step(th.from_numpy(obs), th.from_numpy(states))
        assert np.allclose(actions, mean.tanh().detach().numpy(), atol=1e-6)
        assert np.allclose(next_states, expected.detach().numpy(), atol=1e-6)
        assert actions.dtype == next_states.dtype == np.float32


@pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh, nn.SiLU, nn.ELU])
def test_act_samples_the_squashed_gaussian(activation: type[nn.Module]) -> None:
    level = make_level(policy_kwargs={"activation_fn": activation, "net_arch": [8], "log_std_bounds": (-1.0, -0.5)})
    obs, states = inputs(level)
    actions, _ = level.acting.act(obs, states, False, np.random.default_rng(5))
    noise = np.random.default_rng(5).standard_normal((4, 3), dtype=np.float32)
    mean, log_std, _ = level.actor.step(th.from_numpy(obs), th.from_numpy(states))
    assert np.allclose(actions, (mean + log_std.exp() * th.from_numpy(noise)).tanh().detach().numpy(), atol=1e-6)


def test_act_without_noise_where_a_mask_says_so() -> None:
    level = make_level()
    obs, states = inputs(level)
    mask = np.array([True, False, True, False])
    mixed, surely, sampled = (
        level.acting.act(obs, states, d, np.random.default_rng(5))[0] for d in (mask, True, False)
    )
    np.testing.assert_array_equal(mixed, np.where(mask[:, None], surely, sampled))
    assert not np.isclose(surely, sampled).any()


def test_activation_without_numpy_form() -> None:
    with pytest.raises(ValueError, match="activation_fn must be one of"):
        make_level(policy_kwargs={"activation_fn": nn.Softplus})


@ACTORS
def test_parameters_return_in_place(actor: dict, tmp_path) -> None:
    """Loading restores weights, moments and step count in place: training goes on as if nothing had happened."""
    level, other = make_level(actor), make_level(actor, seed=2)
    level.train(5, 16)
    level.save(tmp_path / "level.zip")
    other.acting.act(*inputs(other), True, np.random.default_rng(0))
    other.set_parameters(tmp_path / "level.zip")
    other.log_ent_coef.data = load_from_zip_file(tmp_path / "level.zip")[2]["log_ent_coef"].data
    assert all(f.is_aliased() for f in (other._update.actor, other._update.critic, other._update.average))
    for trained in (level, other):
        trained.replay_buffer = RandomBuffer(level.state_dim, seed=7)
        trained.noise_rng = np.random.default_rng(7)
    for _ in range(2):
        ours, theirs = (x.acting.act(*inputs(x), True, np.random.default_rng(0))[0] for x in (level, other))
        assert np.array_equal(ours, theirs)
        level.train(4, 16)
        other.train(4, 16)
    assert level.get_parameters().keys() >= {"policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer"}
    for (name, ours), theirs in zip(level.policy.state_dict().items(), other.policy.state_dict().values(), strict=True):
        assert th.equal(ours, theirs), name


def test_loading_the_policy_alone_is_seen_by_act() -> None:
    level, other = make_level({"ndbc": NDBC}), make_level({"ndbc": NDBC}, seed=2)
    args = (*inputs(level), True, np.random.default_rng(0))
    assert not np.allclose(level.acting.act(*args)[0], other.acting.act(*args)[0])
    other.policy.load_state_dict(level.policy.state_dict())
    assert np.array_equal(level.acting.act(*args)[0], other.acting.act(*args)[0])


def test_step_size_rule_reaches_acting_and_updates() -> None:
    level = make_level({"ndbc": {**NDBC, "adaptive_step": {"refresh_every": 4, "eta": 1e-3}}})
    level.actor.net.sub_steps = level.policy.average_actor.net.sub_steps = 3
    level.train(2, 16)
    assert set(level._update._steps) == {(16, 3)}
    level.train(2, 16)  # the rule is asked every 4 updates; so small an eta asks for K_max
    level.train(2, 16)
    assert set(level._update._steps) == {(16, 3), (16, 6)}
    assert level.policy.average_actor.sub_steps == 6
    obs, states = inputs(level)
    mean, _, _ = level.actor.step(th.from_numpy(obs), th.from_numpy(states))
    assert np.allclose(
        level.acting.act(obs, states, True, np.random.default_rng(0))[0], mean.tanh().detach(), atol=1e-6
    )


def test_same_seed_same_weights() -> None:
    levels = [make_level({"ndbc": NDBC}), make_level({"ndbc": NDBC})]
    for level in levels:
        level.train(20, 16)
    assert th.equal(levels[0]._update.actor.vector, levels[1]._update.actor.vector)


def test_bursts_of_any_length_are_the_same_updates() -> None:
    once, parts = make_level(), make_level()

    class Replay(RandomBuffer):
        def sample_burst(self, gradient_steps: int, batch_size: int) -> LevelBatch:
            singles = [super(Replay, self).sample_burst(1, batch_size) for _ in range(gradient_steps)]
            return LevelBatch(*(th.cat(x) for x in zip(*singles, strict=True)))

    once.replay_buffer, parts.replay_buffer = Replay(0), Replay(0)
    once.train(140, 16)
    for n in (1, 9, 130):
        parts.train(n, 16)
    assert th.equal(once._update.actor.vector, parts._update.actor.vector)
    assert once._n_updates == parts._n_updates == 140


def test_non_finite_is_named() -> None:
    level = make_level()
    level.train(1, 16)
    with th.no_grad():
        level.critic.qf1[2].bias[0] = np.nan
    with pytest.raises(NonFiniteError, match=r"low\.critic\.qf\d.* update 2"):
        level.train(1, 16)


def test_train_needs_a_buffer() -> None:
    level = make_level()
    level.replay_buffer = None
    with pytest.raises(HierarchyError, match="low has no replay buffer"):
        level.train(1, 16)
    with pytest.raises(HierarchyError, match="no environment"):
        level.learn(10)


def test_fixed_temperature_and_own_temperature_rate() -> None:
    fixed = make_level(ent_coef=0.3)
    fixed.train(3, 16)
    assert fixed.logger.name_to_value["low/ent_coef"] == pytest.approx(0.3)
    still = make_level(ent_coef="auto_0.5", ent_coef_learning_rate=0.0)
    still.train(3, 16)
    assert still.log_ent_coef.item() == pytest.approx(np.log(0.5))


def test_what_is_compiled_is_not_pickled() -> None:
    level = make_level()
    level.train(1, 16)
    level._update._steps[16, 0] = lambda *args: None
    assert pickle.loads(pickle.dumps(level._update.__getstate__()["_steps"])) == {}


def test_the_actor_has_a_learning_rate_of_its_own() -> None:
    level = make_level({"ndbc": NDBC}, actor_learning_rate=0.0)
    actor, critic = (copy.deepcopy(part.state_dict()) for part in (level.policy.actor, level.policy.critic))
    level.train(2, 16)
    assert all(th.equal(value, actor[name]) for name, value in level.policy.actor.state_dict().items())
    assert any(not th.equal(value, critic[name]) for name, value in level.policy.critic.state_dict().items())
    assert level.logger.name_to_value["low/actor_learning_rate"] == 0.0
    falling = make_level(actor_learning_rate=LinearSchedule(0.5, 0.0, 1.0))
    falling._current_progress_remaining = 0.5
    falling.train(1, 16)
    assert falling.policy.actor.optimizer.param_groups[0]["lr"] == pytest.approx(0.25)
    assert falling.policy.critic.optimizer.param_groups[0]["lr"] == 1e-2


def test_policy_can_be_copied() -> None:
    level = make_level({"ndbc": NDBC})
    level.train(1, 16)
    copied = copy.deepcopy(level.policy)
    obs = inputs(level)[0]
    assert np.allclose(copied.predict(obs, deterministic=True)[0], level.predict(obs, deterministic=True)[0])


@ACTORS
def test_a_copied_level_trains_on_its_own(actor: dict) -> None:
    level = make_level(actor)
    level.train(2, 16)
    copied = copy.deepcopy(level)
    obs, states = inputs(level)
    before = level.acting.act(obs, states, True, np.random.default_rng(0))[0].copy()
    copied.acting.refresh()
    assert np.array_equal(before, copied.acting.act(obs, states, True, np.random.default_rng(0))[0])
    level.train(3, 16)
    copied.train(3, 16)
    mean, _, _ = copied.actor.step(th.from_numpy(obs), th.from_numpy(states))
    ours, theirs = (x.acting.act(obs, states, True, np.random.default_rng(0))[0] for x in (level, copied))
    assert np.allclose(theirs, mean.tanh().detach(), atol=1e-6)
    assert np.array_equal(ours, theirs)
    assert not np.allclose(before, ours)


@ACTORS
def test_act_is_fast(actor: dict) -> None:
    """A wide bound (loaded machines): a torch forward pass takes 60 microseconds and more."""
    level = make_level(actor, policy_kwargs={"net_arch": [32, 32]})
    obs, states = inputs(level, 1)
    rng = np.random.default_rng(0)
    times = []
    for _ in range(300):
        start = time.perf_counter()
        level.acting.act(obs, states, False, rng)
        times.append(time.perf_counter() - start)
    assert np.median(times) < (60e-6 if not actor else 120e-6)


def test_loading_a_level_alone_is_refused_before_anything_is_unpickled(tmp_path: Path) -> None:
    class Payload:
        def __reduce__(self) -> tuple[object, ...]:
            return Path.touch, (tmp_path / "ran",)

    level = SACLevel(OBSERVATIONS, ACTIONS, name="low", compile=False)
    level.stranger = Payload()
    level.save(tmp_path / "level.zip")
    with pytest.raises(TypeError, match=r"a level is loaded with its agent: use TBCHRL\.load"):
        SACLevel.load(tmp_path / "level.zip")
    assert not (tmp_path / "ran").exists()
    level.set_parameters(tmp_path / "level.zip")
    assert not (tmp_path / "ran").exists()
