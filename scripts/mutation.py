"""How many faults the tests catch: mutmut changes single lines of the reporting chain, and the tests of each run.

The package is copied first; the working tree is left alone. ``--digits`` takes a sample: mutants of each function are
numbered from 1, and those whose number ends in one of these digits are tried. All ten digits take hours.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = ("sb3_tbc", "tasks", "zoo_configs", "tests", "results", "docs", "setup.cfg", "pyproject.toml", "README.md")
SUBJECTS = {
    "stats": (["sb3_tbc/stats.py"], ["tests/test_stats.py"]),
    "report": (
        ["sb3_tbc/report/claims.py", "sb3_tbc/report/comparisons.py", "sb3_tbc/report/conditions.py",
         "sb3_tbc/report/departures.py", "sb3_tbc/report/planned.py", "sb3_tbc/report/runs.py",
         "sb3_tbc/report/tables.py"],
        [f"tests/report/test_{name}.py" for name in ("conditions", "departures", "planned", "tables")],
    ),
    "hindsight": (["sb3_tbc/smdp/hindsight.py"], ["tests/smdp/test_hindsight.py"]),
    "buffers": (["sb3_tbc/replay/buffers.py"], ["tests/replay/test_buffers.py", "tests/tbc_hrl/test_reachability.py"]),
    "evaluation": (["sb3_tbc/tbc_hrl/evaluation.py"], ["tests/tbc_hrl/test_evaluation.py"]),
}  # fmt: skip
"""Name -> modules that are changed, and the tests that ought to notice."""
LIVED, UNTRIED, BY_NO_TEST = 0, None, 33
"""Exit codes in mutmut's records; all others are ways in which tests noticed a mutant."""


class Score(NamedTuple):
    """Mutants that were tried, and the names of those that no test noticed."""

    tried: int
    alive: list[str]

    def __str__(self) -> str:
        caught = self.tried - len(self.alive)
        return f"{caught} of {self.tried} caught ({caught / self.tried:.0%})" if self.tried else "none tried"


def score_of(exit_codes: Mapping[str, int | None]) -> Score:
    """The score of mutants by name and exit code, as mutmut records them."""
    tried = {name: code for name, code in exit_codes.items() if code is not UNTRIED}
    return Score(len(tried), sorted(name for name, code in tried.items() if code in (LIVED, BY_NO_TEST)))


def mutate(name: str, digits: str, minutes: float) -> tuple[Score, dict[str, str]]:
    """Try mutants of a subject in a copy of the package, for so many minutes at most.

    :return: the score, and what those that lived had changed
    """
    modules, tests = SUBJECTS[name]
    settings = {
        "source_paths": ["sb3_tbc"],
        "only_mutate": modules,
        "also_copy": [part for part in COPIED if part not in ("sb3_tbc", "pyproject.toml")],
        "pytest_add_cli_args_test_selection": tests,
        "pytest_add_cli_args": ["-p", "no:cacheprovider"],
    }
    with tempfile.TemporaryDirectory() as folder:
        for part in COPIED:
            copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
            copy(ROOT / part, Path(folder, part))
        lines = [f"{key} = {json.dumps(value)}" for key, value in settings.items()]  # JSON lists are TOML lists
        with Path(folder, "pyproject.toml").open("a", encoding="utf-8") as file:
            file.write("\n".join(["", "[tool.mutmut]", *lines, ""]))
        command = [sys.executable, "-m", "mutmut", "run", "--max-children", "1", *(f"*mutmut_*{d}" for d in digits)]
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60 * minutes)
            if done.returncode:
                raise SystemExit(f"mutmut failed on {name}: {(done.stdout + done.stderr)[-500:]}")
        except subprocess.TimeoutExpired:
            print(f"{name}: stopped after {minutes:g} minutes; the score is of the mutants tried until then")
        records = [json.loads(path.read_text(encoding="utf-8")) for path in Path(folder, "mutants").rglob("*.meta")]
        score = score_of({mutant: code for record in records for mutant, code in record["exit_code_by_key"].items()})
        return score, {mutant: changed_lines(mutant, folder) for mutant in score.alive}


def changed_lines(mutant: str, folder: str) -> str:
    """The lines that a mutant takes away and adds."""
    command = [sys.executable, "-m", "mutmut", "show", mutant]
    shown = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.splitlines()
    return "\n".join(line for line in shown if line.startswith(("+", "-")) and not line.startswith(("+++", "---")))


def main() -> None:
    """Print the score of each subject, and the mutants that lived."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subjects", nargs="*", metavar="SUBJECT", help=f"by default all: {', '.join(SUBJECTS)}")
    parser.add_argument("--digits", default="1", help="last digits of the numbers of the mutants tried (default: 1)")
    parser.add_argument("--minutes", type=float, default=20.0, help="longest time for one subject (default: 20)")
    args = parser.parse_args()
    if unknown := [name for name in args.subjects if name not in SUBJECTS]:
        parser.error(f"no subject {unknown[0]!r}; there are {', '.join(SUBJECTS)}")
    if not args.digits.isdigit():
        parser.error(f"--digits must be digits, e.g. 147, got {args.digits!r}")
    for name in args.subjects or SUBJECTS:
        score, changed = mutate(name, args.digits, args.minutes)
        print(f"{name:<12}{score}", flush=True)
        for mutant, lines in changed.items():
            print(f"    lived  {mutant}\n{lines}", flush=True)


if __name__ == "__main__":
    main()
