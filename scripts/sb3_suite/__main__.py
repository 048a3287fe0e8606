"""Run Stable-Baselines3's own test suite with TBC-HRL, HiTS and HAC in the place of its algorithms.

    python scripts/sb3_suite path/to/stable-baselines3 [--algo hits] [--only save_load]

The argument is a checkout of Stable-Baselines3, as near the installed version as there is. Its tests are copied to a
temporary folder and run as they are; what differs is what they are run with:

* One algorithm of each test (SAC, where it is used) is one of ours. Settings that SB3 gives to an agent go to both of
  its levels; those that no level has are left out, or the case is skipped where it is about them.
* Environments become goal environments: the observation is ``observation``, its first two entries the achieved goal.
* Tests of SAC that ask for what there is not here on purpose are run with their arguments as they are: each case must
  pass or be refused in one line. Tests without SAC about what another algorithm has (PPO's clipping, DQN's target
  network) are run as they are. ``tests_apart.py`` names both.
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

from tests_apart import LEFT_OUT, REFUSED, UNTOUCHED

ALGORITHMS = ("tbc-hrl", "hits", "hac")


def run(checkout: Path, algorithm: str, only: str, more: list[str]) -> dict[str, Any]:
    """Run the suite with one algorithm; how each case ends, and why those end so that do not pass."""
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


def print_table(outcomes: dict[str, list[str]]) -> None:
    """How the cases of each test end, why what is not here is not, and the totals."""
    outcomes = {name: [end for end in ends if end != "skipped"] for name, ends in outcomes.items()}
    outcomes = {name: ends for name, ends in outcomes.items() if ends}
    for name, ends in sorted(outcomes.items()):
        reason = f" ({REFUSED[name]})" if "refused" in ends else " (as it is)" if name in UNTOUCHED else ""
        print(f"{name}: {', '.join(f'{count} {end}' for end, count in collections.Counter(ends).items())}{reason}")
    for name, reason in sorted(LEFT_OUT.items()):
        print(f"not run: {name}: {reason}")
    ours = {name: ends for name, ends in outcomes.items() if name not in UNTOUCHED}
    print(f"with our agents: {totals(ours)}")
    print(f"without an algorithm that they replace: {totals({n: e for n, e in outcomes.items() if n in UNTOUCHED})}")


def totals(outcomes: dict[str, list[str]]) -> str:
    """Numbers of tests that pass in all cases, are refused in some and pass in the others, and fail; and of cases."""
    counts = collections.Counter(next((e for e in ("failed", "refused") if e in ends), "passed")
                                 for ends in outcomes.values())  # fmt: skip
    cases = collections.Counter(end for ends in outcomes.values() for end in ends)
    return ", ".join(f"{counts[end]} tests {end} ({cases[end]} cases)" for end in ("passed", "refused", "failed"))


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkout", type=Path, help="checkout of Stable-Baselines3")
    parser.add_argument("--algo", choices=ALGORITHMS, action="append", help="default: all three")
    parser.add_argument("--only", default="", help="as pytest's -k")
    options, more = parser.parse_known_args()
    outcomes: dict[str, list[str]] = collections.defaultdict(list)
    for algorithm in options.algo or ALGORITHMS:
        told = run(options.checkout, algorithm, options.only, more)
        for name, ends in told["results"].items():
            outcomes[name] += ends
        for case, why in told["why"].items():
            print(f"{algorithm}: {case}: {why}")
    print_table(outcomes)


if __name__ == "__main__":
    main()
