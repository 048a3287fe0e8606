"""Readers fuzzed by atheris, which looks for inputs that take new ways through their code; skipped without it."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

READERS = ("agent", "arrays", "yaml", "hyperparams", "search", "wiring", "plain", "evaluations")
SCRIPT = Path(__file__).with_name("guided.py")


def torture_guided(root: Path, number: int, first: int) -> tuple[int, int]:
    """``number`` inputs for each reader, 10,000 by default; ``first`` seeds them."""
    if importlib.util.find_spec("atheris") is None:
        print("   atheris is not installed (pip install atheris): left out", flush=True)
        return 0, 0
    good, number = 0, number or 10_000
    chosen = os.environ.get("FUZZ_KINDS", ",".join(READERS)).split(",")
    for reader in chosen:
        corpus = root / reader
        corpus.mkdir()
        line = [sys.executable, str(SCRIPT), reader, str(corpus), f"-runs={number}", f"-seed={first + 1}"]
        line += ["-timeout=20", "-max_len=4000", f"-artifact_prefix={corpus}/found-"]
        done = subprocess.run(line, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        said = re.findall(r"Done (\d+) runs|DONE +cov: (\d+)", done.stdout + done.stderr)
        good += number if done.returncode == 0 and said else 0
        ways = re.findall(r"cov: (\d+)", done.stderr)
        told = f"{number} runs, {ways[-1] if ways else 0} places of the code reached"
        print(f"   {reader}: {told if done.returncode == 0 else done.stderr[-1500:]}", flush=True)
    return len(chosen) * number, good
