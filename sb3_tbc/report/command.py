"""``python -m sb3_tbc.report``: tables, statistics and learning curves of finished runs, as text and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_tbc.commands import Parser, given_path, output_file, run_command
from sb3_tbc.files import write_atomic
from sb3_tbc.report.markdown import curves_csv, to_markdown, update_page
from sb3_tbc.report.measured import measured_yaml
from sb3_tbc.report.page import to_html
from sb3_tbc.report.sections import load_report
from sb3_tbc.report.tables import NOTES, all_tables, to_text

EXAMPLES = {
    "sb3_tbc.report runs": "tables of the finished runs in a folder",
    "sb3_tbc.report results --html report.html": "one page with tables, statistics and learning curves",
    "sb3_tbc.report results --curves curves.csv": "every evaluation of every run, for other tools",
}


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.report", EXAMPLES, description=__doc__)
    parser.add_argument("results", nargs="?", type=given_path, default=Path("results"),
                        help="folder of runs, or the ledger; by default results")  # fmt: skip
    parser.add_argument("--html", type=output_file, metavar="OUT", help="write a page that needs no other file; "
                        "films that lie beside it or in the runs' folders are linked")  # fmt: skip
    parser.add_argument("--update", type=given_path, metavar="PAGE.md", help="write all tables into this page, "
                        "between its result marks")  # fmt: skip
    parser.add_argument("--curves", type=output_file, metavar="OUT.csv", help="write all learning curves as one table")
    parser.add_argument(
        "--measured", type=output_file, metavar="OUT.yml", help="write the minutes that train --list prints"
    )
    return parser


def command(argv: Sequence[str]) -> int:
    """Report; see ``--help``."""
    args = build_parser().parse_args(argv)
    report = load_report(args.results)
    if args.update is not None:
        update_page(args.update, to_markdown(report))
    if args.curves is not None:
        write_atomic(args.curves, curves_csv(report.results))
    if args.measured is not None:
        write_atomic(args.measured, measured_yaml(report.results))
    if args.html is not None:
        write_atomic(args.html, to_html(report, args.html))
    # last, as what reads the output may end before it has all, like head
    print("\n\n".join(f"{title}\n\n{to_text(table)}" for title, table in all_tables(report.results).items()))
    print(f"\n{NOTES}")
    if report.failed:
        print("\n" + "\n".join(f"failed         {path}" for path in report.failed))
    if args.html is not None:
        print(f"\nreport         {args.html}")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.report", argv)
