"""Nothing touches the network at run time: training, evaluating and reporting with every socket blocked."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from injection import SMALL

from sb3_tbc import evaluate, train
from sb3_tbc.report import command as report
from sb3_tbc.tune import command as tune


class Network(Exception):
    """Something asked for the network."""


@pytest.fixture(autouse=True)
def blocked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Local sockets remain: processes on this machine talk through them."""

    def refuse(*_: Any, **__: Any) -> None:
        raise Network

    connect = socket.socket.connect

    def local_only(self: socket.socket, address: Any) -> None:
        if self.family != socket.AF_UNIX:
            raise Network(address)
        connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", local_only)
    monkeypatch.setattr(socket.socket, "connect_ex", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr(socket, "create_connection", refuse)


def test_the_block_works() -> None:
    with pytest.raises(Network):
        socket.create_connection(("localhost", 9))


def test_train_evaluate_report_and_tune(tmp_path: Path) -> None:
    short = ["--n-timesteps", "300", "--eval-freq", "300", "--log-folder", str(tmp_path / "runs")]
    assert train.main(["--env", "Pendulum", *short, *SMALL]) == 0
    (model,) = tmp_path.glob("runs/*/*/*/seed_0/model.zip")
    assert evaluate.main([str(model), "--n-episodes", "1"]) == 0
    assert report.main([str(tmp_path / "runs"), "--html", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    for remote in ('src="http', "src='http", "@import", 'href="http://', "url(http"):
        assert remote not in page
    trials = ["--n-trials", "1", "--n-seeds", "1", "--n-eval-episodes", "1", "--n-final-episodes", "1"]
    search = ["--hyperparams", "compile:false", "gradient_ratio:0.02", "low.batch_size:16", "high.batch_size:8"]
    assert tune.main(["--env", "Pendulum", *short, *trials, *search]) == 0
