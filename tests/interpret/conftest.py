"""A trained agent and its held-out episodes, made once."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sb3_tbc.interpret.episodes import HeldOutEpisodes, Trace
from sb3_tbc.interpret.units import CircuitUnits, no_lesion
from sb3_tbc.pretrained import load_pretrained
from sb3_tbc.tbc_hrl import TBCHRL

N = 6


@pytest.fixture(scope="session")
def agent() -> TBCHRL:
    model = load_pretrained("Pendulum")
    assert isinstance(model, TBCHRL)
    return model


@pytest.fixture(scope="session")
def units(agent: TBCHRL) -> CircuitUnits:
    return CircuitUnits(agent.low.policy.average_actor)


@pytest.fixture(scope="session")
def episodes(agent: TBCHRL) -> Iterator[HeldOutEpisodes]:
    held_out = HeldOutEpisodes(agent, "sb3_tbc/Pendulum-v0", {}, N)
    yield held_out
    held_out.close()


@pytest.fixture(scope="session")
def traces(episodes: HeldOutEpisodes, units: CircuitUnits) -> list[Trace]:
    return episodes.record(units, no_lesion(units))
