"""The minutes that ``train --list`` prints, computed from the ledger."""

from __future__ import annotations

from collections import Counter

import numpy as np
import yaml

from sb3_tbc.report.runs import OURS, Results

HEADER = "# Written by: python -m sb3_tbc.report --measured. Runs of tbc-hrl with the shipped settings in the ledger.\n"


def measured_yaml(results: Results) -> str:
    """Steps, mean minutes and number of our finished runs of each task, as YAML.

    Of runs with different numbers of steps, those with the commonest number count, among equals with the largest.
    """
    tasks = {}
    for task, methods in results.items():
        finals = [run.final for run in methods.get(OURS, [])]
        runs = [final for final in finals if final.get("wall_time") and final.get("n_timesteps")]
        if runs:
            counts = Counter(int(run["n_timesteps"]) for run in runs)
            steps = max(counts, key=lambda steps: (counts[steps], steps))
            runs = [run for run in runs if run["n_timesteps"] == steps]
            tasks[task] = {
                "steps": steps,
                "minutes": round(float(np.mean([run["wall_time"] for run in runs])) / 60, 1),
                "seeds": len(runs),
            }
    return HEADER + yaml.safe_dump({"tasks": tasks}, sort_keys=True)
