"""Pushing agents to a hub and loading them again, against a server on this machine that answers as the Hub does."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("huggingface_hub")

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Handler(BaseHTTPRequestHandler):
    """The few calls of the Hub that pushing and loading make."""

    files: dict[str, bytes]
    tokens: set[str]

    def log_message(self, *args: Any) -> None:
        """Be quiet."""

    def answer(self, body: bytes, code: int = 200, **headers: str) -> None:
        self.send_response(code)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.tokens.add(self.headers.get("Authorization", "none"))
        if "refused" in self.path or b"refused" in body:
            self.answer(b'{"error": "not yours"}', 403)
            return
        address = f"http://{self.headers['Host']}/owner/agent"
        reply: Any = {"errors": [], "warnings": [], "url": address, "name": "owner/agent"}
        if "/preupload/" in self.path:
            asked = json.loads(body)["files"]
            reply = {"files": [{"path": f["path"], "uploadMode": "regular", "shouldIgnore": False} for f in asked]}
        elif "/commit/" in self.path:
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    self.files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            reply = {"commitUrl": f"{address}/commit/{COMMIT}", "commitOid": COMMIT, "success": True}
        self.answer(json.dumps(reply).encode(), Content_Type="application/json")

    def do_GET(self) -> None:
        found = re.fullmatch(r"/owner/agent/resolve/[^/]+/(.+)", self.path)
        content = self.files.get(found[1]) if found else None
        if content is None:
            self.answer(b"", 404, X_Error_Code="EntryNotFound")
        else:
            self.answer(content, ETag=f'"{hashlib.sha1(content).hexdigest()}"', X_Repo_Commit=COMMIT)

    do_HEAD = do_GET


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[type[Handler]]:
    handler = type("Handler", (Handler,), {"files": {}, "tokens": set()})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    yield handler
    server.shutdown()
    server.server_close()


def run(code: str) -> str:
    """Run code in a new process, which reads where the hub is when it starts; its last line, or what it raised."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=os.environ)
    return (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()[-1]


def test_an_agent_comes_back_as_it_was_pushed(hub: type[Handler]) -> None:
    code = """
import sys
sys.modules["huggingface_sb3"] = None  # not needed: its releases exclude what rl_zoo3 needs
import numpy as np
from sb3_tbc import load_from_hub, load_pretrained, push_to_hub
from sb3_tbc.pretrained import pretrained_path
print(push_to_hub(pretrained_path("Pendulum"), "owner/agent", token="mine"))
agent, same = load_pretrained("Pendulum"), load_from_hub("owner/agent")
observation = {key: np.full(space.shape, 0.1) for key, space in agent.observation_space.spaces.items()}
np.testing.assert_array_equal(*[a.predict(observation, deterministic=True)[0] for a in (agent, same)])
print("same")
"""
    assert run(code) == "same"
    assert set(hub.files) == {"model.zip", "README.md"}
    assert "Bearer mine" in hub.tokens
    card = hub.files["README.md"].decode()
    assert card.startswith("---\nlibrary_name: stable-baselines3\n")
    assert len(card) > 500  # the agent's own card


def test_a_stranger_s_agent_runs_no_code(hub: type[Handler]) -> None:
    """The same rules as for any file: what must be unpickled is refused."""
    code = """
from stable_baselines3 import SAC
from sb3_tbc import load_from_hub, push_to_hub
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.hub import download_from_hub
push_to_hub(SAC("MlpPolicy", "Pendulum-v1", buffer_size=10), "owner/agent", "sac.zip", card="# Mine")
try:
    FlatSAC.load(download_from_hub("owner/agent", "sac.zip"))
except Exception as error:
    print(type(error).__name__, error)
"""
    assert re.search(r"UntrustedError .*as a pickle, which can run any code", run(code))
    assert hub.files["README.md"].decode().endswith("---\n# Mine")


def test_an_agent_may_lie_in_a_folder_of_the_repository(hub: type[Handler]) -> None:
    code = """
from stable_baselines3 import PPO
from sb3_tbc import push_to_hub
from sb3_tbc.pretrained import pretrained_path
push_to_hub(pretrained_path("Pendulum"), "owner/agent", "pendulum/model.zip")
push_to_hub(PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8), "owner/agent", "others/ppo.zip")
print("pushed")
"""
    assert run(code) == "pushed"
    assert set(hub.files) == {"pendulum/model.zip", "others/ppo.zip", "README.md"}


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("load_from_hub('owner/agent', 'none.zip')", "ConfigError: cannot download none.zip of owner/agent"),
        ("load_from_hub('no such name')", "ConfigError: cannot download model.zip of no such name"),
        ("push_to_hub('nothing.zip', 'owner/agent')", "ConfigError: no such file: nothing.zip"),
        (
            "push_to_hub('nothing.zip', 'owner/agent', '../model.zip')",
            "ConfigError: filename must lie in the repository",
        ),
        ("push_to_hub(pretrained_path('Pendulum'), 'owner/agent', 'model')", "ConfigError: filename must end in .zip"),
        ("push_to_hub(pretrained_path('Pendulum'), 'owner/agent', 'README.md')", "ConfigError: filename must end in"),
        ("push_to_hub(pretrained_path('Pendulum'), 'owner/agent', '')", "ConfigError: filename must end in .zip"),
        ("push_to_hub(pretrained_path('Pendulum'), 'owner/refused', token='x')", "ConfigError: cannot push to owner/"),
    ],
)
def test_what_fails_is_said_in_one_line(hub: type[Handler], code: str, said: str) -> None:
    head = "from sb3_tbc import load_from_hub, push_to_hub; from sb3_tbc.pretrained import pretrained_path; "
    assert said in run(head + code)
