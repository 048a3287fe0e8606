"""The training benchmark: it runs, its parts add up, and it leaves nothing behind."""

import json
import time
from functools import partial

import numpy as np
import pytest
import torch as th

from sb3_tbc.benchmark import training as benchmark_train
from sb3_tbc.benchmark.command import benchmark
from sb3_tbc.benchmark.floor import products
from sb3_tbc.benchmark.profile import OUTSIDE, PARTS, Stopwatch, profile, watching_cost
from sb3_tbc.errors import ConfigError
from sb3_tbc.level.level import SACLevel
from sb3_tbc.tbc_hrl.collection import Collector
from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL

WARM_UP = benchmark_train.warm_up


@pytest.fixture(autouse=True)
def eager(monkeypatch):
    """Neither compile nor move the test process to one core, nor wait for levels that fill their buffers slowly."""
    monkeypatch.setattr(benchmark_train, "compiler_problem", lambda: "not in tests")
    monkeypatch.setattr(benchmark_train, "one_core", lambda: None)
    monkeypatch.setattr(benchmark_train, "warm_up", lambda model, steps: model.learn(steps))


def test_command_prints_and_writes_json(tmp_path, capsys):
    arguments = ["train", "Drawbridge", "--steps", "60", "--rounds", "1", "--json", str(tmp_path / "out.json")]
    assert benchmark(arguments) == 0
    printed = capsys.readouterr().out
    assert "SB3 SAC" in printed
    assert "microseconds per step" in printed
    figures = json.loads((tmp_path / "out.json").read_text())
    assert set(figures) == {"update", "speed Drawbridge", "split Drawbridge"}
    assert figures["speed Drawbridge"]["SB3 SAC"]["times_sb3"] == pytest.approx(1.0)
    with pytest.raises(ConfigError, match="no measurement 'sped'"):
        benchmark(["train", "--what", "sped"])


def test_the_share_outside_follows_from_the_printed_parts(monkeypatch):
    rounds = iter(
        [
            dict.fromkeys(PARTS, 0.0) | {"environment": 10.0, "acting": 2.0},
            dict.fromkeys(PARTS, 0.0) | {"environment": 40.0, "acting": 20.0},
            dict.fromkeys(PARTS, 0.0) | {"environment": 20.0, "acting": 18.0},
        ]
    )
    monkeypatch.setattr(benchmark_train, "profile", lambda model, steps: next(rounds))
    lines, figures = benchmark_train.split("Drawbridge", 60, 3)
    assert figures["parts"]["environment"] == 20.0
    assert figures["outside"] == 18.0
    assert figures["share_of_environment"] == pytest.approx(0.9)  # the median of the three shares is 0.5
    assert "18.0 = 90% of the environment's" in lines[-1]


def test_stopwatch_charges_the_innermost(monkeypatch):
    readings = iter([0.0, 1.0, 3.0, 6.0])  # outer begins, inner begins, inner ends, outer ends
    monkeypatch.setattr("sb3_tbc.benchmark.profile.time.perf_counter", lambda: next(readings))
    watch = Stopwatch()
    watch.timed("outer", watch.timed("inner", lambda: None))()
    assert watch.seconds == {"outer": 4.0, "inner": 2.0}
    assert watch.calls == {("outer", "inner"): 1}


def test_watching_costs_microseconds():
    caller, own = watching_cost(2000)
    assert 0.0 < own < 1e-4
    assert 0.0 <= caller < 1e-4


def test_profile_takes_watching_off(monkeypatch):
    model = benchmark_train.ours("Drawbridge", compile=False)
    monkeypatch.setattr("sb3_tbc.benchmark.profile.watching_cost", lambda: (0.0, 1.0))  # a second a call
    parts = profile(model, 100)
    assert parts["environment"] == parts["acting"] == 0.0


def test_profile_counts_all_draws_of_batches(monkeypatch):
    """With a duration loss the high level's batches have labels, and the reachability estimate draws its own."""
    monkeypatch.setattr("sb3_tbc.benchmark.profile.watching_cost", lambda: (0.0, 0.0))
    levels = {"high": {"batch_size": 4}, "low": {"batch_size": 4}, "gradient_ratio": 0.02}
    model = benchmark_train.ours("Pendulum", config="paper", compile=False, **levels)
    model.learn(600)
    buffers = model.replay_buffer
    for buffer, name, seconds in ((buffers.high, "sample_labelled", 0.1), (buffers.low, "sample_pairs", 0.002)):
        draw, calls = getattr(buffer, name), []

        def slow(*args, draw=draw, calls=calls, seconds=seconds):
            calls.append(time.process_time() + seconds)
            while time.process_time() < calls[-1]:
                pass
            return draw(*args)

        monkeypatch.setattr(buffer, name, slow)
        parts = profile(model, 600)
        assert calls
        assert parts["batches"] > 0.3e6 * len(calls) * seconds / 600
        monkeypatch.setattr(buffer, name, draw)


