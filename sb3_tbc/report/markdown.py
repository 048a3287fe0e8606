"""The results as Markdown, for the page of the docs; and all learning curves as one CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from sb3_tbc.errors import ConfigError
from sb3_tbc.files import write_atomic
from sb3_tbc.report import tables
from sb3_tbc.report.claims import claims_table
from sb3_tbc.report.comparisons import against_ablations, against_baselines
from sb3_tbc.report.paper import Paper
from sb3_tbc.report.runs import Results

MARKS = ("<!-- results:begin -->", "<!-- results:end -->")


def to_markdown(
    results: Results,
    descriptions: Mapping[str, Mapping[str, str]],
    paper: Paper,
    missing: tables.Table,
    departed: tables.Table,
) -> str:
    """All tables, with descriptions of the rows and the planned runs that are missing; empty tables are left out."""
    sections = [
        ("Shipped settings beside the paper", tables.paper_table(results, paper), f"Paper: {paper.source}."),
        ("Against every baseline", tables.comparison_table(against_baselines(results)), tables.COMPARISON_NOTES),
        ("Against our own ablations", tables.comparison_table(against_ablations(results)), ""),
        ("Which of the paper's claims hold here", claims_table(results), ""),
        (
            "Not run under equal conditions",
            tables.conditions_table(results),
            "Baselines that differ from our row in what should be the same; our value in brackets.",
        ),
        ("Where the shipped agent departs from the paper", departed, tables.DEPARTURE_NOTES),
        ("All tasks together", tables.overall_table(results), "Shipped settings; seeds are resampled within tasks."),
        ("All rows", tables.success_table(results), tables.NOTES),
        ("Planned and missing", missing, "Planned runs that are not in the ledger, and the command that makes them."),
        ("How far seeds lie apart", tables.spread_table(results), "Final success of rows with three seeds or more."),
    ]
    parts = [f"## {title}\n\n{_said(note)}{tables.to_text(table)}" for title, table, note in sections if len(table) > 1]
    parts.append("## What each row is\n\nEach run's own command and versions are in its folder.")
    for task, methods in results.items():
        parts.append(f"### {task}\n\n{tables.to_text(tables.description_table(task, methods, descriptions))}")
    return "\n\n".join(parts)


def _said(note: str) -> str:
    return f"{note}\n\n" if note else ""


def update_page(path: Path, text: str) -> None:
    """Replace the text between the result marks of a Markdown page.

    :raises ConfigError: if the page or its marks are missing
    """
    try:
        page = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error}") from error
    before, begin, rest = page.partition(MARKS[0])
    _, end, after = rest.partition(MARKS[1])
    if not begin or not end:
        raise ConfigError(f"{path} needs the lines {MARKS[0]} and {MARKS[1]} around the place for the tables")
    write_atomic(path, f"{before}{begin}\n{text}\n{end}{after}")


def curves_csv(results: Results) -> str:
    """Every evaluation of every run, one per line, in the long form that benchmark trackers read."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = ("mean_length", "subgoal_success", "mean_window", "wall_time")
    writer.writerow(["env_id", "task", "algo", "variant", "seed", "global_step", "success_rate", "episodes", *names])
    for task, methods in results.items():
        for runs in methods.values():
            for run in runs:
                identity = [run.final.get("env_id", task), task, run.final["algo"], run.final["variant"], run.seed]
                for row in run.rows:
                    rest = [f"{getattr(row, name):.6g}" for name in names]
                    writer.writerow([*identity, row.timesteps, f"{row.success_rate:.6g}", row.episodes, *rest])
    return text.getvalue()
