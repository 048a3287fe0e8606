"""Tables of the results as lists of cells: all rows, comparisons, the paper's figures beside ours, conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sb3_tbc import stats
from sb3_tbc.report.comparisons import Row, against_ablations, against_baselines, interval_of
from sb3_tbc.report.conditions import notes_of_row, unequal_conditions
from sb3_tbc.report.paper import Paper
from sb3_tbc.report.runs import OURS, Results, Run, describe, row_of, shipped, stable_shares, successes

Table = list[list[str]]
Descriptions = Mapping[str, Mapping[str, str]]

HEADER = (
    *("task", "method", "seeds", "success", "sd", "95 % interval", "length", "subgoals", "window", "to 0.9", "stable"),
    "worst",
)
NOTES = (
    "Success: share of the final evaluation's episodes, mean over seeds. Interval: with three seeds or more a "
    "bootstrap over seeds (10,000 resamples), widened where needed to the exact interval over episodes "
    "(Clopper-Pearson; of episodes that begin alike, one per seed); with one or two seeds the exact interval alone, "
    "which holds for these agents and not for other seeds. Length: mean steps of successful episodes. Subgoals: share "
    "of windows that reached theirs. Window: mean executed length in steps. To 0.9: steps until an evaluation first "
    "succeeds in 0.9 of its episodes. Stable: share of evaluations at 0.9 or more from then on, 0 for a seed without "
    "one, mean over seeds. Worst: the lowest of these evaluations, of all seeds."
)
DEPARTURE_NOTES = (
    "Settings of tbc-hrl that differ between --config paper (its tables and text) and --config tuned (shipped). "
    "What it is worth: success of the shipped agent minus that of a row with the paper's value, with its 95 % "
    "interval, and steps saved to the common threshold; over the seeds that both have, if there are any. Our row is "
    "named where the measurement was made before another setting of the shipped agent was changed."
)
COMPARISON_NOTES = (
    "Difference: ours minus theirs, with its 95 % interval. p: Welch's test on seeds, two-sided; (Holm): corrected "
    "over all tests of the table; * below 0.05, ** below 0.01. There is no test with fewer than three seeds on a "
    "side, nor where no seed differs from another. Better: probability that a run of ours beats one of theirs, ties "
    "counted half. Steps saved: to the common threshold, 0.9 of the best mean success of any method on the task, "
    "where that is 0.5 or more; evaluations are far apart, so small differences mean little."
)
ABLATION_NOTES = (
    "As above. A note names our row where it is not the shipped agent: ablations of the paper's settings, and rows "
    "that were run before a setting of the shipped agent was changed, are compared with ours of the same settings."
)
OVERALL_NOTES = (
    "Shipped settings; mean of the middle half of all runs. Tasks weigh the same, however many seeds they have; seeds "
    "are resampled within them. Only rows of the same tasks can be compared."
)


def success_table(results: Results) -> Table:
    """All rows: for each task and method the mean success over seeds, its interval, and statistics of the agents."""
    table = [list(HEADER)]
    for task, methods in results.items():
        table += [_success_row(task, method, runs) for method, runs in methods.items()]
    return table


def _success_row(task: str, method: str, runs: Sequence[Run]) -> list[str]:
    values, interval = successes(runs), interval_of(runs)
    known = len(runs) >= stats.FEWEST_SEEDS or all(run.episodes for run in runs)
    return [
        task,
        method,
        str(len(runs)),
        f"{interval.mean:.3f}",
        f"{np.std(values, ddof=1):.3f}" if len(values) > 1 else "-",
        f"{interval.low:.3f} to {interval.high:.3f}" if known else "-",
        mean_of(runs, "mean_length_success", "{:.0f}"),
        mean_of(runs, "subgoal_success", "{:.2f}"),
        mean_of(runs, "mean_window", "{:.1f}"),
        steps_to_90(runs),
        f"{np.mean(shares):.2f}" if (shares := stable_shares(runs)) else "-",
        worst(runs),
    ]


def steps_to_90(runs: Sequence[Run]) -> str:
    """Mean steps until an evaluation first succeeds in 0.9 of its episodes, or how many of the evaluated seeds do."""
    first = [stats.steps_to(*run.curve, 0.9) for run in runs if run.rows]
    reached = [steps for steps in first if steps is not None]
    if not first:
        return "-"
    all_reached = len(reached) == len(first)
    return f"{np.mean(reached) / 1000:.0f} k" if all_reached else f"{len(reached)} of {len(first)} seeds"


def worst(runs: Sequence[Run]) -> str:
    """The lowest evaluation after a first .9, of all seeds."""
    values = [run.final["worst_after_first_90"] for run in runs if run.final.get("worst_after_first_90") is not None]
    return f"{min(values):.2f}" if values else "-"


def mean_of(runs: Sequence[Run], key: str, form: str) -> str:
    """Mean of a figure over the seeds that have it."""
    values = [run.final[key] for run in runs if run.final.get(key) is not None]
    return form.format(np.mean(values)) if values else "-"


def comparison_table(rows: Sequence[Row]) -> Table:
    """Comparisons with ours, one per line."""
    header = ["task", "against", "difference", "p", "p (Holm)", "", "Cliff's delta", "steps saved", "95 % interval"]
    table = [[*header, "better", "note"]]
    for row in rows:
        test = row.test
        tested = [f"{test.p_value:.3g}", f"{test.p_holm:.3g}"] if test.p_value is not None else ["-", "-"]
        over_seeds = test.note != stats.TOO_FEW_SEEDS
        effects = [f"{test.cliffs_delta:+.2f}", f"{test.improvement:.2f}"] if over_seeds else ["-", "-"]
        gain = "-" if row.gain is None else str(row.gain)
        interval = f"{row.interval.low:+.3f} to {row.interval.high:+.3f}"
        unequal = f"unequal {'; '.join(row.unequal)}" if row.unequal else ""
        than = "" if row.ours == OURS else f"ours is {row.ours}"
        note = ", ".join(filter(None, [than, test.note, "strongest baseline" if row.strongest else "", unequal]))
        numbers = [f"{test.difference:+.3f}", *tested, test.mark, effects[0], gain, interval, effects[1]]
        table.append([row.task, row.other, *numbers, note])
    return table


def paper_table(results: Results, paper: Paper) -> Table:
    """Shipped settings beside the paper's figures and the public HiTS policies (table 2)."""
    table = [
        ["task", "method", "success", "95 % interval", "seeds", "steps", "steps in the paper", "paper", "public HiTS"]
    ]
    for task, methods in results.items():
        for method, runs in shipped(methods).items():
            interval = interval_of(runs)
            said = paper.success(task, method)
            public = paper.public_hits.get(task) if method == "hits" else None
            table.append(
                [
                    task,
                    method,
                    f"{interval.mean:.3f}",
                    f"{interval.low:.3f} to {interval.high:.3f}",
                    str(len(runs)),
                    _steps(runs),
                    f"{paper.steps[task]:,}" if task in paper.steps else "-",
                    "-" if said is None else f"{said.mean:.3f} (sd {said.sd:.3f})",
                    "-" if public is None else f"{public:.2f}",
                ]
            )
    return table