def test_profile_adds_up_and_leaves_no_trace(monkeypatch):
    monkeypatch.setattr("sb3_tbc.benchmark.profile.watching_cost", lambda: (0.0, 0.0))  # is in what it took, too
    model = benchmark_train.ours("Drawbridge", compile=False)
    before = {owner: dict(vars(owner)) for owner in (Collector, SACLevel, TBCHRL)}
    start = time.process_time()
    parts = profile(model, 200)
    took = 1e6 * (time.process_time() - start) / 200
    assert set(parts) == set(PARTS) > set(OUTSIDE)
    assert 0.5 * took < sum(parts.values()) <= 1.05 * took
    assert all(parts[part] > 0 for part in ("environment", "acting", "bookkeeping"))
    assert {owner: dict(vars(owner)) for owner in before} == before
    assert "step" not in vars(model.env.envs[0].unwrapped)


def test_full_buffers_hold_repeated_rows():
    level = {"buffer_size": 3000, "batch_size": 16}
    model = benchmark_train.ours("Pendulum", high=level, low=level, gradient_ratio=0.01)
    with pytest.raises(ValueError, match="without a finished episode"):
        benchmark_train.fill(model, 1000)
    model.learn(1500)
    low = model.replay_buffer.low
    known = np.unique(low.data["here"][: low.size()], axis=0)
    benchmark_train.fill(model, 10**6)
    assert all(buffer.full and buffer.size() == 3000 for buffer in model.replay_buffer)
    assert np.array_equal(np.unique(low.data["here"], axis=0), known)


@pytest.mark.parametrize("what", ["growth", "n_envs", "budget"])
def test_further_measurements_run(what, monkeypatch):
    monkeypatch.setattr(benchmark_train, "fill", lambda model, steps: None)
    lines, figures = getattr(benchmark_train, what)("Drawbridge", 20, 1)
    assert lines
    assert figures


def test_products_of_an_update_are_counted_and_the_level_is_left_alone():
    model = benchmark_train.ours("Drawbridge", compile=False)
    before = {name: x.clone() for name, x in model.high.policy.state_dict().items()}
    found = products(model.high, 16, 1)
    assert all(th.equal(before[name], x) for name, x in model.high.policy.state_dict().items())
    n_obs, n_act, hidden = model.high.observation_space.shape[0], model.high.action_space.shape[0], 32
    actor = n_obs * hidden + hidden**2 + hidden * 2 * n_act
    critics = 2 * ((n_obs + n_act) * hidden + hidden**2 + hidden)
    forward = 2 * actor + 3 * critics  # actions now and next; targets, the critics' own update, the actor's loss
    # backward: products for the weights and, but for the input layer, for what the layer saw
    inputs = n_obs * hidden, 2 * (n_obs + n_act) * hidden
    backward = 2 * actor - inputs[0] + 2 * critics - inputs[1] + critics
    assert found.flops == pytest.approx(2 * 16 * (forward + backward))
    assert found.microseconds > 0


def test_floor_is_below_a_step(monkeypatch):
    level = {"batch_size": 8, "policy_kwargs": {"net_arch": [32, 32]}}
    levels = {"high": level, "low": {**level, "gradient_ratio": 0.5}}
    monkeypatch.setattr(benchmark_train, "ours", partial(benchmark_train.ours, **levels))
    monkeypatch.setattr(benchmark_train, "warm_up", WARM_UP)
    lines, figures = benchmark_train.floor("Pendulum", 200, 1)
    assert any("times the floor" in line for line in lines)
    assert lines[-1].endswith("updates per step: 1 of the high level and 0.5 of the low level.")
    assert 0 < figures["environment"] + figures["products"] < figures["step"]
    updates = [figures["levels"][name]["microseconds"] for name in ("high", "low")]
    assert figures["products"] == pytest.approx(updates[0] + 0.5 * updates[1])


def test_warming_up_ends_when_both_levels_learn():
    low = {"batch_size": 8, "policy_kwargs": {"net_arch": [32, 32]}}
    model = benchmark_train.ours("Pendulum", high={**low, "batch_size": 40}, low=low, learning_starts=1100)
    WARM_UP(model, 200)
    assert model.num_timesteps > 1100
    assert model.replay_buffer.high.size() >= 40
    model.learn(100, reset_num_timesteps=False)
    assert model.high._n_updates > 0
    assert model.low._n_updates > 0
