#!/usr/bin/env python
"""Try every goal environment of Gymnasium-Robotics, panda-gym and highway-env, and write a table of what works.

Each environment trains for 1,500 steps with tiny settings, is evaluated, filmed and exported with ``--check``, or is
refused in one line. Success is not the point: 1,500 steps teach nothing. Example::

    python scripts/goal_environments.py --output docs/goal_environments.md

By default one id of each family and kind of reward is tried (the newest version, the smallest maze); ``--all`` tries
every id. Packages that are not installed are left out. What was found is kept in a file (``--results``), so that a
stopped run goes on where it was; ``--again`` tries what is in the file once more.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from sb3_tbc.tasks.foreign import import_quietly

from sb3_tbc.smdp.goal_spaces import GOAL_KEYS

PACKAGES = {"gymnasium_robotics": "Gymnasium-Robotics", "panda_gym": "panda-gym", "highway_env": "highway-env"}
STAGES = ("training", "evaluating", "filming", "exporting")
TINY = (
    "gradient_ratio:0.02", "low.batch_size:16", "high.batch_size:16", "compile:false", "subgoals.n_probe_steps:300",
)  # fmt: skip
LIMIT = 100
"""Time limit for environments that come without one, environment steps."""
SECONDS = 900
"""A trial that takes longer is ended."""
BROKEN = ("TRACEBACK", "DIED", "TIMEOUT")
"""Begins what is said of a trial that neither worked nor was refused."""
RESULTS = Path(__file__).parents[1] / "docs" / "goal_environments.json"


def goal_ids() -> list[str]:
    """Registered ids of goal environments, with their modules; of several versions the newest that can be made."""
    versions: dict[str, list[str]] = {}
    for env_id, spec in gym.registry.items():
        module = str(spec.entry_point).split(".")[0]
        if module in PACKAGES:
            versions.setdefault(f"{module}:{env_id.rsplit('-v', 1)[0]}", []).append(env_id)
    found = []
    for name, ids in versions.items():
        newest_first = sorted(ids, key=lambda i: -int(i.rsplit("-v", 1)[1]))
        usable = next((env_id for env_id in newest_first if _is_goal_env(env_id)), None)
        if usable is not None:
            found.append(f"{name.partition(':')[0]}:{usable}")
    return sorted(found)


def _is_goal_env(env_id: str) -> bool:
    try:
        env = gym.make(env_id)
    except Exception:  # Old versions need simulators that are not installed.
        return False
    space = env.observation_space
    env.close()
    return isinstance(space, spaces.Dict) and all(key in space.spaces for key in GOAL_KEYS)


def family(env_id: str) -> tuple[str, bool]:
    """Family of an id: body, task, and whether the reward is dense."""
    name = env_id.partition(":")[2].rsplit("-v", 1)[0]
    start = re.match(r"HandManipulate(Block|Egg|Pen)|[A-Za-z]+", name)
    return (start[0] if start else name).removesuffix("Dense"), "Dense" in name


def one_of_each(ids: Sequence[str]) -> dict[str, list[str]]:
    """The first id of each family (mazes by size), and the ids that it represents."""
    groups: dict[tuple[str, bool], list[str]] = {}
    for env_id in sorted(ids, key=lambda i: ("UMaze" not in i, len(i), i)):
        groups.setdefault(family(env_id), []).append(env_id)
    return {alike[0]: alike for _, alike in sorted(groups.items())}


# -- one environment, in a process of its own --------------------------------------------------------------------------


def attempt(env_id: str) -> dict[str, Any]:
    """Train, evaluate, film and export; return the result of each step, or the message that refused the environment."""
    from sb3_tbc import evaluate, export, train
    from sb3_tbc.export.command import main as export_main

    assert export is not None
    with tempfile.TemporaryDirectory() as name, _quiet() as printed:
        folder, short = Path(name), env_id.partition(":")[2]
        limit = [] if gym.spec(short).max_episode_steps else [f"env_kwargs.max_episode_steps:{LIMIT}"]
        watching = ("--n-timesteps", "1500", "--eval-freq", "1500", "--n-eval-episodes", "1", "--n-final-episodes", "2")
        where = ("--log-folder", str(folder), "--no-progress", "--hyperparams", *TINY, *limit)
        result: dict[str, Any] = {"id": env_id, "limit": bool(limit)}
        train_args = ["--algo", "tbc-hrl", "--env", env_id, *watching, *where]
        if _failed(result, "training", train.main, train_args, printed):
            return result
        model = next(folder.rglob("model.zip"))
        film, scores = folder / "film.mp4", folder / "scores.json"
        evaluation = [str(model), "--n-episodes", "2", "--json", str(scores), "--trust"]
        if _failed(result, "evaluating", evaluate.main, evaluation, printed):
            return result
        filming = [*evaluation, "--video", str(film), "--video-episodes", "1"]
        if not _failed(result, "filming", evaluate.main, filming, printed):
            result["film"] = film.stat().st_size
        exporting = [str(model), "--format", "numpy", "--output", str(folder / "policy.py"), "--check", "50", "--trust"]
        if not _failed(result, "exporting", export_main, exporting, printed):
            found = re.search(r"largest difference[^:]*: (\S+)", printed.getvalue())
            result["difference"] = found[1] if found else "?"
        return result


def _failed(
    result: dict[str, Any], stage: str, main: Callable[[Sequence[str]], int], argv: Sequence[str], printed: io.StringIO
) -> bool:
    """Run a command; record its last line if it failed."""
    printed.truncate(0)
    try:
        code = main(argv)
    except BaseException as error:  # Anything but a refusal in one line is what this script looks for.
        result[stage] = f"TRACEBACK {type(error).__name__}: {error}"
        return True
    if code:
        result[stage] = " ".join(printed.getvalue().strip().splitlines()[-1:])
    else:
        result[stage] = "yes"
    return bool(code)


@contextlib.contextmanager
def _quiet() -> Iterator[io.StringIO]:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        yield printed


# -- all of them -------------------------------------------------------------------------------------------------------


def run(env_id: str) -> dict[str, Any]:
    """:func:`attempt` in another process, which may die or hang."""
    environ = {"MUJOCO_GL": "egl", **os.environ}
    command = [sys.executable, __file__, "--one", env_id]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, env=environ, check=False)
    except subprocess.TimeoutExpired:
        return {"id": env_id, "training": f"TIMEOUT after {SECONDS} s"}
    lines = [line for line in done.stdout.splitlines() if line.startswith('{"id"')]
    if not lines:
        last = " ".join((done.stderr or done.stdout).strip().splitlines()[-1:])
        return {"id": env_id, "training": f"DIED with code {done.returncode}: {last}"}
    result: dict[str, Any] = json.loads(lines[-1])
    return result


def row(result: dict[str, Any], alike: Sequence[str]) -> str:
    """One line of the table."""
    name = f"`{result['id'].partition(':')[2]}`" + (f" (limit of {LIMIT} steps added)" if result.get("limit") else "")
    others = len(alike) - 1
    stages = [result.get(stage, "-") for stage in STAGES]
    if stages[0] not in ("yes", "-"):
        said = re.sub(r"^.*cannot be used( as a goal environment)?: ", "", stages[0])
        cells = [("" if said.startswith(BROKEN) else "refused: ") + said.replace("|", "/"), "", "", ""]
    else:
        cells = [stage if stage == "yes" else f"no: {stage}" for stage in stages]
        if result.get("difference"):
            cells[3] = f"yes, within {result['difference']}"
    return f"| {name} | {others or ''} | {' | '.join(cells)} |"


def summary(results: Sequence[dict[str, Any]]) -> str:
    """How many of the trials worked, and how many were refused."""
    whole = sum(all(result.get(stage) == "yes" for stage in STAGES) for result in results)
    refused = sum(result["training"] != "yes" and not result["training"].startswith(BROKEN) for result in results)
    broken = len(results) - whole - refused
    rest = f", {broken} are broken" if broken else ""
    return f"Of {len(results)} families tried, {whole} do all four, {refused} are refused{rest}."


def page(rows: Sequence[tuple[str, str]], skipped: Sequence[str], missing: int, said: str = "") -> str:
    """The table as a page.

    :param rows: module and line
    :param skipped: packages that are not installed
    :param missing: families still to be tried
    :param said: a summary
    """
    head = (
        "# Goal environments of other packages\n\n"
        "This page lists goal environments of other packages that were tried with this package. Each one either\n"
        "trained for 1,500 steps with tiny settings, was evaluated, filmed and exported, or was refused in one\n"
        "line that says why. One id stands for its family and kind of reward; the second column counts the ids\n"
        "like it. *exports* gives the largest difference between the actions of the exported NumPy policy and the\n"
        "agent's. How to use such an environment: [Add your own task](your_task.md).\n"
        "`python scripts/goal_environments.py --output docs/goal_environments.md` makes this page.\n"
    )
    parts = [head, f"\n{said}\n"] if said else [head]
    for module, package in PACKAGES.items():
        lines = [line for home, line in rows if home == module]
        if lines:
            table = "| id | ids like it | trains | evaluates | films | exports |\n|---|---|---|---|---|---|\n"
            parts.append(f"\n## {package} (`{module}`)\n\n{table}" + "\n".join(lines) + "\n")
    if missing:
        parts.append(f"\nNot tried yet: {missing} more families.\n")
    if skipped:
        parts.append(f"\nNot installed, so not tried: {', '.join(skipped)}.\n")
    return "".join(parts)


def main() -> None:
    """Make the table; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="the page to write; by default it is printed")
    parser.add_argument("--all", action="store_true", help="try every id, not one of each family")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FILE", help="(default: %(default)s)")
    parser.add_argument("--again", action="store_true", help="try those ids, too, whose results are known")
    parser.add_argument("--most", type=int, metavar="N", help="stop after so many ids; the next call goes on")
    parser.add_argument("--only", default="", metavar="TEXT", help="ids that contain this text")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        import_quietly(args.one.partition(":")[0])
        print(json.dumps(attempt(args.one)))
        return
    warnings.simplefilter("ignore")
    gym.logger.min_level = gym.logger.ERROR
    skipped = []
    for module, package in PACKAGES.items():
        try:
            import_quietly(module)
        except ImportError:
            skipped.append(package)
    ids = [env_id for env_id in goal_ids() if args.only in env_id]
    chosen = {env_id: [env_id] for env_id in ids} if args.all else one_of_each(ids)
    found: dict[str, dict[str, Any]] = json.loads(args.results.read_text()) if args.results.is_file() else {}
    waiting = [env_id for env_id in chosen if args.again or env_id not in found]
    for env_id in waiting[: args.most]:
        found[env_id] = run(env_id)
        print(json.dumps(found[env_id]), file=sys.stderr, flush=True)
        args.results.write_text(json.dumps(dict(sorted(found.items())), indent=1) + "\n", encoding="utf-8")
    rows = [(i.partition(":")[0], row(found[i], alike)) for i, alike in chosen.items() if i in found]
    text = page(rows, skipped, len(chosen) - len(rows), summary([found[i] for i in chosen if i in found]))
    if args.output is None:
        print(text)
    else:
        args.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
