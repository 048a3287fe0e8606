"""What environments give that is wrong is named and kept out of replay; what was learned before is saved."""

from __future__ import annotations

import multiprocessing
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from faulty import KEYS, Fault, Faulty
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_tbc import TBCHRL, train
from sb3_tbc.errors import EnvironmentFault, NonFiniteError
from sb3_tbc.smdp import faults
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.smdp.options import Episode
from sb3_tbc.tbc_hrl import HAC, HiTS
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.zoo.safety import ConsistentState

ALGORITHMS: dict[str, Any] = {"tbc-hrl": TBCHRL, "hits": HiTS, "hac": HAC, "sac": FlatSAC}
VECTORS: dict[str, Callable[[list[Any]], VecEnv]] = {
    "here": GoalVecEnv,
    "dummy": DummyVecEnv,
    "processes": partial(SubprocVecEnv, start_method="fork"),
}
FAULTS = {
    f"{kind} {key} at {where}": Fault(kind, key, step=0 if where == "reset" else 4)
    for kind, keys in {
        "nan": (*KEYS, "reward"),
        "shape": (*KEYS, "reward"),
        "raise": KEYS[:1],
        "die": KEYS[:1],
        "hang": KEYS[:1],
    }.items()
    for key in keys
    for where in ("reset", "step")
    if not (key == "reward" and where == "reset")
}
IN_PROCESSES_ONLY = ("die", "hang")


def make(vector: str, n_envs: int, fault: Fault | None, monitored: bool = True) -> tuple[VecEnv, int]:
    """A vector whose last environment has the fault, and its index."""
    around = Monitor if monitored else (lambda env: env)
    faulty = [None] * (n_envs - 1) + [fault]
    return VECTORS[vector]([partial(_made, around, f) for f in faulty]), n_envs - 1


def _made(around: Callable[[gym.Env], gym.Env], fault: Fault | None) -> gym.Env:
    return around(Faulty(fault))


def agent(algo: str, env: VecEnv, **settings: Any) -> Any:
    if algo == "sac":
        return FlatSAC("MultiInputPolicy", env, batch_size=8, learning_starts=10, gradient_ratio=0.1, buffer_size=2000,
                       policy_kwargs={"net_arch": [8]}, seed=0, **settings)  # fmt: skip
    level = {"batch_size": 8, "buffer_size": 2000, "policy_kwargs": {"net_arch": [8]}}
    return ALGORITHMS[algo]("MultiInputPolicy", env, high=level, low=level, max_options=3, gradient_ratio=0.1,
                            compile=False, seed=0, **settings)  # fmt: skip


def stopped(algo: str, vector: str, n_envs: int, fault: Fault, folder: Path, monitored: bool = True) -> None:
    """Learn until the fault; it is named, no replay holds it, and what is saved can be learned on with."""
    env, index = make(vector, n_envs, fault, monitored)
    model, last = agent(algo, env), ConsistentState()
    when = "reset" if fault.step == 0 else f"step {fault.step} of its episode"
    with pytest.raises((EnvironmentFault, NonFiniteError)) as caught:
        model.learn(2000, callback=last)
    text = str(caught.value)
    assert re.search(rf"environment {index}\b", text), text
    assert when in text, text
    if fault.kind in ("nan", "shape"):
        assert (f"'{fault.key}'" if fault.key != "reward" else "reward") in text, text
    save_replay = last.go_back()
    assert save_replay is not None, "nothing to go on from was remembered"
    assert model.num_timesteps < 3 * 12 * n_envs + 1
    model.save(folder / "model.zip")
    save_replay(folder / "replay.npz")
    with np.load(folder / "replay.npz", allow_pickle=False) as arrays:
        for name in arrays.files:
            assert arrays[name].dtype.kind != "f" or np.isfinite(arrays[name]).all(), name
    if vector == "here":
        again = type(model).load(folder / "model.zip", env=make(vector, n_envs, None)[0])
        again.load_replay_buffer(folder / "replay.npz")
        again.learn(60, reset_num_timesteps=False)
        assert again.num_timesteps >= model.num_timesteps + 60


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(faults, "STEP_TIMEOUT", 1.0)
    yield
    for process in multiprocessing.active_children():
        process.kill()


def tried(vector: str) -> list[str]:
    return [name for name, fault in FAULTS.items() if vector == "processes" or fault.kind not in IN_PROCESSES_ONLY]