def _steps(runs: Sequence[Run]) -> str:
    steps = sorted({int(run.final["n_timesteps"]) for run in runs if run.final.get("n_timesteps")})
    return " or ".join(f"{count:,}" for count in steps) or "-"


def description_table(
    task: str, methods: Mapping[str, Sequence[Run]], descriptions: Descriptions, failed: Sequence[Path]
) -> Table:
    """Description of each row of a task, with its steps, minutes, machine and notes."""
    table = [["method", "what it is", "steps", "minutes", "machine", "notes"]]
    for method, runs in methods.items():
        minutes = [run.final["wall_time"] / 60 for run in runs if run.final.get("wall_time")]
        machines = sorted({str(run.versions.get("cpu")) for run in runs if run.versions.get("cpu")})
        notes = notes_of_row(runs, methods, failed)
        cells = [describe(descriptions, task, method) or "-", _steps(runs)]
        cells += [f"{np.mean(minutes):.0f}" if minutes else "-", ", ".join(machines) or "-", "; ".join(notes) or "-"]
        table.append([method, *cells])
    return table


def failed_table(failed: Sequence[Path]) -> Table:
    """Runs that ended in an error, by their folders."""
    return [["task", "method", "folder"], *([*row_of(path), "/".join(path.parts[-4:])] for path in failed)]


def spread_table(results: Results) -> Table:
    """Spread between seeds, for rows with three seeds or more."""
    table = [["task", "method", "seeds", "lowest", "10th percentile", "90th percentile", "highest"]]
    for task, methods in results.items():
        for method, runs in methods.items():
            if len(runs) >= stats.FEWEST_SEEDS:
                spread = stats.spread(successes(runs))
                table.append([task, method, str(len(runs)), *(f"{value:.3f}" for value in spread)])
    return table


def overall_table(results: Results) -> Table:
    """Interquartile mean of all runs with shipped settings, over all tasks for which a method has runs."""
    table = [["method", "tasks", "runs", "interquartile mean", "95 % interval"]]
    several = len(results) > 1
    names = list(dict.fromkeys(m for methods in results.values() for m in shipped(methods))) if several else []
    for method in names:
        rows = {task: methods[method] for task, methods in results.items() if method in methods}
        iqm = stats.interquartile_mean([successes(runs) for runs in rows.values()])
        low, high = iqm.low, iqm.high
        if middle := _episodes_of_middle_half(list(rows.values())):
            exact = stats.clopper_pearson(round(iqm.mean * middle), middle)
            low, high = min(low, exact[0]), max(high, exact[1])
        tasks = "all" if len(rows) == len(results) else ", ".join(rows)
        counts = [tasks, str(sum(map(len, rows.values())))]
        table.append([method, *counts, f"{iqm.mean:.3f}", f"{low:.3f} to {high:.3f}"])
    return table


def _episodes_of_middle_half(rows: Sequence[Sequence[Run]]) -> int:
    """Episodes that would tell as much if all weighed the same: runs that all succeed are no interval of width zero."""
    runs = [(run.episodes, 1.0 / (len(rows) * len(row))) for row in rows for run in row]
    return int(0.5 / sum(weight**2 / count for count, weight in runs)) if all(count for count, _ in runs) else 0


def conditions_table(results: Results) -> Table:
    """Baselines that were not run under our conditions, and the differences (our value in brackets)."""
    table = [["task", "method", "differs from ours in"]]
    for task, rows in unequal_conditions(results).items():
        table += [[task, method, "; ".join(said)] for method, said in rows.items()]
    return table


def all_tables(results: Results) -> dict[str, Table]:
    """The tables that the command prints, without those that have no row."""
    tables = {
        "Success": success_table(results),
        "Against every baseline": comparison_table(against_baselines(results)),
        "Against our own ablations": comparison_table(against_ablations(results)),
        "Not run under equal conditions": conditions_table(results),
    }
    return {title: table for title, table in tables.items() if len(table) > 1}


def to_text(table: Sequence[Sequence[str]]) -> str:
    """A table as Markdown with aligned columns; bars in cells are escaped."""
    rows = [[cell.replace("|", "\\|") for cell in row] for row in table]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "|".join("-" * (w + 2) for w in widths) + "|", *lines[1:]])
