"""Rerun the table of docs/reliability.md: runs that are killed, stopped or out of disk space, and damaged inputs.

    python scripts/torture.py halves             2N steps are N steps, saved, loaded, and N more
    python scripts/torture.py changes            killed before every system call that changes the run's folder
    python scripts/torture.py kill --number 100  kill -9 at random moments
    python scripts/torture.py stop --number 50   SIGTERM, SIGINT and SIGHUP at random moments
    python scripts/torture.py disk               a full disk: files and file systems of limited size
    python scripts/torture.py twice              two runs of one seed
    python scripts/torture.py fuzz --number 10000     nonsense for every reader, and damaged files
    python scripts/torture.py guided --number 10000   nonsense that atheris finds by watching the code
    python scripts/torture.py tune --number 30   workers and parents of a search killed at random
    python scripts/torture.py long               five million steps: memory, speed, files
    python scripts/torture.py all

Each prints one line: what, tried, survived with nothing lost, and the command. ``--first`` goes on where an earlier
part ended: ``kill --first 40 --number 20`` are trials 40 to 59.
"""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "scripts"), *(str(ROOT / "tests" / name) for name in ("reliability", "tune", "."))]
os.environ.setdefault("OMP_NUM_THREADS", "1")

from tortures import fuzz, guided_runs, long, runs, searches  # noqa: E402 (they need the path)

TORTURES: dict[str, Callable[[Path, int, int], tuple[int, int]]] = {
    "halves": runs.torture_halves,
    "changes": runs.torture_changes,
    "kill": runs.torture_kill,
    "stop": runs.torture_stop,
    "disk": runs.torture_disk,
    "twice": runs.torture_twice,
    "fuzz": fuzz.torture_fuzz,
    "guided": guided_runs.torture_guided,
    "tune": searches.torture_tune,
    "long": long.torture_long,
}


def main() -> int:
    """Run the requested tests; return 0 if all passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=[*TORTURES, "all"])
    parser.add_argument("--number", type=int, default=0, help="how many; by default as the table says")
    parser.add_argument("--first", type=int, default=0, help="the first trial; those before it were done earlier")
    parser.add_argument("--folder", type=Path, help="for the runs; by default a temporary one")
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    all_good = True
    for what in TORTURES if args.what == "all" else [args.what]:
        root = Path(tempfile.mkdtemp(prefix=f"torture-{what}-", dir=args.folder))
        tried, survived = TORTURES[what](root, args.number, args.first)
        all_good &= tried == survived
        part = f" --number {args.number}" if args.number else ""
        part += f" --first {args.first}" if args.first else ""
        print(f"| {what} | {tried} | {survived} | `python scripts/torture.py {what}{part}` |", flush=True)
        if tried == survived:
            shutil.rmtree(root)
    return 0 if all_good else 1


if __name__ == "__main__":
    sys.exit(main())