QUICK = [("tbc-hrl", "here", 1), ("tbc-hrl", "processes", 4), ("sac", "here", 4), ("sac", "processes", 1)]
WHOLE = [(algo, vector, n) for algo in ALGORITHMS for vector in VECTORS for n in (1, 4)]
CASES = [
    pytest.param(*case, id="-".join(map(str, case)), marks=[] if case in QUICK else pytest.mark.slow) for case in WHOLE
]


@pytest.mark.parametrize(("algo", "vector", "n_envs"), CASES)
def test_faults_are_named_and_the_state_is_saved(algo: str, vector: str, n_envs: int, tmp_path: Path) -> None:
    for name in tried(vector):
        stopped(algo, vector, n_envs, FAULTS[name], tmp_path)


@pytest.mark.parametrize("key", KEYS)
def test_processes_without_a_monitor(key: str, tmp_path: Path) -> None:
    for n_envs in (1, 3):
        stopped("tbc-hrl", "processes", n_envs, Fault("shape", key), tmp_path, monitored=False)
        stopped("tbc-hrl", "processes", n_envs, Fault("nan", key, step=0), tmp_path, monitored=False)


@pytest.mark.parametrize("fault", [f for f in FAULTS.values() if f.episode == 3], ids=str)
def test_the_first_reset(fault: Fault) -> None:
    """Before there is anything to save: named, at once."""
    fault = fault._replace(episode=1, step=0, always=True)
    for vector in ("dummy", "processes") if fault.kind not in IN_PROCESSES_ONLY else ("processes",):
        if fault.key == "reward":
            continue
        model = agent("tbc-hrl", make(vector, 2, fault)[0])
        with pytest.raises((EnvironmentFault, NonFiniteError), match=r"environment 1\b.* reset"):
            model.learn(50)


