"""``python -m sb3_tbc.report``: tables 2 and 3 and the learning curves from a folder of results."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from sb3_tbc.commands import Parser, run_command
from sb3_tbc.errors import ConfigError
from sb3_tbc.files import save_atomic, write_atomic
from sb3_tbc.report.plotting import learning_curves, to_png
from sb3_tbc.report.tables import comparison_table, load_results, success_table, to_text


def to_html(tables: Mapping[str, Sequence[Sequence[str]]], picture: bytes) -> str:
    """One self-contained page: tables and the embedded learning curves."""
    parts = ["<!doctype html><meta charset='utf-8'><title>sb3_tbc results</title>", f"<style>{STYLE}</style>"]
    parts.append("<h1>Results</h1>")
    for title, table in tables.items():
        parts.append(f"<h2>{html.escape(title)}</h2><table>")
        for index, row in enumerate(table):
            tag = "th" if index == 0 else "td"
            parts.append("<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row) + "</tr>")
        parts.append("</table>")
    code = base64.b64encode(picture).decode()
    parts.append(f"<h2>Learning curves</h2><img alt='success rate against steps' src='data:image/png;base64,{code}'>")
    parts.append(f"<p>{NOTES} Bands are 95 % bootstrap intervals of the mean curve.</p>")
    return "\n".join(parts) + "\n"


def update_page(path: Path, text: str) -> None:
    """Replace what stands between the result marks of a Markdown page.

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


MARKS = ("<!-- results:begin -->", "<!-- results:end -->")
STYLE = (
    "body{font:15px/1.5 sans-serif;margin:2em auto;max-width:75em;padding:0 1em}table{border-collapse:collapse}"
    "td,th{border:1px solid #ccc;padding:.2em .6em;text-align:right}"
    "td:nth-child(-n+2),th:nth-child(-n+2){text-align:left}"
    "img{max-width:100%}"
)
NOTES = (
    "The seed is the unit: intervals are percentile bootstraps over seeds (10,000 resamples). Length: mean steps of "
    "successful episodes. Subgoals: share of windows that reached theirs. Window: mean executed length in steps. "
    "To 0.9: steps until an evaluation first succeeds in 0.9 of its episodes. Stable: share of evaluations at 0.9 "
    "or more from then on, mean over seeds. Worst: the lowest of these evaluations, of all seeds."
)


EXAMPLES = {
    "sb3_tbc.report runs": "tables of the finished runs in a folder",
    "sb3_tbc.report results --html report.html": "one page with tables, statistics and learning curves",
}


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.report", EXAMPLES, description=__doc__)
    parser.add_argument("results", nargs="?", type=Path, default=Path("results"),
                        help="folder of runs, or the ledger; by default results")  # fmt: skip
    parser.add_argument("--html", type=Path, metavar="OUT", help="write a page that needs no other file")
    parser.add_argument("--update", type=Path, metavar="PAGE.md", help="put the tables between the page's result marks")
    return parser


def command(argv: Sequence[str]) -> int:
    """Report; see ``--help``."""
    args = build_parser().parse_args(argv)
    results = load_results(args.results)
    tables = {"Success": success_table(results)}
    comparison = comparison_table(results)
    if len(comparison) > 1:
        tables["Against the strongest baseline"] = comparison
    text = "\n\n".join(to_text(table) for table in tables.values())
    print(text)
    if args.update is not None:
        update_page(args.update, f"{text}\n\n{NOTES}")
    if args.html is not None:
        curves = {t: {m: [r.curve for r in rs if r.rows] for m, rs in ms.items()} for t, ms in results.items()}
        drawn = {t: {m: c for m, c in ms.items() if c} for t, ms in curves.items()}
        try:
            picture = to_png(learning_curves(drawn))
        except ImportError as error:
            raise ConfigError(str(error)) from error
        png = args.html.with_suffix(".png")
        save_atomic(lambda path: Path(path).write_bytes(picture), png)
        write_atomic(args.html, to_html(tables, picture))
        print(f"\nreport         {args.html}\ncurves         {png}")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.report", argv)
