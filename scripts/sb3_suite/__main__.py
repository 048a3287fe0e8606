"""Run Stable-Baselines3's own test suite with TBC-HRL, HiTS and HAC in the place of its algorithms.

    python scripts/sb3_suite path/to/stable-baselines3 [--algo hits] [--only save_load]

The argument is a checkout of Stable-Baselines3, as near the installed version as there is. Its tests are copied to a
temporary folder and run as they are; what differs is what they are run with:

* One algorithm of each test (SAC, where it is used) is one of ours. Settings that SB3 gives to an agent go to both of
  its levels; those that no level has are left out, or the case is skipped where it is about them.
* Environments become goal environments: the observation is ``observation``, its first two entries the achieved goal.
* Tests of images, of discrete actions and of what only SB3's own algorithms have are left out, see
  ``tests_left_out.py``, which says why for each.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ALGORITHMS = ("tbc-hrl", "hits", "hac")


def run(checkout: Path, algorithm: str, only: str, more: list[str]) -> dict[str, Any]:
    """Run the suite with one algorithm; how each case ends, why those that fail do, and what is left out."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result.json"
        shutil.copytree(checkout / "tests", Path(folder) / "tests")
        environment = {
            **os.environ,
            "SB3_SUITE_ALGO": algorithm,
            "SB3_SUITE_RESULT": str(result),
            "PYTHONPATH": str(Path(__file__).parent),
            "OMP_NUM_THREADS": "1",
            "MPLBACKEND": "Agg",
        }
        chosen = ["-k", only] if only else []
        plugins = ["-p", "suite_plugin", "-p", "no:cacheprovider", "-W", "ignore::DeprecationWarning"]
        command = [sys.executable, "-m", "pytest", "-qq", "--rootdir", folder, *plugins, *chosen, *more, "tests"]
        subprocess.run(command, cwd=folder, env=environment, check=False)
        told: dict[str, Any] = json.loads(result.read_text())
        return told


def print_table(outcomes: dict[str, list[str]], left_out: dict[str, str]) -> None:
    """How many cases of each test pass, and which tests do not apply and why."""
    run_at_all = {name: ends for name, ends in outcomes.items() if set(ends) != {"skipped"}}
    for name, ends in sorted(run_at_all.items()):
        print(f"{name}: {', '.join(f'{count} {end}' for end, count in collections.Counter(ends).items())}")
    for name, reason in sorted(left_out.items()):
        print(f"left out: {name}: {reason}")
    passed = [name for name, ends in run_at_all.items() if "failed" not in ends]
    cases = [end for ends in run_at_all.values() for end in ends if end != "skipped"]
    print(f"{len(passed)} of {len(run_at_all)} tests pass, {cases.count('passed')} of {len(cases)} cases")


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkout", type=Path, help="checkout of Stable-Baselines3")
    parser.add_argument("--algo", choices=ALGORITHMS, action="append", help="default: all three")
    parser.add_argument("--only", default="", help="as pytest's -k")
    options, more = parser.parse_known_args()
    outcomes: dict[str, list[str]] = collections.defaultdict(list)
    left_out: dict[str, str] = {}
    for algorithm in options.algo or ALGORITHMS:
        told = run(options.checkout, algorithm, options.only, more)
        left_out |= told["not_applicable"]
        for name, ends in told["results"].items():
            outcomes[name] += ends
        for case, why in told["why"].items():
            print(f"{algorithm}: {case}: {why}")
    print_table(outcomes, left_out)


if __name__ == "__main__":
    main()
