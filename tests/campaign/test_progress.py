"""What is said of a campaign's runs."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from sb3_tbc.campaign.jobs import Job
from sb3_tbc.campaign.progress import Board
from sb3_tbc.zoo.ledger import RunFolder


@pytest.mark.parametrize(
    ("final", "told"),
    [
        ('{"success_rate": 0.5, "n_timesteps": 1000}', "success 0.50 at 1,000 steps"),
        ("{}", "will refuse it: KeyError('success_rate')"),
        ('{"success_rate": "much", "n_timesteps": 5}', "will refuse it: ValueError("),
        ('{"success_rate": 1.0}', "will refuse it: KeyError('n_timesteps')"),
        ("[]", "will refuse it: "),
    ],
)
def test_a_result_that_says_nothing_sensible_ends_no_campaign(final: str, told: str, tmp_path: Path) -> None:
    """Somebody else wrote it: it lies in the ledger, where the report refuses it by name."""
    target, said = RunFolder(tmp_path), io.StringIO()
    (tmp_path / "final.json").write_text(final)
    board = Board(1, Console(file=said, width=500))
    board.done(Job("hits", "Pendulum", 0, target, target, ()))
    assert told in said.getvalue()
    assert said.getvalue().count("\n") == 1
    assert board.ended == 1
