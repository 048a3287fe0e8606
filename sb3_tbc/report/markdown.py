"""The results as Markdown, for the page of the docs; and all learning curves as one CSV."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from sb3_tbc.errors import ConfigError
from sb3_tbc.files import write_atomic
from sb3_tbc.reading import read_text
from sb3_tbc.report import tables
from sb3_tbc.report.runs import Results
from sb3_tbc.report.sections import Report, sections

MARKS = ("<!-- results:begin -->", "<!-- results:end -->")


def to_markdown(report: Report) -> str:
    """All tables, with descriptions of the rows; empty tables are left out."""
    parts = [f"## {title}\n\n{_said(note)}{tables.to_text(table)}" for title, table, note in sections(report)]
    parts.append("## What each row is\n\nEach run's own command and versions are in its folder.")
    for task, methods in report.results.items():
        described = tables.description_table(task, methods, report.descriptions, report.failed)
        parts.append(f"### {task}\n\n{tables.to_text(described)}")
    return "\n\n".join(parts)


def _said(note: str) -> str:
    return f"{note}\n\n" if note else ""


def update_page(path: Path, text: str, marks: tuple[str, str] = MARKS) -> None:
    """Replace the text between two marks of a Markdown page.

    :raises ConfigError: if the page or its marks are missing, or it is no UTF-8
    """
    page = read_text(path)
    before, begin, rest = page.partition(marks[0])
    _, end, after = rest.partition(marks[1])
    if not begin or not end:
        raise ConfigError(f"{path} needs the lines {marks[0]} and {marks[1]} around the place for the tables")
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
