"""What the command writes, and where."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest
from exported import make

from sb3_tbc.errors import ConfigError
from sb3_tbc.export.command import SUFFIXES, WRITERS, command, default_output
from sb3_tbc.export.policy import extract


def test_a_program_of_the_agents_name_is_not_replaced(tmp_path: Path) -> None:
    """``pendulum.py`` often saves ``pendulum.zip``; without ``--output``, its export goes there."""
    agent, policy = tmp_path / "pendulum.zip", extract(make("reached")[0], "pendulum")
    for kind in sorted(SUFFIXES) if find_spec("onnx") else ["c", "numpy"]:
        path = agent.with_suffix(SUFFIXES[kind])
        assert default_output(agent, SUFFIXES[kind]) == path
        WRITERS[kind](policy, path)
        assert default_output(agent, SUFFIXES[kind]) == path  # an earlier export is replaced
        path.write_text("import sb3_tbc  # what no one else has\n")
        with pytest.raises(ConfigError, match="stays as it is; name another file with --output"):
            command([str(agent), "--format", kind])
        assert path.read_text() == "import sb3_tbc  # what no one else has\n"
