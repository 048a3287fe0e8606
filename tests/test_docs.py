"""What README and the pages say exists: links between pages, modules, commands, settings; the figures of the ledger."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from sb3_tbc.commands import COMMANDS
from sb3_tbc.report.runs import Results, load_results

ROOT = Path(__file__).parents[1]
TASKS = ("Pendulum", "UR5Reacher", "Drawbridge", "AntFourRooms", "Tennis2D", "Platforms")
DERIVED = {"commands.md", "settings.md"}  # written when the pages are built
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").glob("*.md") if p.name not in DERIVED)]
NOTES = sorted((ROOT / "results" / "notes").glob("*.md"))


def pages(paths: list[Path]) -> list[object]:
    return [pytest.param(path, id=path.relative_to(ROOT).as_posix()) for path in paths]


@pytest.mark.parametrize("page", pages([*PAGES, *NOTES]))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http", "mailto")) and Path(target).name not in DERIVED:
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MyST name them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", pages([*PAGES, *NOTES]))
def test_links_into_pages_name_a_heading(page: Path) -> None:
    for path, anchor in re.findall(r"\]\(([^)#\s:]*\.md)?#([^)\s]+)\)", page.read_text(encoding="utf-8")):
        target = page.parent / path if path else page
        if target.name not in DERIVED:
            assert anchor in anchors(target), f"{page.name}: {path}#{anchor}"


@pytest.mark.parametrize("page", pages(PAGES))
def test_modules_and_names_exist(page: Path) -> None:
    for name in set(re.findall(r"\bsb3_tbc(?:\.[A-Za-z_]\w*)+", page.read_text(encoding="utf-8"))):
        if name.removeprefix("sb3_tbc.") in COMMANDS:
            continue
        module, _, attribute = name.rpartition(".")
        try:
            found = find_spec(name) is not None
        except ModuleNotFoundError:
            found = False
        assert found or hasattr(importlib.import_module(module), attribute), f"{page.name}: {name}"


@pytest.mark.parametrize("page", pages(PAGES))
def test_commands_exist(page: Path) -> None:
    for name in re.findall(r"(?:-m sb3_tbc\.|sb3-tbc )([a-z]+)\b", page.read_text(encoding="utf-8")):
        assert name in COMMANDS or find_spec(f"sb3_tbc.{name}") is not None, f"{page.name}: {name}"


@pytest.mark.parametrize("page", pages([*PAGES, *NOTES]))
def test_commands_have_these_options(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every whole command of a page is one that its parser takes."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"(?ms)^```\w*\n(.*?)^```", text) + re.findall(r"(?m)^    (python -m .*)$", text)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    refused: list[str] = []
    inline = re.findall(r"`(python -m sb3_tbc\.[^`]+)`", re.sub(r"(?ms)^```.*?^```", "", text))
    for line in [*lines, *inline]:
        command = re.match(r"(?:\$ )?python -m sb3_tbc\.([a-z]+) (.+)", " ".join(line.split()))
        if command is None or re.search(r"\.\.\.(?!/)|[{[](?!0)", command[2]):  # a part is left out, or one of several
            continue
        arguments = [re.sub(r"^[NSM]$", "1", word) for word in shlex.split(command[2], comments=True)]
        try:
            importlib.import_module(COMMANDS[command[1]].module).build_parser().parse_args(arguments)
        except SystemExit as stop:
            refused += [line] if stop.code else []
    assert not refused, capsys.readouterr().err


@pytest.mark.parametrize("page", pages([page for page in NOTES if page.stem.replace("_", "") in map(str.lower, TASKS)]))
def test_rows_that_notes_name_are_in_the_ledger(page: Path) -> None:
    text = page.read_text(encoding="utf-8").replace("*ledger: `name`*", "")
    known = {folder.name for folder in (ROOT / "results").glob("*/*/*") if folder.is_dir()}
    for name in re.findall(r"[Ll]edger: `([^`]+)`", text):
        assert name.removeprefix("hits ") in known, f"{page.name}: {name}"


def test_the_package_index_page_has_no_relative_links() -> None:
    text = (ROOT / "docs" / "package_index.md").read_text(encoding="utf-8")
    assert not [t for t in re.findall(r"\]\(([^)]+)\)", text) if not t.startswith("http")]


@pytest.fixture(scope="module")
def ledger() -> Results:
    return load_results(ROOT / "results")


@pytest.mark.parametrize("method", ["tbc-hrl", "hits"])
@pytest.mark.parametrize("task", TASKS)
def test_readmes_results_are_the_ledgers(ledger: Results, task: str, method: str) -> None:
    row = next(line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith(f"| {task}"))
    success, seeds, first = row.split("|")[2:5] if method == "tbc-hrl" else row.split("|")[5:8]
    runs = [run.final for run in ledger[task][method]]
    said = re.findall(r"(?<![\d.])(1\.00|\.\d\d)", success)[0]
    assert float(said) == round(sum(run["success_rate"] for run in runs) / len(runs), 2)
    assert int(seeds) == len(runs)
    reached = [
        next((step for step, rate in zip(*run.curve, strict=True) if rate >= 0.9), None) for run in ledger[task][method]
    ]
    steps = [step for step in reached if step is not None]
    assert first.strip() == (f"{sum(steps) / len(steps) / 1000:.0f} k" if len(steps) == len(runs) else "not reached")
    if "steps" in success:
        lengths = [run["mean_length_success"] for run in runs if run["mean_length_success"] is not None]
        assert f"({sum(lengths) / len(lengths):.0f} steps)" in success


@pytest.mark.slow
def test_the_pages_build_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("furo", reason="needs the docs extra")
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", str(ROOT / "docs"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    for page in tmp_path.glob("*.html"):
        loaded = re.findall(
            r"<(?:script|link|img)[^>]+(?:src|href)=\"(https?:[^\"]+)\"", page.read_text(encoding="utf-8")
        )
        assert not loaded, f"{page.name} loads {loaded}"