@pytest.mark.parametrize("vector", VECTORS)
@pytest.mark.parametrize("algo", ["tbc-hrl", "sac"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_episodes_may_end_with_the_step_before(algo: str, vector: str, n_envs: int, tmp_path: Path) -> None:
    for kind, key in [
        ("nan", "observation"),
        ("nan", "reward"),
        ("shape", "desired_goal"),
        ("infinite", "achieved_goal"),
    ]:
        env, index = make(vector, n_envs, Fault(kind, key, step=4))
        model = agent(algo, env, on_bad_step="end-episode")
        model.learn(150 * n_envs, log_interval=1)
        guard = model._guarded.guard if algo == "sac" else model.collector.env.guard
        assert guard.count == 1
        if algo == "sac":
            buffer = model.replay_buffer
            assert all(np.isfinite(part).all() for part in buffer.parts().values())
            lengths = {int(n) for n in buffer.ep_length[:, index]}
            assert 3 in lengths  # three good steps before the bad one
            rows = buffer.ep_length[: buffer.pos, index] == 3
            assert rows.sum() == 3
            assert buffer.ep_length[np.flatnonzero(rows)[-1] + 1, index] == 0  # the bad row belongs to no episode
            assert bool(buffer.timeouts[np.flatnonzero(rows)[-1], index])
        else:
            held = model.replay_buffer.low.data
            assert all(np.isfinite(part).all() for part in held.values())
        env.close()


def test_what_is_left_of_a_cut_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three good steps: an episode of three steps, its last window cut off; a bad first step leaves nothing."""
    monkeypatch.setattr(Faulty, "compute_terminated", lambda self, a, d, i: np.zeros(np.shape(a)[:-1], bool))
    for step, expected in [(4, 3), (1, 0)]:
        env, _ = make("here", 1, Fault("nan", step=step, episode=2))
        model = agent("tbc-hrl", env, on_bad_step="end-episode")
        episodes: list[Episode] = []
        monkeypatch.setattr(model, "store", Noting(model.store, episodes))
        model.learn(60)
        lengths = [episode.length for episode in episodes]
        assert (expected in lengths) == bool(expected), lengths
        assert 0 not in lengths
        for episode in episodes:
            assert sum(option.duration for option in episode.options) == episode.length
            assert not episode.success


class Noting:
    """Notes which episodes are stored."""

    def __init__(self, store: Any, episodes: list[Episode]) -> None:
        self.store, self.episodes = store, episodes

    def add(self, episode: Episode, goal_test: Any, progress: float) -> Any:
        self.episodes.append(episode)
        return self.store.add(episode, goal_test, progress)


def test_an_environment_that_always_fails_ends_the_run(caplog: pytest.LogCaptureFixture) -> None:
    env, _ = make("here", 2, Fault("nan", step=1, always=True))
    with pytest.raises((NonFiniteError, EnvironmentFault), match=r"environment 1, (step 1|reset)"):
        agent("tbc-hrl", env, on_bad_step="end-episode").learn(1000)
    bad = Fault("nan", "reward", step=1, always=True)
    for algo in ("tbc-hrl", "sac"):
        env, _ = make("here", 2, bad)
        caplog.clear()
        with pytest.raises(NonFiniteError, match="environment 1, step 1 of its episode: its reward is nan"):
            agent(algo, env, on_bad_step="end-episode").learn(1000)
        assert len([r for r in caplog.records if "Its episode ends with the step before" in r.message]) == 10
        assert "further ones are only counted" in caplog.text


def test_actions_that_are_not_finite_are_the_agents_own() -> None:
    env, _ = make("here", 2, None)
    model = agent("tbc-hrl", env).learn(40)
    model.collector.act = lambda: (np.full((2, 1), np.nan, np.float32), model.collector.membrane)
    with pytest.raises(
        NonFiniteError, match=r"environment 0, step \d+ of its episode: the action is not finite: \[nan\]"
    ):
        model.learn(40, reset_num_timesteps=False)


@pytest.mark.parametrize("algo", ["tbc-hrl", "sac"])
def test_in_evaluations(algo: str) -> None:
    model = agent(algo, make("here", 1, None)[0]).learn(40)
    with pytest.raises(NonFiniteError, match=r"environment 1, (step 4|reset).*'observation'. is not finite"):
        evaluate_agent(model, make("dummy", 2, Fault("nan", episode=1, always=True))[0], 10)
    bad = Fault("shape", "achieved_goal", step=2)
    model = agent(algo, make("here", 1, None)[0], on_bad_step="end-episode").learn(40)
    result = evaluate_agent(model, make("dummy", 2, bad)[0], 10)
    assert len(result.successes) == 10


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_command_ends_saved_and_is_resumed(algo: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["gradient_ratio:0.05", *(["batch_size:8"] if algo == "sac" else ["low.batch_size:8", "high.batch_size:8"])]
    small += [] if algo == "sac" else ["compile:false", "max_options:3"]
    arguments = ["--env", "faulty:FaultyCorridor-v0", "--algo", algo, "--n-timesteps", "400", "--eval-freq", "100000"]
    arguments += ["--n-final-episodes", "1", "--no-progress", "--keep-checkpoint", "--log-folder", str(tmp_path)]
    fault = ["env_kwargs.kind:nan", "env_kwargs.key:achieved_goal"]
    assert train.main([*arguments, "--hyperparams", *small, *fault]) == 1
    said = capsys.readouterr().err
    assert re.search(r"environment 0, step 4 of its episode: observation\['achieved_goal'\] is not finite", said), said
    assert "Saved at step" in said
    (folder,) = tmp_path.glob("*/*/*/seed_0")
    config = folder / "config.yml"
    config.write_text(config.read_text().replace("kind: nan", "kind: ''"))  # the environment is mended
    assert train.main(["--resume", str(folder), "--no-progress"]) == 0
    said = capsys.readouterr().out
    assert "success rate" in said
    ended = ["--on-bad-step", "end-episode", "--variant", "ended", "--hyperparams", *small, *fault]
    assert train.main([*arguments, *ended]) == 0


def test_a_fault_in_the_last_evaluation_is_one_line_and_can_be_tried_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--env", "faulty:FaultyCorridor-v0", "--n-timesteps", "60", "--eval-freq", "100000", "--no-progress"]
    arguments += ["--log-folder", str(tmp_path), "--n-final-episodes", "300", "--hyperparams", "compile:false"]
    arguments += ["max_options:3", "env_kwargs.kind:nan"]
    assert train.main(arguments) == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert "the evaluation after training failed: environment" in said[-1]
    (folder,) = tmp_path.glob("*/*/*/seed_0")
    config = folder / "config.yml"
    config.write_text(config.read_text().replace("kind: nan", "kind: ''"))
    assert train.main(["--resume", str(folder), "--no-progress"]) == 0
