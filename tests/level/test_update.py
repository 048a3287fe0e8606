"""The flat update against Stable-Baselines3's own ``SAC.train``: same batches, same noise, same numbers."""

import logging

import numpy as np
import pytest
import torch as th
from levels import (
    ACTION_DIM,
    ACTIONS,
    BATCH,
    COMPILER,
    OBS_DIM,
    OBSERVATIONS,
    UPDATES,
    FixedBuffer,
    labelled_level,
    make_batches,
    make_level,
)
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._pytree import tree_leaves

from sb3_tbc.level import compilation
from sb3_tbc.level.actors import squash
from sb3_tbc.level.level import SACLevel
from sb3_tbc.level.spaces_only import SpacesOnlyVecEnv
from sb3_tbc.level.storage import FlatParameters
from sb3_tbc.level.update import Given
from sb3_tbc.replay.batch import LevelBatch


def make_stock(level: SACLevel, **kwargs: object) -> SAC:
    arguments = {"learning_rate": 1e-3, "policy_kwargs": {"net_arch": [16, 16]}, **kwargs}
    stock = SAC("MlpPolicy", SpacesOnlyVecEnv(OBSERVATIONS, ACTIONS), buffer_size=1, device="cpu", **arguments)
    stock.policy.load_state_dict({k: v for k, v in level.policy.state_dict().items() if "average" not in k})
    stock.set_logger(Logger(folder=None, output_formats=[]))
    return stock


def train_stock(stock: SAC, batches: LevelBatch, noise: th.Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    stock.replay_buffer = FixedBuffer(batches)  # type: ignore[assignment]
    draws = iter(noise.flatten(0, 1))
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda *args, **kwargs: next(draws))
    stock.train(len(batches.rewards), BATCH)


def level_noise(level: SACLevel, updates: int = UPDATES) -> th.Tensor:
    """The noise that the level is about to draw."""
    rng = np.random.default_rng(level.seed)
    return th.from_numpy(rng.standard_normal((updates, 2, BATCH, ACTION_DIM), dtype=np.float32))


def assert_same_policies(level: SACLevel, stock: SAC, atol: float = 1e-5) -> None:
    theirs = stock.policy.state_dict()
    ours = level.policy.state_dict()
    for name, value in theirs.items():
        assert th.allclose(ours[name], value, rtol=0, atol=atol), (name, (ours[name] - value).abs().max())


