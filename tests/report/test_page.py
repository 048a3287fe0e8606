"""The page, the Markdown and the CSV: complete, self-contained, escaped, and the same bytes from the same ledger."""

from __future__ import annotations

import csv
import io
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from made_up_runs import fake_run, small_ledger

from sb3_tbc.report import command as report
from sb3_tbc.report.curves import Style, figure, label_places, tick_distance
from sb3_tbc.report.measured import measured_yaml
from sb3_tbc.report.paper import load_paper
from sb3_tbc.report.runs import load_results
from sb3_tbc.report.timeline import last_episode, option_timeline

ROOT = Path(__file__).parents[2]
VOID = {"meta", "input", "br", "circle", "line", "polyline", "polygon", "rect"}


class Checker(HTMLParser):
    """Collects attributes and texts, and fails on tags that do not match."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def check(page: str) -> Checker:
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    return checker


@pytest.fixture
def ledger(tmp_path: Path) -> Path:
    root = tmp_path / "ledger"
    for seed in range(3):
        fake_run(root, "Pendulum", "tbc-hrl", seed, 0.9 + seed / 100, curve=[0.0, 1.0, 0.25, 0.9])
        fake_run(root, "Pendulum", "tbc-hrl", seed, 0.4, variant="slow")
        fake_run(root, "Pendulum", "hits", seed, 0.7 + seed / 100)
    return root


def test_the_page_needs_no_other_file(ledger: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.html"
    assert report.main([str(ledger), "--html", str(page)]) == 0
    assert "| Pendulum | tbc-hrl      | 3" in capsys.readouterr().out
    text = page.read_text()
    loads = [(t, n, v) for t, n, v in check(text).attributes if n in ("src", "href", "srcset", "data")]
    assert loads == []
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "width=device-width" in text


def test_every_measured_point_is_drawn_where_it_was_measured(ledger: Path) -> None:
    runs = load_results(ledger)["Pendulum"]
    svg = ET.fromstring(figure("Pendulum", runs, load_paper()))
    (ours,) = [g for g in svg.iter("g") if g.get("data-method") == "tbc-hrl"]
    seeds = [g for g in ours.iter("g") if g.get("class") == "seed"]
    assert [g.get("data-seed") for g in seeds] == ["0", "1", "2"]
    heights = [float(c.get("cy", "nan")) for c in seeds[0].iter("circle")]
    assert heights == [250.0, 14.0, 191.0, 37.6]  # 0, 1, 0.25 and 0.9: extremes too
    assert [p.get("class") for p in ours.iter("polygon")] == ["band"]
    (paper,) = [line for line in svg.iter("line") if line.get("class") == "paper"]
    assert float(paper.get("y1", "nan")) == pytest.approx(250 - 236 * 0.907, abs=0.06)


def test_variants_are_behind_a_filter(ledger: Path) -> None:
    svg = ET.fromstring(figure("Pendulum", load_results(ledger)["Pendulum"], load_paper()))
    classes = {str(g.get("data-method")): str(g.get("class")) for g in svg.iter("g") if g.get("data-method")}
    assert classes == {
        "tbc-hrl": "method shipped",
        "hits": "method shipped",
        "tbc-hrl slow": "method variant hidden",
    }


def test_no_two_methods_look_alike_and_no_label_covers_another(tmp_path: Path) -> None:
    names = ["tbc-hrl", "hits", "hac", "sac", *(f"tbc-hrl v{i}" for i in range(30))]
    style = Style(names)
    assert len({(style.colour[n], style.dash[n]) for n in names}) == len(names)
    assert len(set(style.colour.values())) == len(names)
    assert [style.label[n] for n in names[:4]] == ["1", "2", "3", "4"]
    for algo in names[:4]:
        fake_run(tmp_path, "A", algo, 0, 1.0)
    for i in range(10):
        fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0, variant=f"v{i}")
    places = sorted(label_places(load_results(tmp_path)["A"], 4000).values())
    assert min(b - a for a, b in pairwise(places)) >= 10


@pytest.mark.parametrize(("last", "distance"), [(200_000, 50_000), (4_250_000, 1_000_000), (400, 100), (7, 2), (1, 1)])
def test_ticks_are_round(last: int, distance: int) -> None:
    assert tick_distance(last) == distance


def test_names_are_escaped_everywhere(tmp_path: Path) -> None:
    task, evil = "<img src=x>", "x\"><script>alert('&')</script>"
    variant = evil.replace("/", "")  # its folder has the same name
    folder = tmp_path / "ledger" / task / "tbc-hrl" / variant / "seed_0"
    made = fake_run(tmp_path / "other", "A", "tbc-hrl", 0, 0.5)
    folder.mkdir(parents=True)
    for file in made.path.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    final = {**made.read_final(), "task": task, "variant": variant}
    (folder / "final.json").write_text(json.dumps(final))
    (folder / "command.txt").write_text(evil)
    (folder / "versions.json").write_text(json.dumps({"commit": evil, "packages": {evil: evil}}))
    (tmp_path / "ledger" / "descriptions.yml").write_text(yaml.safe_dump({task: {f"tbc-hrl {variant}": evil}}))
    page = tmp_path / "page.html"
    assert report.main([str(tmp_path / "ledger"), "--html", str(page)]) == 0
    text = page.read_text()
    check(text)
    assert "<img" not in text
    assert "<script>alert" not in text
    assert text.count("<script>") == 1


def test_films_and_options_of_runs_are_shown(ledger: Path, tmp_path: Path) -> None:
    run = ledger / "Pendulum" / "tbc-hrl" / "full" / "seed_0"
    (run / "options.csv").write_text(
        "timesteps,env,time_budget,duration,reached,reason,episode_over,subgoal\n"
        "5,0,5,5,0,expired,0,1\n9,0,6,4,1,reached,1,1\n12,1,3,3,1,reached,1,1\n"
        "15,0,8,6,1,reached,0,1\n20,0,5,5,0,expired,1,1\n23,0,4,3,1,reached,0,1\n"
    )
    (tmp_path / "100% #1.mp4").write_bytes(b"film")
    (run / "film.mp4").write_bytes(b"film")
    page = tmp_path / "page.html"
    assert report.main([str(ledger), "--html", str(page)]) == 0
    sources = [v for t, n, v in check(page.read_text()).attributes if (t, n) == ("video", "src")]
    assert "100% #1.mp4</span>" in page.read_text()
    assert sources == ["100%25%20%231.mp4", "ledger/Pendulum/tbc-hrl/full/seed_0/film.mp4"]
    options = last_episode(run / "options.csv")
    assert [(o["duration"], o["reached"]) for o in options] == [(6, True), (5, False)]  # the last whole one
    svg = ET.fromstring(option_timeline(options))
    bars = [r for r in svg.iter("rect") if r.get("class") == "used"]
    assert float(bars[1].get("x", "nan")) > float(bars[0].get("x", "nan"))
    assert "option 2: 5 of 5 steps, subgoal missed (expired)" in [t.text for t in svg.iter("title")]
    (run / "other.csv").write_text("a,b\n")
    with pytest.raises(ValueError, match="not a trace of options"):
        last_episode(run / "other.csv")


def test_failed_runs_are_counted_and_named(ledger: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    failed = ledger / "Pendulum" / "sac" / "full" / "seed_0"
    failed.mkdir(parents=True)
    (failed / "failed.json").write_text("{}")
    page = tmp_path / "page.html"
    assert report.main([str(ledger), "--html", str(page)]) == 0
    assert "failed         " in capsys.readouterr().out
    assert "1 failed run" in page.read_text()
    assert "Pendulum/sac/full/seed_0" in page.read_text()


def test_failed_runs_stand_in_the_markdown_and_beside_their_row(ledger: Path, tmp_path: Path) -> None:
    for name in ("sac/full/seed_0", "hits/full/seed_7"):
        (ledger / "Pendulum" / name).mkdir(parents=True)
        (ledger / "Pendulum" / name / "failed.json").write_text("{}")
    page = tmp_path / "page.md"
    page.write_text("<!-- results:begin -->\n<!-- results:end -->\n")
    assert report.main([str(ledger), "--update", str(page)]) == 0
    text = page.read_text()
    assert "## Failed" in text
    assert [line.split()[-2] for line in text.splitlines() if line.startswith("| Pendulum | sac ")] == [
        "Pendulum/sac/full/seed_0"
    ]
    (row,) = [line for line in text.splitlines() if line.startswith("| hits")]
    assert row.endswith("| 1 failed |")


def test_a_ledger_of_failed_runs_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    failed = tmp_path / "Pendulum" / "sac" / "full" / "seed_0" / "failed.json"
    failed.parent.mkdir(parents=True)
    failed.write_text("{}")
    assert report.main([str(tmp_path)]) == 2
    assert f"and 1 that failed, e.g. {failed}" in capsys.readouterr().err


def test_curves_as_one_table(ledger: Path, tmp_path: Path) -> None:
    out = tmp_path / "curves.csv"
    assert report.main([str(ledger), "--curves", str(out)]) == 0
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    assert len(rows) == 9 * 4
    (row,) = [
        r for r in rows if (r["algo"], r["variant"], r["seed"], r["global_step"]) == ("hits", "full", "2", "3000")
    ]
    assert float(row["success_rate"]) == pytest.approx(0.54)


def test_a_page_is_filled_between_its_marks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fake_run(tmp_path / "results", "A", "tbc-hrl", 0, 0.5)
    page = tmp_path / "README.md"
    page.write_text("top\n<!-- results:begin -->\nformer text\n<!-- results:end -->\nbottom\n")
    for _ in range(2):
        assert report.main([str(tmp_path / "results"), "--update", str(page)]) == 0
    text = page.read_text()
    assert text.startswith("top\n<!-- results:begin -->\n## ")
    assert text.endswith("<!-- results:end -->\nbottom\n")
    assert "former text" not in text
    capsys.readouterr()
    page.write_text("no marks")
    assert report.main([str(tmp_path / "results"), "--update", str(page)]) == 2
    assert "needs the lines" in capsys.readouterr().err
    assert page.read_text() == "no marks"
    page.write_bytes("Größe <!-- results:begin -->\n<!-- results:end -->\n".encode("latin-1"))
    assert report.main([str(tmp_path / "results"), "--update", str(page)]) == 2
    assert "it is no UTF-8 text (invalid start byte at byte 2); save it as such\n" in capsys.readouterr().err
    assert report.main([str(tmp_path / "nowhere")]) == 2
    assert "nowhere is no folder; name" in capsys.readouterr().err
    (tmp_path / "nowhere").mkdir()
    assert report.main([str(tmp_path / "nowhere")]) == 2
    assert "no finished runs" in capsys.readouterr().err


def test_minutes_are_those_of_runs_of_equal_length(tmp_path: Path) -> None:
    for seed, (steps, seconds) in enumerate(((4000, 60.0), (9000, 6000.0), (4000, 120.0), (1000, 1.0))):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0, curve=[1.0], n_timesteps=steps, wall_time=seconds)
        fake_run(tmp_path, "B", "tbc-hrl", seed, 1.0, curve=[1.0], n_timesteps=steps + seed, wall_time=seconds)
    fake_run(tmp_path, "C", "tbc-hrl", 0, 1.0, n_timesteps=None)  # a result that does not say how long it took
    measured = yaml.safe_load(measured_yaml(load_results(tmp_path)))["tasks"]
    assert measured == {
        "A": {"steps": 4000, "minutes": 1.5, "seeds": 2},
        "B": {"steps": 9001, "minutes": 100.0, "seeds": 1},
    }


def test_the_committed_pages_are_what_the_ledger_gives(tmp_path: Path) -> None:
    """`make report`, byte for byte; in a process of its own, with another hash seed."""
    page, html, measured = tmp_path / "results.md", tmp_path / "report.html", tmp_path / "measured.yml"
    committed = ROOT / "docs" / "results.md"
    page.write_text(re.sub(r"(?s)(results:begin -->).*(<!-- results:end)", r"\1\n\2", committed.read_text()))
    arguments = [sys.executable, "-m", "sb3_tbc.report", "results", "--update", str(page), "--html", str(html)]
    arguments += ["--measured", str(measured)]
    subprocess.run(arguments, cwd=ROOT, check=True, capture_output=True, env=None, timeout=120)
    assert page.read_text() == committed.read_text(), "run `make report`"
    assert measured.read_text() == (ROOT / "sb3_tbc" / "zoo" / "measured.yml").read_text(), "run `make report`"
    assert html.read_text() == (ROOT / "docs" / "_static" / "report.html").read_text(), "run `make report`"


@pytest.mark.parametrize("form", ["printed", "page"])
def test_a_small_ledger_gives_these_tables(form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every word and figure of the report, so that none changes unnoticed."""
    known = ROOT / "tests" / "data" / f"small_report_{form}.md"
    small_ledger(tmp_path / "ledger")
    page = tmp_path / "page.md"
    page.write_text("<!-- results:begin -->\n<!-- results:end -->\n")
    assert report.main([str(tmp_path / "ledger"), "--update", str(page)]) == 0
    text = capsys.readouterr().out if form == "printed" else page.read_text(encoding="utf-8")
    text = text.replace(str(tmp_path), "TMP")
    text = re.sub(r"(?s)## Where the shipped agent departs.*?(?=## )", "", text)  # these are the shipped settings' own
    (tmp_path / "now.md").write_text(text, encoding="utf-8")
    assert text == known.read_text(encoding="utf-8"), f"if this is meant: cp {tmp_path / 'now.md'} {known}"
