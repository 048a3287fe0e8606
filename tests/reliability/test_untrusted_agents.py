"""Loading an untrusted agent file runs no code from that file, unless the user says that it is trusted."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import pickle
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corridor import Corridor
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_tbc import TBCHRL, evaluate
from sb3_tbc.errors import ConfigError
from sb3_tbc.tbc_hrl import HAC, HiTS
from sb3_tbc.tbc_hrl.archive import PLAIN_DATA, UntrustedError
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.tbc_hrl.plain import NotPlainError, decode, encode
from sb3_tbc.zoo.algorithms import load_model, load_two_levels
from sb3_tbc.zoo.environments import make_envs

KINDS = {"tbc-hrl": TBCHRL, "hits": HiTS, "hac": HAC, "sac": FlatSAC}
AGENTS = Path(__file__).parents[1] / "data" / "agents"


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


def pickled(mark: Path) -> bytes:
    return pickle.dumps(Payload(mark), 2)


@pytest.fixture(scope="module")
def agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small agent, saved."""
    path = tmp_path_factory.mktemp("agent") / "model.zip"
    small = {"batch_size": 8, "buffer_size": 1000}
    env = make_envs("sb3_tbc/Pendulum-v0", 1, 0)
    model = TBCHRL("MultiInputPolicy", env, high=small, low=small, compile=False, seed=0)
    model.run_info = {"algo": "tbc-hrl", "task": "Pendulum", "env_id": "sb3_tbc/Pendulum-v0", "env_kwargs": {}}
    model.learn(250)
    model.save(path)
    return path


