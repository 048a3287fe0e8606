"""Make the trained agents that come with the package, with their model cards: ``make pretrained``.

Each agent is trained with the shipped settings (a finished run in the runs' folder is not repeated), evaluated on
episodes that neither training nor its evaluations saw, and copied to ``sb3_tbc/pretrained``. ``--resave`` only loads
and saves the agents that are there, which brings them to the present file format and evaluates them again.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import sb3_tbc
from sb3_tbc import train
from sb3_tbc.evaluate import evaluate, identify
from sb3_tbc.files import save_atomic, write_atomic
from sb3_tbc.pretrained import FOLDER, pretrained_names
from sb3_tbc.zoo.algorithms import load_model
from sb3_tbc.zoo.ledger import RunFolder

EPISODES, FIRST_SEED = 200, 60_000_000


class Recipe(NamedTuple):
    """How an agent is made."""

    n_timesteps: int
    failings: str
    algo: str = "tbc-hrl"
    seed: int = 7
    settings: str = "the shipped ones"


# of the files that are there; to be taken out when an agent is trained again
EARLIER = "the shipped ones of before hindsight cuts (`n_hindsight_cuts: 0`)"

RECIPES = {
    "Pendulum": Recipe(
        100_000,
        "Few subgoals are reached within their tolerance: the low level is driven towards them rather than brought to "
        "them. Every unit matters: clamping one of the most active neurons ends nearly all success.",
        settings=EARLIER,
    ),
    "Drawbridge": Recipe(
        400_000,
        "Nothing in this task is random: all episodes are the same, so success shows one learnt manoeuvre and its "
        "interval says nothing about other starts. A bridge of another speed is no part of training.",
        settings=f"{EARLIER}, with timed windows (`window_end: timed`)",
    ),
    "UR5Reacher": Recipe(
        150_000,
        "It was tried on the task's own goals alone: pan beyond 45 degrees, lift and elbow within 45 degrees.",
        settings=EARLIER,
    ),
    "Platforms": Recipe(500_000, "Starts are always the same; only the goal's place on the ledge varies."),
    "AntFourRooms": Recipe(
        1_000_000,
        "Some episodes fail: the ant uses up its decisions on the way. It misses more than half of its subgoals: the "
        "low level is driven towards them rather than brought to them. It is the best of three seeds.",
        seed=102,
        settings="the shipped ones, with a shorter average of the weights (`average_decay: 0.999`)",
    ),
    "Tennis2D": Recipe(
        3_000_000,
        "About three episodes of four fail; no method that was tried here does much better (the published HiTS policy "
        "has .58). One subgoal in eight is reached within its tolerance.",
        seed=100,
    ),
}


def main() -> int:
    """Make or re-save agents."""
    parser = argparse.ArgumentParser("pretrained", description=__doc__)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"by default all: {', '.join(RECIPES)}")
    parser.add_argument("--runs", type=Path, default=Path("runs/pretrained"), help="folder of the training runs")
    parser.add_argument("--resave", action="store_true", help="no training: load, save and evaluate what is there")
    args = parser.parse_args()
    for task in args.tasks or (pretrained_names() if args.resave else RECIPES):
        if task not in RECIPES:
            parser.error(f"no recipe for {task!r}; there are {', '.join(RECIPES)}")
        path = FOLDER / f"{task}.zip" if args.resave else trained(task, RECIPES[task], args.runs)
        publish(task, RECIPES[task], path)
    return 0


def trained(task: str, recipe: Recipe, runs: Path) -> Path:
    """The agent of a finished run; the run is started or resumed if it is not finished."""
    folder = RunFolder.for_run(runs, task, recipe.algo, "full", recipe.seed)
    if not (folder.path / "final.json").is_file():
        going_on = ["--resume", str(folder.path)] if folder.path.is_dir() else []
        start = ["--algo", recipe.algo, "--env", task, "--seed", str(recipe.seed), "--log-folder", str(runs)]
        start += ["--n-timesteps", str(recipe.n_timesteps)]
        if status := train.main(going_on or start):
            sys.exit(status)
    return folder.model


def publish(task: str, recipe: Recipe, path: Path) -> None:
    """Save an agent into the package, evaluate the file and write its card."""
    target = FOLDER / f"{task}.zip"
    save_atomic(load_model(path).save, target)
    info = identify(target, None)
    result = evaluate(target, info, EPISODES, FIRST_SEED, stochastic=False, device="cpu")
    write_atomic(target.with_suffix(".md"), card(task, recipe, info, result))
    print(f"{target}: {target.stat().st_size // 1000} kB, success {result['success_rate']:.3f}")


def card(task: str, recipe: Recipe, info: dict[str, Any], result: dict[str, Any]) -> str:
    """The model card."""
    low, high = result["success_ci95"]
    kwargs = json.dumps(info["env_kwargs"])
    return f"""# {task}, {info["algo"]}

| | |
|---|---|
| environment | `{info["env_id"]}`, arguments `{kwargs}` |
| algorithm | {info["algo"]}, variant {info["variant"]}, `--config {info["config"]}` of this package's settings |
| settings | {recipe.settings} |
| seed, steps | {info["seed"]}; {result["n_timesteps"]:,} environment steps |
| success | **{result["success_rate"]:.3f}** (95 % Wilson interval {low:.3f} to {high:.3f}; {result["n_episodes"]} \
episodes that training did not see, deterministic) |
| subgoals reached | {_share(result["subgoal_success"])} of windows |
| mean length of an episode | {result["mean_length"]:.0f} steps |
| made with | sb3_tbc {sb3_tbc.__version__}, `python scripts/pretrained.py {task}` |
| licence | MIT, as the package |

Use: `sb3_tbc.load_pretrained("{task}")`, or `python -m sb3_tbc.evaluate pretrained:{task}`.

Known failings: {recipe.failings}

This is one seed, for looking at and for trying the tools; it is no benchmark result and has never moved a real machine.
"""


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


if __name__ == "__main__":
    sys.exit(main())
