"""Runs as the ledger has them, made up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_tbc.zoo.ledger import RunFolder, curve_summary, to_json


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
    lines += [f"{1000 * i},{y},10000,10,0.5,4,{i}" for i, y in enumerate(rates, 1)]
    folder.evaluations.write_text("\n".join(lines) + "\n")
    identity = {"task": task, "algo": algo, "variant": variant, "config": "tuned", "seed": seed, "success_rate": rate}
    rest = {"mean_length_success": 10.0, "subgoal_success": 0.5, "mean_window": 4.0}
    rest |= curve_summary(folder.read_evaluations())
    counts = {"n_episodes": 100, "n_timesteps": max(4000, 1000 * len(rates)), "wall_time": 120.0}
    counts["eval_seed"] = 2_000_000 + 1000 * seed
    folder.finish({**identity, **counts, **rest, **final})
    return folder


def small_ledger(root: Path) -> None:
    """A few runs of all kinds: equal and unequal conditions, ties, failures, constant rows, variants and ablations."""
    levels = {"high": {"average_decay": 0.999, "gradient_ratio": 0.25}, "low": {"average_decay": 0.999}}
    equal = {"model": levels, "n_timesteps": 4000}
    slower = {"model": {"high": {"gradient_ratio": 0.5, "average_decay": 0.999}, "gradient_ratio": 2.0}}
    paper = {**equal, "model": {**levels, "target": "decision", "memory": None}}
    for seed, rate in enumerate((1.0, 0.97, 0.95), 100):
        outcomes = "".join("0" if i % 20 == 0 and i < 2000 * (1 - rate) - 1 else "1" for i in range(100))
        quick = [0.5, 0.95, rate, rate]
        fake_run(root, "Pendulum", "tbc-hrl", seed, rate, config=equal, outcomes=outcomes, curve=quick)
        theirs, commit = round(0.9 * rate, 2), "0123abcd" + "+" * (seed == 101)
        fake_run(root, "Pendulum", "hits", seed, theirs, config=equal, commit=commit)
        fake_run(root, "Pendulum", "tbc-hrl", seed, 0.5, variant="no-ndbc", config=equal, curve=[0.1, 0.5, 0.95, 0.5])
        fake_run(root, "Drawbridge", "tbc-hrl", seed, 1.0, config=equal, curve=[1.0, 0.5, 1.0, 1.0], outcomes="1" * 100)
        fake_run(root, "Drawbridge", "hits", seed, 1.0, config=slower, curve=[1.0, 1.0, 1.0, 1.0])
        fake_run(root, "Platforms", "tbc-hrl", seed, 0.2, config=equal)
        fake_run(root, "Platforms", "hits", seed, 0.1, config=equal)
    for seed in (100, 101):
        fake_run(root, "Pendulum", "sac", seed, 0.0, config={**slower, "n_envs": 4}, mean_length_success=None)
        fake_run(root, "Drawbridge", "hac", seed, 0.25, outcomes="0001" * 25, wall_time=None, commit="0123abcd+")
        steps = {"n_timesteps": 40 * seed, "outcomes": "0111" * 25}
        fake_run(root, "Drawbridge", "tbc-hrl", seed, 0.75, variant="another", config=paper, **steps)
    unknown = fake_run(root, "Pendulum", "tbc-hrl", 7, 0.5, variant="full-paper", config=paper, n_episodes=0)
    (unknown.path / "versions.json").unlink()
    failed = root / "Drawbridge" / "sac" / "full" / "seed_100"
    failed.mkdir(parents=True)
    (failed / "failed.json").write_text("{}")
    (root / "descriptions.yml").write_text("Pendulum:\n  tbc-hrl: as it is | shipped\n")
    (root / "tuning_seeds.yml").write_text("Drawbridge:\n  hits: [100, 101, 102]\n")
    rows = "  - {task: Pendulum, seeds: 4, n_timesteps: 4000, methods: [tbc-hrl, hac]}\n"
    (root / "campaign.yml").write_text(f"first_seed: 100\noptions: [--n-eval-episodes, '10']\nruns:\n{rows}")
