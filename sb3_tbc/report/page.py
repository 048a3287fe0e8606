"""The report as one HTML file without external resources, readable without scripts, on a phone, in light and dark."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from urllib.parse import quote

from sb3_tbc.report import curves
from sb3_tbc.report.comparisons import against_baselines
from sb3_tbc.report.conditions import notes_of_row
from sb3_tbc.report.paper import Figure, Paper
from sb3_tbc.report.runs import Results, Run, describe, is_shipped
from sb3_tbc.report.sections import Report, sections
from sb3_tbc.report.timeline import TRACE, last_episode, option_timeline

TEXT_COLUMNS = (
    "what it is",
    "notes",
    "note",
    "differs from ours in",
    "evidence",
    "machine",
    "verdict",
    "command",
    "what it is worth",
    "tasks",
    "folder",
)
INTRODUCTION = (
    "Rows without a further name have the shipped settings, unless a note says otherwise. Lines are means over seeds, "
    "bands their 95 % bootstrap intervals, dots every measured evaluation. Point at a curve to read its values, at a "
    "name to highlight its curve."
)


def to_html(report: Report, out: Path) -> str:
    """The whole page.

    :param report: what is to be shown
    :param out: path of the page, for links to films
    """
    style, script = (_template(name) for name in ("page.css", "page.js"))
    body = [
        *_heading(report.results, report.failed),
        "<h2>Learning curves</h2>",
        *_figures(report.results, report.descriptions, report.paper),
        *(line for section in sections(report) for line in _section(*section)),
        "<h2>How each row was made</h2>",
        *_rows(report),
        *_films(report.results, out),
    ]
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>sb3_tbc results</title><style>{style}</style></head><body>",
            *body,
            f"<script>{script}</script></body></html>",
            "",
        ]
    )


def _template(name: str) -> str:
    return resources.files("sb3_tbc.report").joinpath("templates", name).read_text(encoding="utf-8")


def _heading(results: Results, failed: Sequence[Path]) -> list[str]:
    runs = [run for methods in results.values() for rows in methods.values() for run in rows]
    hours = sum(float(run.final.get("wall_time") or 0.0) for run in runs) / 3600
    dirty = sum(run.dirty for run in runs if run.versions)
    facts = [f"{_count(len(runs), 'finished run')} on {_count(len(results), 'task')}", f"{hours:.1f} hours of training"]
    facts.append(_count(len(failed), "failed run") if failed else "no failed runs")
    if dirty:
        facts.append(f"{_count(dirty, 'run')} from code with changes that were not committed, marked below")
    return [
        "<h1>Results</h1>",
        f"<p>{'; '.join(facts)}.</p>",
        f'<p class="soft">{INTRODUCTION}</p>',
        '<p class="bar"><label><input type="checkbox" id="variants" disabled> show variants and ablations</label>'
        '<button id="theme" type="button" hidden>light or dark</button></p>',
    ]


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _figures(results: Results, descriptions: Mapping[str, Mapping[str, str]], paper: Paper) -> list[str]:
    parts = ['<div class="figures">']
    marks = {(row.task, row.other): row.test.mark for row in against_baselines(results)}
    frame = f"{curves.LEFT} {curves.RIGHT} {curves.TOP} {curves.BOTTOM}"
    for task, methods in results.items():
        drawn = curves.figure(task, methods, paper)
        if not drawn:
            continue
        named = {method: runs for method, runs in methods.items() if any(run.rows for run in runs)}
        parts.append(f'<section data-frame="{frame}"><h3>{escape(task)}</h3>{drawn}')
        parts.append('<div class="said" aria-live="polite"></div>')
        said = paper.success(task, "tbc-hrl")
        parts.append(f'<div class="key">{_key(task, named, descriptions, marks)}{_paper_key(said)}</div></section>')
    return [*parts, "</div>"]


def _paper_key(said: Figure | None) -> str:
    if said is None:
        return ""
    line = '<svg viewBox="0 0 26 10"><line class="paper" x1="1" x2="26" y1="5" y2="5"/></svg>'
    return f"<span>{line}tbc-hrl in the paper: {said.mean:.3f}</span>"


def _key(
    task: str,
    methods: Mapping[str, Sequence[Run]],
    descriptions: Mapping[str, Mapping[str, str]],
    marks: Mapping[tuple[str, str], str],
) -> str:
    """The legend: for each curve a box that shows or hides it, its name, and the mark of its test against ours."""
    style = curves.Style(list(methods))
    parts = []
    for method in curves.shipped_first(methods):
        kind = ' class="variant" hidden' if not is_shipped(method) else ""
        checked = " checked" if is_shipped(method) else ""
        dash = f' stroke-dasharray="{style.dash[method]}"' if style.dash[method] else ""
        count = len(methods[method])
        said = escape(describe(descriptions, task, method), quote=True)
        name = f"{method} ({count} seed{'s' if count > 1 else ''}) {marks.get((task, method), '')}".strip()
        parts.append(
            f'<label{kind} style="--c:{style.colour[method]}" title="{said}">'
            f'<input type="checkbox" value="{escape(method, quote=True)}" disabled{checked}>'
            f"<b>{style.label[method]}</b>"
            f'<svg viewBox="0 0 26 10"><line class="mean" x1="0" x2="26" y1="5" y2="5"{dash}/></svg>'
            f"{escape(name)}</label>"
        )
    return "".join(parts)


def _section(title: str, table: Sequence[Sequence[str]], note: str) -> list[str]:
    said = [f'<p class="soft">{escape(note)}</p>'] if note else []
    return [f"<h2>{escape(title)}</h2>", *said, html_table(table)]


def html_table(table: Sequence[Sequence[str]]) -> str:
    """A table whose texts are escaped; rows of variants can be filtered."""
    header, *rows = table
    wraps = [name in TEXT_COLUMNS for name in header]
    method = header.index("method") if "method" in header else None

    def line(cells: Sequence[str], tag: str) -> str:
        return "".join(
            f"<{tag}{' class=text' if wrap else ''}>{escape(cell)}</{tag}>"
            for cell, wrap in zip(cells, wraps, strict=True)
        )

    parts = [f'<div class="scroll"><table><thead><tr>{line(header, "th")}</tr></thead><tbody>']
    for cells in rows:
        variant = method is not None and not is_shipped(cells[method])
        parts.append(f"<tr{' class=variant hidden' if variant else ''}>{line(cells, 'td')}</tr>")
    return "".join([*parts, "</tbody></table></div>"])


def _rows(report: Report) -> list[str]:
    parts = []
    for task, methods in report.results.items():
        parts.append(f"<h3>{escape(task)}</h3>")
        for method, runs in methods.items():
            said = describe(report.descriptions, task, method)
            parts.append(_row(method, runs, said, notes_of_row(runs, methods, report.failed)))
    return parts


def _row(method: str, runs: Sequence[Run], said: str, notes: Sequence[str]) -> str:
    kind = "" if is_shipped(method) else ' class="variant" hidden'
    lines = [f"<details{kind}><summary>{escape(method)}{': ' + escape(said) if said else ''}</summary>"]
    lines += [f"<ul>{''.join(f'<li>{escape(note)}</li>' for note in notes)}</ul>"] if notes else []
    for run in runs:
        packages = run.versions.get("packages") or {}
        parts = [f"{name} {version}" for name, version in packages.items()]
        parts += [f"commit {commit}" for commit in run.commits if run.versions]
        parts += [str(run.versions[key]) for key in ("python", "cpu") if run.versions.get(key)]
        command = escape(run.command or "command unknown").replace("\n", "<br>")
        lines.append(f"<p>seed {run.seed}: <code>{command}</code><br>")
        lines.append(f'<span class="soft">{escape(", ".join(parts))}</span></p>')
    return "".join([*lines, "</details>"])


def _films(results: Results, out: Path) -> list[str]:
    """Films beside the page or in a run's folder, and the options of runs with a trace."""
    parts = []
    beside = sorted(out.absolute().parent.glob("*.mp4"))
    parts += [_film(path, out) for path in beside]
    for task, methods in results.items():
        for method, runs in methods.items():
            for run in runs:
                title = f"{task}, {method}, seed {run.seed}"
                films = [path for path in sorted(run.folder.absolute().glob("*.mp4")) if path not in beside]
                parts += [f"<h3>{escape(title)}</h3>{_film(path, out)}" for path in films]
                parts += _timeline(run.folder / TRACE, title)
    return ["<h2>Films and options</h2>", *parts] if parts else []


def _film(path: Path, out: Path) -> str:
    place = Path(os.path.relpath(path, out.absolute().parent)).as_posix()
    link, name = escape(quote(os.fsencode(place)), quote=True), escape(place)
    return f'<p><video controls loop preload="metadata" src="{link}"></video><br><span class="soft">{name}</span></p>'


def _timeline(trace: Path, title: str) -> list[str]:
    options = last_episode(trace) if trace.is_file() else []
    if not options:
        return []
    note = "The last whole episode of training. Pale: time budget; dark: steps used; tick: subgoal reached, cross: not."
    return [
        f'<h3>{escape(title)}: options of an episode</h3><p class="soft">{note}</p>',
        option_timeline(options, f"Options of an episode, {title}"),
    ]
