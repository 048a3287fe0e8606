"""Callbacks on a stand-in for an agent: when they evaluate, what they keep, what they write."""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_tbc.errors import ConfigError
from sb3_tbc.stopping import StopRequest
from sb3_tbc.zoo import callbacks
from sb3_tbc.zoo.callbacks import OptionTraceCallback, SuccessEvalCallback, TimedCheckpointCallback, read_evaluations


class Logger:
    """Takes what is logged."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}
        self.dumped: list[int] = []

    def record(self, key: str, value: Any, exclude: Any = None) -> None:
        self.values[key] = value

    def dump(self, step: int) -> None:
        self.dumped.append(step)


class Agent:
    """Just enough of an agent for callbacks."""

    def __init__(self) -> None:
        self.num_timesteps = 0
        self.logger = Logger()
        self.saved: list[str] = []

    def get_env(self) -> None:
        return None

    def save(self, path: str) -> None:
        self.saved.append(path)
        Path(path).write_text(f"agent at {self.num_timesteps}")


@pytest.fixture
def agent(monkeypatch: pytest.MonkeyPatch) -> Agent:
    monkeypatch.setattr(callbacks, "TBCHRL", Agent)
    return Agent()


def evaluation(rates: list[float], calls: list[int]) -> Any:
    def evaluate(model: Agent, env: Any, n: int, seed: int, deterministic: bool) -> Any:
        rate = rates[len(calls)]
        calls.append(seed)
        successes = np.arange(n) < round(rate * n)
        fields = dict.fromkeys(("subgoal_success", "mean_window"), np.ones(n))
        return SimpleNamespace(successes=successes, lengths=np.full(n, 100), rewards=np.full(n, -1.0), **fields)

    return evaluate


def steps(callback: Any, agent: Agent, until: int, by: int = 1) -> None:
    while agent.num_timesteps < until:
        agent.num_timesteps += by
        assert callback.on_step()


def test_evaluates_on_time_and_keeps_the_best(agent: Agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    monkeypatch.setattr(callbacks, "evaluate_agent", evaluation([0.5, 1.0, 0.5, 1.0], seeds))
    csv_path, best = tmp_path / "e.csv", tmp_path / "best.zip"
    callback = SuccessEvalCallback(None, 10, 4, seed=7, csv_path=csv_path, best_model_path=best)  # type: ignore[arg-type]
    callback.init_callback(agent)  # type: ignore[arg-type]
    steps(callback, agent, 45, by=3)  # steps of several environments jump over the mark
    assert [row.timesteps for row in callback.rows] == [12, 21, 30, 42]
    assert seeds == [7, 1007, 2007, 3007]
    assert best.read_text() == "agent at 21"
    assert len(agent.saved) == 2
    assert [row.success_rate for row in read_evaluations(csv_path)] == [0.5, 1.0, 0.5, 1.0]
    assert agent.logger.values["eval/success_rate"] == 1.0
    assert list(tmp_path.glob(".tmp*")) == []

    # a resumed run continues the file and does not take a worse agent for the best
    seeds.clear()
    monkeypatch.setattr(callbacks, "evaluate_agent", evaluation([0.75], seeds))
    again = SuccessEvalCallback(None, 10, 4, seed=7, csv_path=csv_path, best_model_path=best)  # type: ignore[arg-type]
    again.init_callback(agent)  # type: ignore[arg-type]
    steps(again, agent, 51)
    assert seeds == [4007]
    assert len(read_evaluations(csv_path)) == 5
    assert best.read_text() == "agent at 21"


def test_training_is_asked_to_stop_where_nobody_reads_its_output(agent: Agent, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(io.StringIO):
        def flush(self) -> None:  # of each line, so that a file has it at once
            raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(callbacks, "evaluate_agent", evaluation([0.5] * 2, []))
    monkeypatch.setattr(sys, "stdout", Broken())
    stop = StopRequest()
    envs = SimpleNamespace(num_envs=1, observation_space=None, action_space=None, render_mode=None)
    callback = SuccessEvalCallback(envs, 10, 4, verbose=1, stop=stop)  # type: ignore[arg-type]
    callback.init_callback(agent)  # type: ignore[arg-type]
    steps(callback, agent, 10)
    assert stop
    alone = SuccessEvalCallback(envs, 10, 4, verbose=1)  # type: ignore[arg-type]
    alone.init_callback(agent)  # type: ignore[arg-type]
    with pytest.raises(BrokenPipeError):
        alone.on_step()


def test_a_second_training_is_evaluated_too(agent: Agent, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(callbacks, "evaluate_agent", evaluation([0.5] * 4, []))
    callback = SuccessEvalCallback(None, 10, 4)  # type: ignore[arg-type]
    callback.init_callback(agent)  # type: ignore[arg-type]
    for _ in range(2):
        agent.num_timesteps = 0
        callback.on_training_start({}, {})
        steps(callback, agent, 25)
    assert [row.timesteps for row in callback.rows] == [10, 20, 10, 20]


@pytest.mark.parametrize("rate", ["nan", "7.0", "-0.1"])
def test_success_rates_that_are_none_are_refused(rate: str, tmp_path: Path) -> None:
    path = tmp_path / "evaluations.csv"
    path.write_text(",".join(callbacks.EvaluationRow._fields) + f"\n100,{rate},20,1,1,1,1\n")
    with pytest.raises(ConfigError, match=r"evaluations.csv .*: success_rate must lie in \[0, 1\], got "):
        read_evaluations(path)


def test_of_equally_successful_agents_the_faster_is_kept(agent: Agent) -> None:
    row = callbacks.EvaluationRow(1, 1.0, 4, 100.0, 1.0, 1.0, 1.0)
    assert callbacks._quality(row._replace(mean_length=90.0)) > callbacks._quality(row)


def test_refuses_other_agents_and_silly_numbers() -> None:
    with pytest.raises(ValueError, match="at least 1, got 0"):
        SuccessEvalCallback(None, eval_freq=0)  # type: ignore[arg-type]
    callback = SuccessEvalCallback(None, eval_freq=1)  # type: ignore[arg-type]
    callback.init_callback(Agent())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"this package's agents, got Agent"):
        callback.evaluate()


def test_inner_callback_can_stop_training(agent: Agent, monkeypatch: pytest.MonkeyPatch) -> None:
    class Stop(callbacks.BaseCallback):
        def _on_step(self) -> bool:
            return False

    monkeypatch.setattr(callbacks, "evaluate_agent", evaluation([0.5], []))
    callback = SuccessEvalCallback(None, 1, 4, callback_after_eval=Stop())  # type: ignore[arg-type]
    callback.init_callback(agent)  # type: ignore[arg-type]
    agent.num_timesteps = 1
    assert not callback.on_step()


def test_option_trace(agent: Agent, tmp_path: Path) -> None:
    callback = OptionTraceCallback(tmp_path / "options.csv", every=2)
    callback.init_callback(agent)  # type: ignore[arg-type]
    callback.on_training_start({}, {})
    for duration in range(4):
        option = {"subgoal": np.array([1.5, -2.0]), "time_budget": 9.5, "duration": duration}
        infos = [{}, {"option": {**option, "reached": True, "reason": "reached"}}]
        callback.update_locals({"infos": infos, "episodes": {1: "an episode"} if duration == 3 else {}})
        steps(callback, agent, agent.num_timesteps + 1)
    callback.on_training_end()
    with (tmp_path / "options.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["duration"] for row in rows] == ["1", "3"]
    assert [row["episode_over"] for row in rows] == ["0", "1"]
    assert rows[0] == {
        "timesteps": "2",
        "env": "1",
        "time_budget": "9.5",
        "duration": "1",
        "reached": "1",
        "reason": "reached",
        "episode_over": "0",
        "subgoal": "1.5 -2",
    }


def test_checkpoint_by_the_clock(agent: Agent, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(callbacks.time, "monotonic", lambda: now[0])
    saved: list[float] = []
    callback = TimedCheckpointCallback(lambda: saved.append(now[0]), seconds=10.0)
    callback.init_callback(agent)  # type: ignore[arg-type]
    for time in (1.0, 9.0, 11.0, 15.0, 20.9, 21.0, 40.0):
        now[0] = time
        callback.on_rollout_start()
    assert saved == [11.0, 21.0, 40.0]
