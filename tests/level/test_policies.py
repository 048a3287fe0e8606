"""The level's policy: SB3's calls, the stepwise interface, bounds and the blocks of flat storage."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_tbc import TBCHRL
from sb3_tbc.errors import ConfigError, NonFiniteError
from sb3_tbc.level.policies import LevelPolicy

OBSERVATIONS = spaces.Box(-np.inf, np.inf, (6,), np.float32)
ACTIONS = spaces.Box(-2.0, 2.0, (3,), np.float32)
NDBC = {"inter": 6, "command": 5, "motor": 3, "sensory_fanout": 3, "inter_fanout": 3,
        "recurrent_command_synapses": 4, "motor_fanin": 3, "sub_steps": 2, "input_scale": [2.0] * 6}  # fmt: skip
GRU = {"hidden_size": 5, "input_scale": [2.0] * 6}
ACTORS = pytest.mark.parametrize("actor", [{}, {"ndbc": NDBC}, {"gru": GRU}], ids=["mlp", "ndbc", "gru"])


def make_policy(**kwargs: object) -> LevelPolicy:
    th.manual_seed(0)
    return LevelPolicy(OBSERVATIONS, ACTIONS, lambda _: 1e-3, **{"net_arch": [8, 7], **kwargs})


@ACTORS
def test_stock_calls_work(actor: dict) -> None:
    policy = make_policy(**actor)
    obs = th.randn(4, 6)
    action, state = policy.predict(obs.numpy(), deterministic=True)
    assert action.shape == (4, 3)
    assert state is None
    assert np.allclose(action, 2 * policy.actor(obs, deterministic=True).detach().numpy(), atol=1e-6)
    assert policy.predict(obs[0].numpy())[0].shape == (3,)
    actions, log_prob = policy.actor.action_log_prob(obs)
    assert log_prob.shape == (4,)
    assert len(policy.critic(obs, actions)) == 2


@ACTORS
def test_step_from_rest_is_the_stock_forward(actor: dict) -> None:
    policy = make_policy(**actor)
    obs = th.randn(4, 6)
    mean, log_std, state = policy.actor.step(obs, th.zeros(4, policy.actor.state_dim))
    assert mean.shape == log_std.shape == (4, 3)
    assert state.shape == (4, policy.actor.state_dim)
    assert th.allclose(mean.tanh(), policy.actor(obs, deterministic=True))


@ACTORS
def test_blocks_give_the_same_forward(actor: dict) -> None:
    actor = make_policy(**actor, mean_bound=0.2, log_std_bounds=(-0.1, 0.1)).actor
    blocks = [th.cat([p.flatten() for p in b.parameters]).view(b.shape) for b in actor.blocks()]
    assert sum(p.numel() for p in actor.parameters()) == sum(b.numel() for b in blocks)
    obs, state = 3 * th.randn(4, 6), 0.3 * th.randn(4, actor.state_dim)
    for ours, theirs in zip(
        actor.step_blocks(blocks, actor.constants(), obs, state), actor.step(obs, state), strict=True
    ):
        assert th.allclose(ours, theirs, atol=1e-6)
    mean, log_std, _ = actor.step(obs, state)
    assert mean.abs().max() <= 0.2
    assert log_std.abs().max() <= 0.1 + 1e-6


@pytest.mark.parametrize("negative", [False, True])
@pytest.mark.parametrize("arch", [[], [8], [8, 7]])
def test_critic_blocks_give_the_same_values(negative: bool, arch: list[int]) -> None:
    critic = make_policy(net_arch={"pi": [4], "qf": arch}, negative_critic=negative, n_critics=3).critic
    blocks = [th.cat([p.flatten() for p in b.parameters]).view(b.shape) for b in critic.blocks()]
    obs, actions = 3 * th.randn(5, 6), th.randn(5, 3)
    stock = critic(obs, actions)
    assert th.allclose(critic.q_blocks(blocks, obs, actions), th.stack(stock), atol=1e-6)
    assert th.allclose(critic.q1_forward(obs, actions), stock[0])
    assert (th.stack(stock) <= 0).all() or not negative


@ACTORS
def test_average_actor_starts_as_a_separate_copy_and_is_saved(actor: dict, tmp_path) -> None:
    policy = make_policy(**actor, negative_critic=True)
    pairs = list(zip(policy.actor.parameters(), policy.average_actor.parameters(), strict=True))
    assert all(th.equal(a, b) and a.data_ptr() != b.data_ptr() and not b.requires_grad for a, b in pairs)
    with th.no_grad():
        next(policy.average_actor.parameters()).add_(1.0)
    policy.save(str(tmp_path / "policy.pth"))
    loaded = LevelPolicy.load(str(tmp_path / "policy.pth"))
    for (name, ours), theirs in zip(policy.state_dict().items(), loaded.state_dict().values(), strict=True):
        assert th.equal(ours, theirs), name
    assert loaded.critic.negative


def test_state_carries_over_between_steps() -> None:
    actor = make_policy(ndbc=NDBC).actor
    obs = th.randn(2, 6)
    first = actor.step(obs, th.zeros(2, actor.state_dim))
    second = actor.step(obs, first[2])
    assert not th.allclose(first[0], second[0])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"mean_bound": -1.0}, "mean_bound must be positive"),
        ({"log_std_bounds": (1.0, 0.0)}, "low < high"),
        ({"use_sde": True}, "use_sde"),
    ],
)
def test_mistakes_are_named(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_policy(**kwargs)


def test_only_flat_observations() -> None:
    with pytest.raises(ConfigError, match="flat vector"):
        LevelPolicy(spaces.Dict({"a": OBSERVATIONS}), ACTIONS, lambda _: 1e-3)


def test_activation_is_used() -> None:
    policy = make_policy(activation_fn=nn.Tanh)
    assert isinstance(policy.actor.activation, nn.Tanh)
    assert isinstance(policy.critic.activation, nn.Tanh)


@pytest.mark.parametrize("circuit", [True, False])
def test_what_is_not_finite_is_named_while_acting(circuit: bool) -> None:
    low = {"policy_kwargs": {"ndbc": {**NDBC, "input_scale": None} if circuit else None}}
    env = gym.make("sb3_tbc/Pendulum-v0")
    model = TBCHRL("MultiInputPolicy", env, seed=0, compile=False, low=low)
    observation, _ = env.reset(seed=0)
    _, state = model.predict(observation, None, deterministic=True)
    _, state = model.predict(observation, state, deterministic=True)
    broken = {**observation, "observation": np.full(3, np.nan, np.float32)}
    with pytest.raises(NonFiniteError, match="high level, subgoal or time budget"):
        model.predict(broken, None, deterministic=True)
    state = (state[0], np.full(1, 50.0), *state[2:])
    with pytest.raises(NonFiniteError, match="low level, sensory layer, step 2" if circuit else "low level, step 2"):
        model.predict(broken, state, deterministic=True)
