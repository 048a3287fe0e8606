"""Whether 2N steps are N steps and N more, to the bit: by the command and by Python."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, Literal

from injection import differences, recorded, run, tensors, the_run

from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.zoo.algorithms import algorithm
from sb3_tbc.zoo.callbacks import SuccessEvalCallback
from sb3_tbc.zoo.config import parse_overrides
from sb3_tbc.zoo.environments import make_envs

TASK = "faulty:FaultyCorridor-v0"
"""Nothing fails in it; its episodes are short, so that there is much to learn from."""
LEVEL = ["batch_size:16", "learning_rate:1e-3"]
HALF = 250
"""N, steps of each environment."""
Way = Literal["command", "loaded", "same object"]


def settings(algo: str, compile: bool) -> list[str]:
    """Small, and the same at every step: a rate that falls with the run's length would not be."""
    if algo == "sac":
        return ["gradient_ratio:0.06", "learning_starts:100", "buffer_size:8000", *LEVEL]
    levels = [f"{level}.{setting}" for level in ("low", "high") for setting in LEVEL]
    return ["gradient_ratio:0.06", "max_options:3", f"compile:{str(compile).lower()}", *levels]


def by_command(root: Path, algo: str, n_envs: int, compile: bool) -> list[str]:
    """What differs between ``train --n-timesteps 2N`` and N steps that ``--resume --n-timesteps 2N`` continues."""
    root.mkdir(parents=True, exist_ok=True)
    steps = HALF * n_envs
    watched = ["--eval-freq", steps // 2, "--n-eval-episodes", 1, "--n-final-episodes", 1, "--no-progress", "--trace"]
    fixed = ["--hyperparams", *settings(algo, compile), "--env", TASK, "--algo", algo, "--n-envs", n_envs]
    fixed += [*watched, "--keep-checkpoint"]
    for name, total in {"whole": 2 * steps, "halves": steps}.items():
        arguments = [*fixed, "--n-timesteps", total, "--log-folder", root / name]
        _succeed(arguments, root / f"{name}.log")
    whole, halves = the_run(root / "whole"), the_run(root / "halves")
    assert whole is not None
    assert halves is not None
    more = ["--resume", halves, "--n-timesteps", 2 * steps, "--no-progress", "--trace", "--keep-checkpoint"]
    _succeed(more, root / "halves.log")
    return differences(whole, halves)


def _succeed(arguments: list[Any], log: Path) -> None:
    status = run(arguments, log)
    if status != 0:
        raise AssertionError(f"exit status {status}: {log.read_text()[-1000:]}")


def by_python(root: Path, algo: str, n_envs: int, compile: bool, way: Way = "loaded") -> list[str]:
    """What differs between ``learn(2N)`` and ``learn(N)`` twice, with saving and loading between or without."""
    steps = HALF * n_envs
    parts = [_learned(root / "whole", algo, n_envs, compile, [2 * steps], way),
             _learned(root / "halves", algo, n_envs, compile, [steps, steps], way)]  # fmt: skip
    return sorted(name for name in parts[0].keys() | parts[1].keys() if parts[0].get(name) != parts[1].get(name))


def _learned(folder: Path, algo: str, n_envs: int, compile: bool, steps: list[int], way: Way) -> dict[str, Any]:
    folder.mkdir(parents=True)
    env = make_envs(TASK, n_envs, 5)
    arguments = parse_overrides(settings(algo, compile))
    model: Any = algorithm(algo)("MultiInputPolicy", env, seed=0, **arguments)
    for part, count in enumerate(steps):
        if part and way == "loaded":
            model.save(folder / "model.zip")
            model.save_replay_buffer(folder / "replay.npz")
            model = algorithm(algo).load(folder / "model.zip", env=make_envs(TASK, n_envs, 77))
            model.load_replay_buffer(folder / "replay.npz")
        watch = SuccessEvalCallback(make_envs(TASK, 1, 9), 2 * sum(steps) // 4, 1, csv_path=folder / "evaluations.csv")
        model.learn(count, callback=watch, reset_num_timesteps=not part)
    return contents_of(model, folder)


def contents_of(model: Any, folder: Path) -> dict[str, Any]:
    """Parameters, optimisers, replay, random streams, running episodes, evaluations."""
    found: dict[str, Any] = {f"parameters{name}": x for name, x in tensors(model.get_parameters()).items()}
    if isinstance(model, FlatSAC):
        rows = model.replay_buffer.pos
        found |= {f"replay.{name}": part[:rows].tobytes() for name, part in model.replay_buffer.parts().items()}
    else:
        for name, buffer in model.replay_buffer._asdict().items():
            found |= {f"{name}.{key}": array[: buffer.size()].tobytes() for key, array in buffer.data.items()}
    state = model.learning_state()
    steps = state.get("collector.recorder.steps", ())
    found |= {f"state.{name}": recorded(f".{name}", array, steps).tobytes() for name, array in state.items()}
    with (folder / "evaluations.csv").open() as file:
        found["evaluations"] = [{k: v for k, v in row.items() if k != "wall_time"} for row in csv.DictReader(file)]
    found["counts"] = (model.num_timesteps, model._n_updates, model._episode_num)
    return found
