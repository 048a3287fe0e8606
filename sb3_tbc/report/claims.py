"""Checks the paper's claims against the runs of the ledger, each with its comparison."""

from __future__ import annotations

from typing import NamedTuple

from sb3_tbc import stats
from sb3_tbc.report.comparisons import Row, against_ablations, against_baselines, strongest_baselines
from sb3_tbc.report.runs import OURS, Results, stable_shares

TIMING_TASKS = ("Drawbridge", "Platforms", "Tennis2D")
SPATIAL_TASKS = ("AntFourRooms", "UR5Reacher")
ABLATION_CLAIMS = {
    f"{OURS} no-ts": ("needs timed subgoals where timing matters", TIMING_TASKS),
    f"{OURS} no-ndbc": ("needs the circuit where space is complex", SPATIAL_TASKS),
}
HOLDS, SAME, OPPOSITE = "holds", "no difference shown", "the opposite"
SOONER = {True: "sooner, not tested", False: "not sooner, not tested", None: "not decided: too few steps"}


class Claim(NamedTuple):
    """A claim on one task, with its verdict and evidence."""

    text: str
    task: str
    verdict: str
    evidence: str


def verdict(difference: float, test: stats.Comparison) -> str:
    """Verdict of a comparison: a direction only if the corrected p-value is below 0.05."""
    if test.p_holm is None or test.p_holm >= 0.05:
        return SAME if not test.note else f"{SAME} ({test.note})"
    return HOLDS if difference > 0 else OPPOSITE


def _of_row(text: str, row: Row) -> Claim:
    p_value = "no test" if row.test.p_holm is None else f"p (Holm) {row.test.p_holm:.3g}"
    low, high = row.interval.low, row.interval.high
    evidence = f"{row.test.difference:+.3f} ({low:+.3f} to {high:+.3f}) against {row.other}; {p_value}"
    evidence += f"; unequal {'; '.join(row.unequal)}" if row.unequal else ""
    return Claim(text, row.task, verdict(row.test.difference, row.test), evidence)


def _stability(results: Results) -> list[Claim]:
    rivals = {task: strongest_baselines(methods) for task, methods in results.items() if OURS in methods}
    ours: dict[tuple[str, str], list[float]] = {}
    theirs: dict[tuple[str, str], list[float]] = {}
    for task, name in ((task, name) for task, names in rivals.items() for name in names):
        sides = stable_shares(results[task][OURS]), stable_shares(results[task][name])
        if all(sides):
            ours[task, name], theirs[task, name] = sides
    found: list[Claim] = []
    text = "learns more stably than the strongest baseline"
    for (task, name), test in stats.compare(ours, theirs).items():
        p_value = "no test" if test.p_holm is None else f"p (Holm) {test.p_holm:.3g}"
        evidence = f"share of evaluations at 0.9 or more once there, 0 for seeds never there: {test.difference:+.2f} "
        evidence += f"against {name}; {p_value}"
        found.append(Claim(text, task, verdict(test.difference, test), evidence))
    return found


def _sooner(results: Results) -> list[Claim]:
    text = "is at the common threshold before the strongest baseline"
    found = []
    for row in against_baselines(results):
        if row.strongest and row.gain is not None:
            said = f"steps saved to {row.gain.threshold:.2f}: {row.gain}, against {row.other} (mean curves, no test)"
            found.append(Claim(text, row.task, SOONER[row.gain.ahead], said))
    return found


def _parts(results: Results) -> list[Claim]:
    rows = {(row.other, row.task): row for row in against_ablations(results)}
    found = []
    for ablation, (text, tasks) in ABLATION_CLAIMS.items():
        for task in (task for task in tasks if OURS in results.get(task, {})):
            row = rows.get((ablation, task))
            missing = Claim(text, task, "not run", f"the ledger has no {ablation} on this task")
            found.append(missing if row is None else _of_row(text, row))
    return found


def claims(results: Results) -> list[Claim]:
    """The paper's claims (section 5), task by task."""
    best = "ends with a higher success rate than the strongest baseline"
    found = [_of_row(best, row) for row in against_baselines(results) if row.strongest]
    return found + _sooner(results) + _stability(results) + _parts(results)


def claims_table(results: Results) -> list[list[str]]:
    """The claims as cells."""
    return [["TBC-HRL ...", "task", "verdict", "evidence"], *(list(claim) for claim in claims(results))]
