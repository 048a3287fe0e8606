"""What a wheel contains: the package with its tasks and configurations, and no top-level module of another name."""

from __future__ import annotations

import configparser
import shutil
import subprocess
import sys
import zipfile
from importlib import resources
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def setup_cfg() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    return parser


def test_every_package_is_listed() -> None:
    listed = set(setup_cfg()["options"]["packages"].split())
    found = {"sb3_tbc.tasks", "sb3_tbc.zoo_configs"}
    found |= {".".join(p.parent.relative_to(ROOT).parts) for p in (ROOT / "sb3_tbc").rglob("__init__.py")}
    assert listed == found


def test_configurations_are_inside_the_package() -> None:
    names = {p.name for p in resources.files("sb3_tbc.zoo_configs").iterdir()}
    assert {"tbc-hrl.yml", "hits.yml"} <= names


def test_the_version_has_one_source() -> None:
    import sb3_tbc

    assert setup_cfg()["metadata"]["version"] == "attr: sb3_tbc.__version__"
    assert f"version: {sb3_tbc.__version__}" in (ROOT / "CITATION.cff").read_text()


def test_constraints_are_pins_of_what_the_package_asks_for() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line.partition(";")[0].strip() for line in lines if line and not line.startswith("#")]
    assert all(pin.count("==") == 1 for pin in pins)
    assert {"torch", "stable_baselines3", "gymnasium", "mujoco"} <= {pin.split("==")[0] for pin in pins}


@pytest.mark.slow
def test_wheel(tmp_path: Path) -> None:
    source = tmp_path / "source"  # a copy, because setuptools leaves a build folder behind
    for name in ("sb3_tbc", "tasks", "zoo_configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-q", "-w", str(tmp_path)]
    done = subprocess.run([*build, str(source)], capture_output=True, text=True, timeout=170)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"sb3_tbc"}
    wanted = ["tasks/pendulum.py", "zoo_configs/tbc-hrl.yml", "zoo_configs/hits.yml", "py.typed", "zoo/runner.py"]
    assert {f"sb3_tbc/{name}" for name in wanted} <= set(names)
