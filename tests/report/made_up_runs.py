"""Runs as the ledger has them, made up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_tbc.zoo.ledger import RunFolder, to_json


def fake_run(
    root: Path,
    task: str,
    algo: str,
    seed: int,
    rate: float,
    variant: str = "full",
    curve: Sequence[float] | None = None,
    config: Mapping[str, Any] | None = None,
    commit: str = "0123abcd",
    **final: Any,
) -> RunFolder:
    """A finished run; its curve rises to ``rate`` over four evaluations unless another is given."""
    folder = RunFolder.for_run(root, task, algo, variant, seed)
    settings = {"n_timesteps": 4000, "n_envs": 1, "n_eval_episodes": 10, "n_final_episodes": 100, **(config or {})}
    folder.start(settings, f"python -m sb3_tbc.train --algo {algo} --seed {seed}")
    versions = {"packages": {"torch": "9.9"}, "commit": commit, "python": "3.11.7", "cpu": "Abacus"}
    (folder.path / "versions.json").write_text(to_json(versions))
    lines = ["timesteps,success_rate,episodes,mean_length,subgoal_success,mean_window,wall_time"]
    rates = [rate * i / 4 for i in range(1, 5)] if curve is None else curve
    lines += [f"{1000 * i},{y},10,10,0.5,4,{i}" for i, y in enumerate(rates, 1)]
    folder.evaluations.write_text("\n".join(lines) + "\n")
    identity = {"task": task, "algo": algo, "variant": variant, "config": "tuned", "seed": seed, "success_rate": rate}
    rest = {"mean_length_success": 10.0, "subgoal_success": 0.5, "mean_window": 4.0, "stable_share": 1.0}
    counts = {"n_episodes": 100, "n_timesteps": 4000, "wall_time": 120.0, "eval_seed": 2_000_000 + 1000 * seed}
    folder.finish({**identity, **counts, **rest, "worst_after_first_90": None, **final})
    return folder
