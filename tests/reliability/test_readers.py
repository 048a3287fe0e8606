"""Files and texts that are nonsense are refused in one line, within moments."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_tbc.errors import ConfigError
from sb3_tbc.files import write_arrays
from sb3_tbc.outside import flat_name, folder_name, in_docstring, number, one_line, without_password
from sb3_tbc.reading import SettingsLoader, parse_yaml, read_arrays, read_json, read_text, read_yaml, settings_yaml
from sb3_tbc.tune.journal import drop_half_line
from sb3_tbc.zoo.config import parse_overrides, read_file
from sb3_tbc.zoo.ledger import RunFolder

FEW = settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
BOMB = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n" + "\n".join(
    f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "more than 100000 values once its aliases are written out"),
        ("a: &a [*a]", "an alias refers to a node that contains it"),
        ("[" * 1000, "nested too deeply|no YAML"),
        ("a: !!python/object/apply:os.system [ls]", "no YAML"),
        ("2020-99-99", "no YAML"),
        ("a: b: c", "no YAML"),
        ("? [a]\n: b", "no YAML"),
    ],
)
def test_yaml_that_is_refused(text: str, message: str, tmp_path: Path) -> None:
    begun = time.monotonic()
    with pytest.raises(ConfigError, match=message):
        parse_yaml(text, "it")
    (tmp_path / "f.yml").write_text(text)
    for read in (read_yaml, read_file):
        with pytest.raises(ConfigError):
            read(tmp_path / "f.yml")
    assert time.monotonic() - begun < 5.0


def test_yaml_that_is_read() -> None:
    assert parse_yaml("a: &a {b: 1}\nc: {<<: *a, d: 2}", "it") == {"a": {"b": 1}, "c": {"b": 1, "d": 2}}
    assert parse_yaml("", "it") is None


def test_numbers_of_settings_survive_writing_and_reading(tmp_path: Path) -> None:
    data = {"a": 3e-4, "b": "3e-4", "c": "-.5E+3", "d": 12, "e": "12", "f": "089", "g": "lin_1e-3", "h": [1e37, None]}
    path = tmp_path / "a.yml"
    path.write_text(settings_yaml(data))
    assert read_yaml(path, SettingsLoader) == data
    plain = "[3e-4, 1E5, +1e5, .5e1, 12, 1_0, 2e3 steps]"
    assert parse_yaml(plain, "it", SettingsLoader) == [3e-4, 1e5, 1e5, 5.0, 12, 10, "2e3 steps"]
    assert parse_yaml("3e-4", "it") == "3e-4"  # files that programs write are YAML 1.1
    assert not any(type(value) is float for value in parse_yaml("['3e-4', \"1e5\", !!str 1e5]", "it", SettingsLoader))
    with pytest.raises(ConfigError, match="it is no YAML"):
        parse_yaml("!!python/object/apply:os.getcwd []", "it", SettingsLoader)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for content, message in [(b"\xff\xfe", "no UTF-8"), (b"x" * (4 * 2**20 + 1), "at most")]:
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=message):
            read_text(path)
    if os.name == "posix":  # a device has no size, and no end
        with pytest.raises(ConfigError, match="/dev/zero has more than 100 bytes"):
            read_text(Path("/dev/zero"), 100)
    path.write_bytes(b"a\r\nb\rc\n")
    assert read_text(path) == "a\nb\nc\n"
    with pytest.raises(ConfigError, match="there is no such file"):
        read_text(tmp_path / "missing")
    with pytest.raises(ConfigError, match="cannot read"):
        read_text(tmp_path)
    path.write_text("[" * 100_000)
    with pytest.raises(ConfigError, match="nested too deeply"):
        read_json(path)


@FEW
@given(st.binary(max_size=200))
def test_any_bytes_as_configuration(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "config.yml"
    path.write_bytes(content)
    for read in (read_file, read_json, read_yaml, lambda _: RunFolder(tmp_path).read_config()):
        with contextlib.suppress(ConfigError):
            read(path)


@FEW
@given(st.text(max_size=40), st.sampled_from(["", "low.gamma:", "high.policy_kwargs.net_arch:", "compile:", "low:"]))
def test_any_text_as_a_setting(text: str, begin: str) -> None:
    with contextlib.suppress(ConfigError):
        parse_overrides([begin + text])


@FEW
@given(st.data())
def test_any_damage_of_a_file_of_arrays(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "replay.npz"
    write_arrays(path, {"a": np.arange(20.0), "b": np.zeros((3, 2), bool)})
    content = bytearray(path.read_bytes())
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[place] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    with contextlib.suppress(ValueError):
        read_arrays(path)


def test_arrays_that_need_unpickling_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="no whole file of arrays"):
        read_arrays(tmp_path / "a.npz")


@FEW
@given(st.text(max_size=30))
def test_any_text_as_a_name(text: str) -> None:
    for make in (folder_name, flat_name):
        with contextlib.suppress(ConfigError):
            name = make(text, "the name")
            assert Path("root", name).parent == Path("root")
            assert name not in ("", ".", "..")
    assert "\n" not in one_line(text)
    compile(f'"""{in_docstring(text)}"""', "module", "exec")


@pytest.mark.parametrize("text", ["../x", "..", ".", "", "a/b", "a\\b", "-x", "a\nb", "a\udcff", "x" * 200, "a.", " a"])
def test_names_that_lead_elsewhere(text: str) -> None:
    with pytest.raises(ConfigError, match="the variant must"):
        folder_name(text, "the variant")


@pytest.mark.parametrize("text", ["NUL", "con", "aux.v2", "COM1", "lpt9", "Prn.tar.gz", "com²", "nul .x"])
def test_names_that_windows_keeps_for_devices(text: str) -> None:
    for make in (folder_name, flat_name):
        with pytest.raises(ConfigError, match="the variant must not be a name that Windows keeps for a device"):
            make(text, "the variant")
    assert folder_name(f"{text[:3]}sole", "the variant")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 10**400, "0.9", True, None, [1], 7, -3])
def test_numbers_that_are_none(value: object) -> None:
    with pytest.raises(ConfigError, match="success_rate must"):
        number(value, "success_rate", 0.0, 1.0)
    assert number(1, "success_rate", 0.0, 1.0) == 1.0


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://u:SECRET@h/db",
        "postgresql://u:SECRET@@h/db",
        "postgresql://u:a//SECRET@h/db",
        "postgresql://u:a?SECRET@h/db",
        "postgresql://u:a#SECRET@h/db",
        "postgresql://u%3ASECRET@h/db",
        "postgresql://u:SECRET",
        "postgresql://h/db?PASSWORD=SECRET",
        "mysql://h/db?passwd=SECRET&x=1",
        "postgresql://h/db?options=-c%20password=SECRET",
        "postgresql://h/db?password%3DSECRET",
        "postgresql:u:SECRET@h/db",
        "postgres:/u:SECRET@h/db",
        "u:SECRET@h/db",
        "redis://:SECRET@h:6379/0",
        "host=h user=u password=SECRET dbname=x",
        "postgresql+psycopg://u:a:SECRET@h:5432/db",
        "mysql+pymysql://u:SECRET@[::1]:3306/db",
        "postgresql://u@h/db?sslmode=require&sslpassword=SECRET",
        "sqlite+pysqlcipher://:SECRET@/study.db",
        "postgresql://u:SECRET@h,h2:5433/db?target_session_attrs=any",
    ],
)
def test_passwords_are_not_shown(url: str) -> None:
    assert "SECRET" not in without_password(url)


@pytest.mark.parametrize(
    "url", ["sqlite:////tmp/a.db", "runs/a:b/journal.log", "postgresql://u@h:5432/db?sslmode=require", "sqlite:///C:/a"]
)
def test_storages_without_a_password_are_shown_whole(url: str) -> None:
    assert without_password(url) == url


def test_half_a_last_line_of_a_journal_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "journal.log"
    for content, kept in [(b"a\nb\nha", b"a\nb\n"), (b"ha", b""), (b"a\n", b"a\n"), (b"", b"")]:
        path.write_bytes(content)
        drop_half_line(path)
        assert path.read_bytes() == kept
    assert [p.name for p in tmp_path.iterdir()] == ["journal.log"]