def rewritten(source: Path, target: Path, change: Callable[[str, bytes], bytes | None], **more: bytes) -> Path:
    """A copy of an agent with its members changed, left out, or added."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = change(name, old.read(name))
            if content is not None:
                new.writestr(name, content)
        for name, content in more.items():
            new.writestr(name, content)
    return target


def members(path: Path) -> list[str]:
    with zipfile.ZipFile(path) as archive:
        return archive.namelist()


def test_every_algorithm_loads_without_unpickling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kind in KINDS.items():
        for task in ("Pendulum", "AntFourRooms")[: 2 if name == "tbc-hrl" else 1]:
            env = make_envs(f"sb3_tbc/{task}-v0", 1, 0)
            model = kind("MultiInputPolicy", env, seed=0)
            model.learn(60)
            model.save(tmp_path / name)
            with monkeypatch.context() as patch:
                patch.setattr("cloudpickle.loads", lambda *_: pytest.fail("something was unpickled"))
                loaded = kind.load(tmp_path / f"{name}.zip", env=env if name == "sac" else None)
            observation = env.reset()
            actions = [m.predict(observation, deterministic=True)[0] for m in (model, loaded)]
            np.testing.assert_array_equal(*actions)
            assert list(loaded.observation_space.spaces) == list(model.observation_space.spaces)
            assert loaded.observation_space == model.observation_space
            assert loaded.num_timesteps == model.num_timesteps


def test_stable_baselines3_reads_our_files(agent: Path) -> None:
    data, parameters, _ = load_from_zip_file(agent)
    assert data is not None
    assert data["observation_space"] == TBCHRL.load(agent).observation_space
    assert "low.policy" in parameters


@pytest.mark.parametrize("kind", [TBCHRL, HiTS, HAC])
def test_agents_of_the_first_version_need_trust(kind: Any) -> None:
    path = AGENTS / f"{kind.__name__}-0.1.0.zip"
    with pytest.raises(UntrustedError, match=r"as a pickle, which can run any code; if you trust .* trust=True"):
        kind.load(path)
    assert kind.load(path, trust=True).num_timesteps > 0


def test_no_member_runs_code(agent: Path, tmp_path: Path) -> None:
    """In every entry that SB3 would unpickle, in a new one, and in place of every member."""
    with zipfile.ZipFile(agent) as archive:
        data = json.loads(archive.read("data"))
    entries = [key for key, value in data.items() if isinstance(value, dict) and ":serialized:" in value]
    mark = tmp_path / "ran"
    hidden = {":type:": "x", ":serialized:": base64.b64encode(pickled(mark)).decode()}
    files = []
    for k, entry in enumerate([*entries, "new_entry", "_last_original_obs", "env"]):
        text = json.dumps({**data, entry: hidden}).encode()
        files.append(rewritten(agent, tmp_path / f"e{k}.zip", lambda n, c, t=text: t if n == "data" else c))
    for k, member in enumerate(members(agent)):
        payload = pickled(mark)
        files.append(rewritten(agent, tmp_path / f"m{k}.zip", lambda n, c, m=member, p=payload: p if n == m else c))
        if member.endswith(".pth"):
            files.append(rewritten(agent, tmp_path / f"i{k}.zip", _inner(member, payload)))
    assert len(files) > 25
    for path in files:
        for load in (load_model, load_two_levels, TBCHRL.load, lambda p: evaluate.identify(p, None)):
            with contextlib.suppress(Exception):
                load(path)
            assert not mark.exists(), f"{path.name} ran code"
    with contextlib.suppress(Exception):  # the payload is a real one
        TBCHRL.load(tmp_path / "e0.zip", trust=True)
    assert mark.exists()


def _inner(member: str, payload: bytes) -> Callable[[str, bytes], bytes]:
    """Replace the pickle inside a file of weights."""

    def change(name: str, content: bytes) -> bytes:
        if name != member:
            return content
        target = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(target, "w") as new:
            for inner in old.namelist():
                new.writestr(inner, payload if inner.endswith("data.pkl") else old.read(inner))
        return target.getvalue()

    return change


def plain_with(agent: Path, target: Path, **changes: Any) -> Path:
    def change(name: str, content: bytes) -> bytes:
        return json.dumps({**json.loads(content), **changes}).encode() if name == PLAIN_DATA else content

    return rewritten(agent, target, change)


@pytest.mark.parametrize(
    "value",
    [
        {"plain": "class", "name": "subprocess:Popen"},
        {"plain": "class", "name": "os:system"},
        {"plain": "function", "name": "sb3_tbc.zoo.ledger:versions"},
        {"plain": "function", "name": "sb3_tbc.files:shutil.rmtree"},
        {"plain": "class", "name": "sb3_tbc.tasks.evil:Evil"},
        {"plain": "object", "class": "subprocess:Popen", "fields": {"args": "x"}},
        {"plain": "object", "class": "sb3_tbc.smdp.spaces:SubgoalSpace", "fields": {"low": 1}},
        {"plain": "partial", "call": 3, "arguments": [], "named": {}},
        {"plain": "array", "dtype": "O", "shape": [1], "values": [1]},
        {"plain": "array", "dtype": "<f8", "shape": [10**12], "values": [1]},
        {"plain": "never heard of"},
        {"plain": ["a"]},
        3,
        None,
        [[[[]]]],
    ],
)
def test_plain_data_names_nothing_else(value: Any, agent: Path, tmp_path: Path) -> None:
    for key in ("policy_class", "observation_space", "subgoals") if isinstance(value, dict) else ("observation_space",):
        with pytest.raises(ConfigError):
            load_model(plain_with(agent, tmp_path / "m.zip", **{key: value}))


def test_bombs_and_foreign_members_are_refused(agent: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", "{}")
        archive.writestr("low.policy.pth", b"\0" * 200_000_000)
    with pytest.raises(ConfigError, match="would unpack to far more"):
        load_model(tmp_path / "bomb.zip")
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 200_000_000)
    rewritten(agent, tmp_path / "inner.zip", lambda n, c: inner.getvalue() if n == "low.policy.pth" else c)
    with pytest.raises(ConfigError, match=r"low.policy.pth would unpack to far more"):
        load_model(tmp_path / "inner.zip")
    for name in ("../../escaped", "/etc/passwd", "a\\b", "low/policy.pth", "data"):
        path = rewritten(agent, tmp_path / "m.zip", lambda n, c: c, **{name: b"{}"})
        with pytest.raises(ConfigError, match="no agent"):
            load_model(path)
    deep = "[" * 100_000 + "]" * 100_000
    path = rewritten(agent, tmp_path / "m.zip", lambda n, c: deep.encode() if n == "data" else c)
    with pytest.raises(ConfigError, match="not a complete agent"):
        load_model(path)


def test_an_agents_environment_is_not_imported(agent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "evilmod.py").write_text(f"import os\nos.mkdir({str(tmp_path / 'ran')!r})\n")
    monkeypatch.syspath_prepend(tmp_path)

    def change(name: str, content: bytes) -> bytes:
        return content.replace(b'"sb3_tbc/Pendulum-v0"', b'"evilmod:sb3_tbc/Pendulum-v0"')

    path = rewritten(agent, tmp_path / "m.zip", change)
    with pytest.raises(UntrustedError, match=r"asks to import the module 'evilmod'.*--env evilmod:sb3_tbc/Pendulum-v0"):
        evaluate.identify(path, None)
    assert not (tmp_path / "ran").exists()
    evaluate.identify(path, None, trust=True)
    assert evaluate.identify(path, "Pendulum")["env_id"] == "sb3_tbc/Pendulum-v0"


def test_what_has_no_plain_form_is_taken_from_the_environment_or_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The corridor's subgoal functions are not the package's: they are found where their module is in use."""
    model = TBCHRL("MultiInputPolicy", Corridor(), compile=False, seed=0).learn(50)
    model.save(tmp_path / "m.zip")
    assert TBCHRL.load(tmp_path / "m.zip").num_timesteps == model.num_timesteps
    monkeypatch.delitem(sys.modules, "corridor")
    with pytest.raises(ConfigError, match=r"subgoals .*corridor"):
        TBCHRL.load(tmp_path / "m.zip")
    assert TBCHRL.load(tmp_path / "m.zip", trust=True).num_timesteps == model.num_timesteps
    assert TBCHRL.load(tmp_path / "m.zip", env=Corridor()).subgoals is not None


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
PART = st.sampled_from(["low", "high", "items", "dtype", "shape", "values", "n", "start"])
KIND = st.sampled_from(
    ["number", "array", "box", "discrete", "binary", "spaces", "unit", "tuple", "deque", "slice", "schedule", "object"]
)


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    JSON,
    KIND,
    st.dictionaries(st.sampled_from(["low", "high", "items", "dtype", "shape", "values", "n", "start"]), JSON),
)
def test_any_plain_data_is_read_or_refused(value: Any, kind: str, parts: dict[str, Any]) -> None:
    for data in (value, {"plain": kind, **parts}):
        with contextlib.suppress(NotPlainError):
            decode(data)


@settings(max_examples=200, deadline=None)
@given(JSON)
def test_plain_data_comes_back_as_it_was(value: Any) -> None:
    assert repr(decode(json.loads(json.dumps(encode(value))))) == repr(value)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3, start=-1),
        spaces.MultiBinary(4),
        spaces.MultiBinary([2, 3]),
        spaces.MultiDiscrete([2, 5], start=[1, 0]),
        spaces.Dict({"z": spaces.Discrete(2), "a": spaces.Box(-1, 1, (2,))}),
    ],
    ids=str,
)
def test_spaces_come_back_as_they_were(space: spaces.Space[Any]) -> None:
    assert decode(json.loads(json.dumps(encode(space)))) == space


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_a_damaged_file_is_refused_as_such(agent: Path, tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(agent.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    else:
        for place in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=5)):
            content[place] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path / "m.zip"
    path.write_bytes(content)
    with contextlib.suppress(ConfigError):
        load_model(path)
