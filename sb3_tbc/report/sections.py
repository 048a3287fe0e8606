"""What the Markdown and the HTML page show alike: the ledger read once, and its tables with their titles and notes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from sb3_tbc.report import tables
from sb3_tbc.report.claims import claims_table
from sb3_tbc.report.comparisons import against_ablations, against_baselines
from sb3_tbc.report.departures import departures_table
from sb3_tbc.report.paper import Paper, load_paper
from sb3_tbc.report.planned import missing_table
from sb3_tbc.report.runs import Results, failed_runs, load_descriptions, load_results


class Report(NamedTuple):
    """A folder of runs as it is reported.

    ``failed`` are folders of runs that ended in an error, ``missing`` planned runs that the ledger lacks, ``departed``
    what the shipped agent departs from the paper in.
    """

    results: Results
    descriptions: tables.Descriptions
    paper: Paper
    failed: list[Path]
    missing: tables.Table
    departed: tables.Table


class Section(NamedTuple):
    """A table with its title, and what is to be said before it."""

    title: str
    table: tables.Table
    note: str


def load_report(root: Path) -> Report:
    """Read a folder of runs.

    :raises ConfigError: if there is no run, or a file cannot be read
    """
    results = load_results(root)
    texts = load_descriptions(root), load_paper(), failed_runs(root)
    return Report(results, *texts, missing_table(root, results), departures_table(root, results))


def sections(report: Report) -> list[Section]:
    """The sections in order; those whose table has no row are left out."""
    results, paper = report.results, report.paper
    found = [
        Section("Shipped settings beside the paper", tables.paper_table(results, paper), f"Paper: {paper.source}."),
        Section("Against every baseline", tables.comparison_table(against_baselines(results)), tables.COMPARISON_NOTES),
        Section(
            "Against our own ablations", tables.comparison_table(against_ablations(results)), tables.ABLATION_NOTES
        ),
        Section("Which of the paper's claims hold here", claims_table(results), ""),
        Section(
            "Not run under equal conditions",
            tables.conditions_table(results),
            "Baselines that differ from our row in what should be the same; our value in brackets.",
        ),
        Section("Where the shipped agent departs from the paper", report.departed, tables.DEPARTURE_NOTES),
        Section("All tasks together", tables.overall_table(results), tables.OVERALL_NOTES),
        Section("All rows", tables.success_table(results), tables.NOTES),
        Section(
            "Planned and missing",
            report.missing,
            "Planned runs that are not in the ledger, and the command that makes them. Runs that were trained or "
            "evaluated otherwise than planned do not count; they have to be moved away before.",
        ),
        Section(
            "Failed",
            tables.failed_table(report.failed),
            "Runs that ended in an error and have not been repeated since.",
        ),
        Section(
            "How far seeds lie apart", tables.spread_table(results), "Final success of rows with three seeds or more."
        ),
    ]
    return [section for section in found if len(section.table) > 1]