@pytest.mark.parametrize("ent_coef", ["auto_0.5", 0.2])
@pytest.mark.parametrize(
    "compile", [False, pytest.param(True, marks=[pytest.mark.slow, COMPILER])], ids=["eager", "compiled"]
)
def test_agrees_with_stock_sac(ent_coef: str | float, compile: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    batches = make_batches()
    level = make_level(batches, compile, ent_coef=ent_coef)
    stock = make_stock(level, ent_coef=ent_coef)
    train_stock(stock, batches, level_noise(level), monkeypatch)
    level.train(UPDATES, BATCH)

    assert level.compiled == compile
    assert_same_policies(level, stock)
    names = ["critic_loss", "actor_loss", "ent_coef"] + (["ent_coef_loss"] if ent_coef == "auto_0.5" else [])
    for name in names:
        theirs = stock.logger.name_to_value[f"train/{name}"]
        assert level.logger.name_to_value[f"level/{name}"] == pytest.approx(theirs, abs=1e-5), name
    if ent_coef == "auto_0.5":
        assert level.log_ent_coef.item() == pytest.approx(stock.log_ent_coef.item(), abs=1e-6)


def test_gradients_agree_with_stock_sac(monkeypatch: pytest.MonkeyPatch) -> None:
    """After one update Adam's first moment is 0.1 times the gradient."""
    batches = make_batches(updates=1)
    level = make_level(batches)
    stock = make_stock(level)
    train_stock(stock, batches, level_noise(level, 1), monkeypatch)
    level.train(1, BATCH)
    for module in ("actor", "critic"):
        ours, theirs = getattr(level, module), getattr(stock, module)
        vector = ours.optimizer.param_groups[0]["params"][0]
        moment = ours.optimizer.state[vector]["exp_avg"]
        for mine, their in zip(ours.parameters(), theirs.parameters(), strict=True):
            start = (mine.data_ptr() - vector.data_ptr()) // 4
            expected = theirs.optimizer.state[their]["exp_avg"].flatten()
            assert th.allclose(moment[start : start + mine.numel()], expected, rtol=1e-4, atol=1e-7)


def test_other_betas_are_those_of_the_networks_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """SB3's temperature keeps Adam's defaults."""
    batches, policy_kwargs = make_batches(), {"net_arch": [16, 16], "optimizer_kwargs": {"betas": (0.5, 0.9)}}
    level = make_level(batches, policy_kwargs=policy_kwargs)
    stock = make_stock(level, policy_kwargs=policy_kwargs)
    train_stock(stock, batches, level_noise(level), monkeypatch)
    level.train(UPDATES, BATCH)
    assert level.log_ent_coef.item() == pytest.approx(stock.log_ent_coef.item(), abs=1e-6)
    assert_same_policies(level, stock)


def test_a_temperature_that_begins_anew_counts_its_own_updates() -> None:
    """Adam's first step is as long as the learning rate, whatever number of updates the networks have had."""
    level = make_level(make_batches(updates=UPDATES + 1))
    level.train(UPDATES, BATCH)
    for part in level.ent_coef_optimizer.state[level.log_ent_coef].values():
        part.zero_()
    before = level.log_ent_coef.item()
    level.train(1, BATCH)
    assert abs(level.log_ent_coef.item() - before) == pytest.approx(1e-3, rel=1e-3)


def test_learning_rate_schedule_reaches_the_update(monkeypatch: pytest.MonkeyPatch) -> None:
    batches = make_batches()

    def schedule(progress: float) -> float:
        return 2e-3 * progress

    level = make_level(batches, learning_rate=schedule)
    stock = make_stock(level, learning_rate=schedule)
    noise = level_noise(level)
    half = UPDATES // 2
    for part, progress in ((slice(0, half), 0.9), (slice(half, UPDATES), 0.1)):
        stock._current_progress_remaining = level._current_progress_remaining = progress
        train_stock(stock, LevelBatch(*(x[part] for x in batches)), noise[part], monkeypatch)
        level.train(half, BATCH)
    assert_same_policies(level, stock)


def test_negative_critics_bound_the_target() -> None:
    level = make_level(make_batches(), policy_kwargs={"net_arch": [8], "negative_critic": True})
    level.train(5, BATCH)
    assert level.logger.name_to_value["level/q_mean"] < 0
    q = level.critic(th.randn(64, OBS_DIM) * 10, th.zeros(64, ACTION_DIM))
    assert len(q) == 2
    assert all((x <= 0).all() for x in q)


def test_squash_log_prob_is_the_density_of_the_action() -> None:
    noise = th.randn(1000, 1, dtype=th.float64)
    mean, log_std = th.full((1000, 1), 0.3, dtype=th.float64), th.full((1000, 1), -0.4, dtype=th.float64)
    actions, log_prob = squash(mean, log_std, noise)
    base = th.distributions.Normal(mean, log_std.exp())
    exact = th.distributions.TransformedDistribution(base, th.distributions.TanhTransform())
    inner = actions.abs() < 0.99
    assert th.allclose(log_prob[inner], exact.log_prob(actions)[inner], atol=1e-4)


@pytest.mark.parametrize("longest", [0.999, 0.3, 0.0])
def test_average_actor_follows_the_actor(longest: float) -> None:
    level = make_level(make_batches(), policy_kwargs={"net_arch": [8]}, average_decay=longest)
    actors = [level._update.actor.vector.detach().clone()]
    expected = actors[0].clone()
    for n in range(1, 6):
        level.train(1, BATCH)
        decay = min(longest, (1 + n) / (10 + n))
        expected = decay * expected + (1 - decay) * level._update.actor.vector.detach()
    average = th.cat([b.flatten() for b in level._update.average.unflatten(level._update.average.vector)])
    assert th.allclose(average, expected, atol=1e-6)
    assert th.allclose(average, level._update.actor.vector) == (longest == 0.0)


def test_modules_share_the_flat_storage() -> None:
    level = make_level(make_batches())
    update = level._update
    assert all(flat.is_aliased() for flat in (update.actor, update.critic, update.target, update.average))
    before = {k: v.clone() for k, v in level.policy.state_dict().items()}
    level.train(2, BATCH)
    assert all(not th.equal(before[k], v) for k, v in level.policy.state_dict().items())
    level.policy.load_state_dict(before)
    assert all(flat.is_aliased() for flat in (update.actor, update.critic, update.target, update.average))


def test_flat_parameters_refuse_other_types() -> None:
    level = make_level(make_batches())
    with pytest.raises(ValueError, match="float32 on the CPU"):
        FlatParameters(level.policy.actor.double().blocks())


def test_auto_falls_back_with_one_log_line(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(compilation, "compiler_problem", lambda: "no C++ compiler")
    level = make_level(make_batches(), compile="auto")
    with caplog.at_level(logging.WARNING):
        level.train(2, BATCH)
        level.train(2, BATCH)
    assert not level.compiled
    assert [r.message for r in caplog.records].count(caplog.records[0].message) == 1
    assert "eagerly" in caplog.records[0].message
    with pytest.raises(RuntimeError, match="no C\\+\\+ compiler"):
        make_level(make_batches(), compile=True).train(1, BATCH)


@pytest.mark.parametrize("field", ["rewards", "observations", "states"])
def test_wrong_batches_are_refused(field: str) -> None:
    batches = make_batches()
    level = make_level(batches._replace(**{field: getattr(batches, field).double()}))
    with pytest.raises(ValueError, match=f"batch.{field} must be float32"):
        level.train(1, BATCH)


def test_graph_passes_keep_the_numbers() -> None:
    level = make_level(make_batches())
    update = level._update
    batch = level.replay_buffer.sample_burst(1, BATCH)
    noise = level_noise(level, 1)
    inputs = update.example(BATCH, level.log_ent_coef)
    given = Given(update._schedules(1, 0.01, -2.0)[0], noise[0], (), LevelBatch(*(x[0] for x in batch)))
    example = tree_leaves(inputs._replace(given=given))
    graph = make_fx(update._step)(*(x.clone() for x in example))
    n_nodes = len(graph.graph.nodes)
    compilation.split_bias_from_products(graph)
    compilation.merge_repeated(graph)
    targets = [str(node.target) for node in graph.graph.nodes]
    assert not any("addmm" in t or "baddbmm" in t for t in targets)
    assert len(targets) != n_nodes
    ours, theirs = ([x.clone() for x in example] for _ in range(2))
    graph(*ours)
    update._step(*theirs)
    for a, b, before in zip(ours, theirs, example, strict=True):
        assert th.allclose(a, b, atol=1e-6)
        assert not th.equal(a, before) or a.numel() == 0 or any(a is x for x in ours[-len(tree_leaves(given)) :])


def test_broken_toolchain(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def fail(*args: object) -> None:
        raise OSError("Python.h: no such file")

    monkeypatch.setattr(compilation, "compiler_problem", lambda: None)
    monkeypatch.setattr(compilation, "_compile", fail)
    with caplog.at_level(logging.WARNING):
        make_level(make_batches(), compile="auto").train(1, BATCH)
    assert "OSError" in caplog.text
    assert "Python.h" in caplog.text
    with pytest.raises(OSError, match=r"Python\.h"):
        make_level(make_batches(), compile=True).prepare(BATCH)


def test_prepare_compiles_for_the_batch_size(monkeypatch: pytest.MonkeyPatch) -> None:
    shapes = []
    level = make_level(make_batches(), compile=True)
    monkeypatch.setattr(compilation, "compiler_problem", lambda: None)
    monkeypatch.setattr(
        compilation, "_compile", lambda step, example: shapes.append([x.shape for x in example]) or (lambda *args: None)
    )
    before = level._update.actor.vector.detach().clone()
    assert level.prepare(BATCH) >= 0.0
    assert th.equal(before, level._update.actor.vector)
    level.train(2, BATCH)
    level.train(2, BATCH // 2)
    assert len(shapes) == 2
    assert shapes[0][-1] == (BATCH, 0)
    assert level.compiled


def test_unknown_compile_value() -> None:
    with pytest.raises(ValueError, match="'auto', True or False"):
        make_level(make_batches(), compile="maybe").train(1, BATCH)


CIRCUIT = {"inter": 5, "command": 4, "motor": 2, "sensory_fanout": 3, "inter_fanout": 3,
           "recurrent_command_synapses": 3, "motor_fanin": 3}  # fmt: skip
MEMORIES = pytest.mark.parametrize(
    "actor",
    [
        {"ndbc": CIRCUIT},
        {"ndbc": CIRCUIT, "critic_memory": True},
        {"gru": {"hidden_size": 11, "input_scale": [1.0] * OBS_DIM}, "critic_memory": True},
    ],
    ids=["circuit", "circuit seen by critics", "gru seen by critics"],
)


@pytest.mark.slow
@COMPILER
@MEMORIES
def test_compiled_memory_agrees_with_eager(actor: dict[str, object]) -> None:
    levels = []
    for compile in (False, True):
        kwargs = {"policy_kwargs": {"net_arch": [8], "mean_bound": 3.0, "negative_critic": True, **actor}}
        level = make_level(make_batches(state_dim=11), compile, **kwargs)
        level.train(UPDATES, BATCH)
        levels.append(level)
    eager, compiled = (level.policy.state_dict() for level in levels)
    assert levels[1].compiled
    assert len(levels[1]._update._steps) == 1
    for name, value in eager.items():
        assert th.allclose(compiled[name], value, rtol=0, atol=1e-5), name


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=[pytest.mark.slow, COMPILER])])
@MEMORIES
def test_memory_is_unrolled_and_learns_through_time(actor: dict[str, object], compile: bool) -> None:
    """Against the same steps by hand: the actor's loss and its gradient, and what the critics are taught."""
    kwargs = {"policy_kwargs": {"net_arch": [8], "critic_memory": True, **actor}, "ent_coef": 0.2}
    batches = make_batches(state_dim=11, updates=1, earlier_steps=3)
    level = make_level(batches, compile, earlier_steps=3, **kwargs)
    batch, noise = LevelBatch(*(x[0] for x in batches)), level_noise(level, 1)[0]
    vector = level._update.actor.vector.detach().clone().requires_grad_()

    def act(seen: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        blocks = level._update.actor.unflatten(vector)
        return level.policy.actor.step_blocks(blocks, level.policy.actor.constants(), seen, state)

    memory = batch.states
    for step in batch.earlier.view(BATCH, 3, 1 + OBS_DIM).unbind(1):
        memory = th.where(step[:, :1] == 1, act(step[:, 1:], memory)[2], memory)
    mean, log_std, after = act(batch.observations, memory)
    # a level without earlier steps, given the memory that was reached, teaches its critics the same
    given = batches._replace(
        states=memory.detach()[None], next_states=after.detach()[None], earlier=th.zeros(1, BATCH, 0)
    )
    other = make_level(given, False, **kwargs)
    level.train(1, BATCH)
    other.train(1, BATCH)
    for name, value in other.policy.critic.state_dict().items():
        assert th.allclose(level.policy.critic.state_dict()[name], value, rtol=0, atol=1e-5), name
    actions, log_prob = squash(mean, log_std, noise[0])
    values = th.stack(level.policy.critic(th.cat((batch.observations, memory.detach()), dim=-1), actions))
    (gradient,) = th.autograd.grad((0.2 * log_prob - values.amin(dim=0)).mean(), vector)
    moments = [one.actor.optimizer.state[one._update.actor.vector]["exp_avg"] / 0.1 for one in (level, other)]
    assert th.allclose(moments[0], gradient, rtol=1e-4, atol=1e-6)
    assert not th.allclose(moments[0], moments[1], rtol=1e-2, atol=1e-4)  # which learns through the last step alone


@pytest.mark.parametrize("sees", [False, True], ids=["blind", "seeing"])
@pytest.mark.parametrize("moment", ["states", "next_states"])
def test_critics_see_the_memory_where_they_are_to(moment: str, sees: bool) -> None:
    # An actor that does not depend on its state, so that a memory can reach the critics by themselves alone.
    gru = {"hidden_size": 4, "input_scale": [1.0] * OBS_DIM}
    batches = make_batches(state_dim=4)
    moved = batches._replace(**{moment: getattr(batches, moment) + 1.0})
    weights = []
    for given in (batches, moved):
        kwargs = {"policy_kwargs": {"net_arch": [8], "gru": gru, "critic_memory": sees}}
        level = make_level(given, False, **kwargs)
        with th.no_grad():
            level.policy.actor.net.readout.weight.zero_()
        level.train(1, BATCH)
        weights.append(level.policy.critic.state_dict())
    same = all(th.equal(a, b) for a, b in zip(weights[0].values(), weights[1].values(), strict=True))
    assert same != sees


def test_label_loss_is_added_to_the_actors_loss() -> None:
    """One update: with Adam's first moment 0.1 times the gradient, its difference is the label loss's gradient."""
    moments, levels = [], []
    for coef in (1e-9, 2.0):
        level = labelled_level(0.4, coef)
        start = level._update.actor.vector.detach().clone().requires_grad_()
        level.train(1, BATCH)
        moments.append(level.actor.optimizer.state[level._update.actor.vector]["exp_avg"] / 0.1)
        levels.append(level)
    batch, noise = make_batches(), level_noise(levels[0], 1)
    mean, log_std, _ = level.policy.actor.step_blocks(
        level._update.actor.unflatten(start), [], batch.observations[0], batch.states[0]
    )
    actions, _ = squash(mean, log_std, noise[0, 0])
    (expected,) = th.autograd.grad(2.0 * (actions[:, -1] - 0.4).square().mean(), start)
    assert th.allclose(moments[1] - moments[0], expected, atol=1e-5)
    losses = [level.logger.name_to_value["level/actor_loss"] for level in levels]
    added = 2.0 * float((actions[:, -1] - 0.4).square().mean().detach())
    assert losses[1] - losses[0] == pytest.approx(added, abs=1e-4)


def test_labels_where_they_are_needed_and_only_there() -> None:
    level = labelled_level(0.4, 1.0)
    batch, noise = level.replay_buffer.sample_burst(1, BATCH), level_noise(level, 1)
    arguments = {"tau": 0.01, "target_entropy": -2.0, "ent_coef": level._ent_coef_state()}
    with pytest.raises(ValueError, match="labels are needed where label_coef is not 0"):
        level._update.run(batch, noise, **arguments)
    with pytest.raises(ValueError, match=r"batch\.labels must be float32 of shape"):
        level._update.run(batch, noise, labels=th.zeros(1, BATCH, 2), **arguments)


@pytest.mark.slow
@COMPILER
def test_compiled_label_loss_agrees_with_eager() -> None:
    eager, compiled = (labelled_level(-0.3, 1.5, compile) for compile in (False, True))
    for level in (eager, compiled):
        level.train(UPDATES, BATCH)
    assert compiled.compiled
    for name, value in eager.policy.state_dict().items():
        assert th.allclose(compiled.policy.state_dict()[name], value, rtol=0, atol=1e-5), name
