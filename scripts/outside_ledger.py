"""The commands behind the figures of the documentation that no run of the ledger holds.

``searches``: the two searches of settings, with their journals. They begin from the sections shipped now, which
hold what the former searches found. ``recordings``: the skills that circuits are taught by imitation. The agents behind
the shipped recordings were not kept; these commands train agents of the same kind and record them. ``sbx``: the column
SBX of docs/performance.md; it needs an environment of its own, since SBX brings JAX.

Without ``--run`` the commands are printed only.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
SEARCHED = ("low.learning_rate", "high.learning_rate", "tau", "*.temperature", "*.ent_coef", "*.target_entropy",
            "*n_hindsight_goals", "max_options", "ndbc.sub_steps")  # fmt: skip
SKILLS = ("AntFourRooms", "Drawbridge", "Pendulum", "UR5Reacher")
FANS_A1 = ("low.policy_kwargs.ndbc.sensory_fanout:3", "low.policy_kwargs.ndbc.inter_fanout:4")

Command = Sequence[str]


def searches() -> list[Command]:
    """Both searches, as results/notes/searches.md and results/notes/pendulum.md describe them."""
    shared = ("--n-seeds", "2", "--first-seed", "100", "--search-space")
    ur5 = ("--env", "UR5Reacher", "--n-trials", "35", "--n-timesteps", "45000", "--eval-freq", "5000", *shared,
           "results/searches/ur5reacher.yml", "--search", *SEARCHED, "batch_size")  # fmt: skip
    pendulum = ("--env", "Pendulum", "--n-trials", "32", "--n-timesteps", "60000", *shared,
                "results/searches/pendulum.yml", "--search", *SEARCHED, "--hyperparams", *FANS_A1)  # fmt: skip
    return [("sb3_tbc.tune", *arguments) for arguments in (ur5, pendulum)]


def recordings() -> list[Command]:
    """Train the agents whose low level is recorded, and record them."""
    commands: list[Command] = []
    for task in SKILLS:
        model = f"runs/skills/{task}/hits/full/seed_0/model.zip"
        commands.append(
            ("sb3_tbc.train", "--algo", "hits", "--env", task, "--seed", "0", "--log-folder", "runs/skills")
        )
        commands.append(("sb3_tbc.benchmark", "record", model, "--out", f"runs/skills/{task}.npz"))
    return commands


def sbx() -> list[Command]:
    """Training speed beside SB3 and SBX; install ``sbx-rl==0.28`` first, else its column is left out."""
    speed = ("sb3_tbc.benchmark", "train", "Pendulum", "Drawbridge", "--what", "speed", "--config")
    return [(*speed, config) for config in ("paper", "tuned")]


PARTS = {"searches": searches, "recordings": recordings, "sbx": sbx}


def main() -> None:
    """Print or run the commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"by default all: {', '.join(PARTS)}")
    parser.add_argument("--run", action="store_true", help="run them one after another; hours")
    args = parser.parse_args()
    if unknown := [part for part in args.parts if part not in PARTS]:
        parser.error(f"no part {unknown[0]!r}; there are {', '.join(PARTS)}")
    for part in args.parts or PARTS:
        for command in PARTS[part]():
            print(f"python -m {shlex.join(command)}", flush=True)
            if args.run:
                subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=True)


if __name__ == "__main__":
    main()
