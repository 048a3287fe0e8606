"""Normalised critics: the blocks' forward pass against torch's own modules, in updates and after loading."""

import copy

import levels as base
import pytest
import torch as th
from torch import nn

from sb3_tbc.errors import ConfigError
from sb3_tbc.level.critics import BATCH_MOMENTUM, NORMS
from sb3_tbc.level.level import SACLevel
from sb3_tbc.level.policies import LevelPolicy

NORMED = pytest.mark.parametrize("norm", ["layer", "batch"])


def make_level(norm: str, compile: bool = False, seed: int = 3, **policy_kwargs: object) -> SACLevel:
    kwargs = {"net_arch": [9, 7], "critic_norm": norm, **policy_kwargs}
    return base.make_level(base.make_batches(), compile, policy_kwargs=kwargs, seed=seed)


def blocks_of(blocks: list) -> list[th.Tensor]:
    return [th.cat([p.flatten() for p in block.parameters]).view(block.shape) for block in blocks]


@NORMED
@pytest.mark.parametrize("negative", [False, True])
@pytest.mark.parametrize("arch", [[], [8], [8, 7]])
def test_blocks_give_the_modules_values(norm: str, negative: bool, arch: list[int]) -> None:
    level = make_level(norm, net_arch={"pi": [4], "qf": arch}, negative_critic=negative, n_critics=3)
    level.train(5, base.BATCH)  # scales, shifts and running statistics away from where they start
    critic = level.critic
    obs, actions = 3 * th.randn(6, base.OBS_DIM), th.randn(6, base.ACTION_DIM)
    ours = critic.q_blocks(blocks_of(critic.blocks()), obs, actions, blocks_of(critic.statistics()))
    assert th.allclose(ours, th.stack(critic(obs, actions)), atol=1e-5)
    kinds = [type(m) for net in critic.q_networks for m in net.modules()]
    assert kinds.count(nn.LayerNorm) == (3 * len(arch) if norm == "layer" else 0)
    assert kinds.count(nn.BatchNorm1d) == (3 * (len(arch) + 1) if norm == "batch" else 0)


def test_batch_statistics_are_those_of_torch() -> None:
    """The joint pass and the running statistics, against the modules in training mode."""
    critic = make_level("batch").critic
    nets = copy.deepcopy(critic.q_networks)
    obs, actions = 3 * th.randn(64, base.OBS_DIM), th.randn(64, base.ACTION_DIM)
    ours, seen = critic.q_blocks_of_batch(blocks_of(critic.blocks()), obs, actions)
    for module in (m for net in nets for m in net.modules()):
        nn.Module.train(module)
    theirs = th.stack([net(th.cat((obs, actions), dim=-1)) for net in nets])
    assert th.allclose(ours, theirs, atol=1e-5)
    norms = [[m for m in net.modules() if isinstance(m, nn.BatchNorm1d)] for net in nets]
    for layer, modules in enumerate(zip(*norms, strict=True)):
        mean, variance = seen[2 * layer : 2 * layer + 2]
        for index, module in enumerate(modules):
            assert th.allclose(module.running_mean, BATCH_MOMENTUM * mean[index, 0], atol=1e-6)
            unbiased = variance[index, 0] * 64 / 63  # torch keeps the unbiased variance
            expected = (1 - BATCH_MOMENTUM) + BATCH_MOMENTUM * unbiased
            assert th.allclose(module.running_var, expected, atol=1e-6)


def test_batch_norm_needs_no_target_networks() -> None:
    level = make_level("batch")
    before = blocks_of(level.critic.statistics())
    level.train(4, base.BATCH)
    for ours, target in zip(level.critic.parameters(), level.critic_target.parameters(), strict=True):
        assert th.equal(ours, target)
    assert all(not th.equal(a, b) for a, b in zip(before, blocks_of(level.critic.statistics()), strict=True))


def test_next_values_are_normalised_with_the_stored_ones() -> None:
    """With a done everywhere nothing is bootstrapped, yet next states move the statistics, so values differ."""
    batches = base.make_batches()
    batches = batches._replace(dones=th.ones_like(batches.dones))
    moved = batches._replace(next_observations=batches.next_observations + 5.0)
    for norm, same in (("layer", True), ("batch", False)):
        criticals = []
        for given in (batches, moved):
            level = base.make_level(given, policy_kwargs={"net_arch": [8], "critic_norm": norm})
            level.train(1, base.BATCH)
            criticals.append(level._update.critic.vector.detach().clone())
        assert th.equal(*criticals) == same


@NORMED
def test_critics_fit_fixed_targets(norm: str) -> None:
    batches = base.make_batches()
    rewards = batches.observations[..., :1] * batches.actions[..., :1]
    batches = batches._replace(dones=th.ones_like(batches.dones), rewards=rewards)
    level = base.make_level(batches, policy_kwargs={"net_arch": [32, 32], "critic_norm": norm}, learning_rate=3e-3)
    losses = []
    for _ in range(12):
        level.replay_buffer.used = 0
        level.train(base.UPDATES, base.BATCH)
        losses.append(level.logger.name_to_value["level/critic_loss"])
    assert losses[-1] < 0.2 * losses[0]


@NORMED
def test_saved_and_loaded(norm: str, tmp_path) -> None:
    level = make_level(norm)
    level.train(5, base.BATCH)
    level.policy.save(str(tmp_path / "policy.pth"))
    loaded = LevelPolicy.load(str(tmp_path / "policy.pth"))
    assert loaded.critic.norm == norm
    for (name, ours), theirs in zip(level.policy.state_dict().items(), loaded.state_dict().values(), strict=True):
        assert th.equal(ours, theirs), name


@pytest.mark.slow
@base.COMPILER
@NORMED
def test_compiled_agrees_with_eager(norm: str) -> None:
    eager, compiled = (make_level(norm, compile) for compile in (False, True))
    for level in (eager, compiled):
        level.train(base.UPDATES, base.BATCH)
    assert compiled.compiled
    for name, value in eager.policy.state_dict().items():
        assert th.allclose(compiled.policy.state_dict()[name], value, rtol=0, atol=2e-5), name


def test_unknown_norm() -> None:
    with pytest.raises(ConfigError, match="critic_norm must be one of 'none', 'layer', 'batch', got 'group'"):
        make_level("group")


def test_norms_do_not_change_the_first_weights() -> None:
    weights = [[m.weight for m in make_level(norm).critic.modules() if isinstance(m, nn.Linear)] for norm in NORMS]
    for plain, layer, batch in zip(*weights, strict=True):
        assert th.equal(plain, layer)
        assert th.equal(plain, batch)
    assert make_level("none").critic.statistics() == []
