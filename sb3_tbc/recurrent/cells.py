"""Recurrent cells with one interface: the next state of a step, the states of a sequence, what is read from a state."""

from __future__ import annotations

from typing import Any

import torch as th
from torch import nn

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.extras import require
from sb3_tbc.ndbc import NDBCNet, NDBCWiring
from sb3_tbc.ndbc.wiring import WIRING_KEYS
from sb3_tbc.tbc_hrl.level_config import CircuitConfig

CIRCUIT: Plain = {
    "synapses": "lean",
    "inter": 16,
    "command": 16,
    "motor": 8,
    "sensory_fanout": 16,
    "inter_fanout": 16,
    "recurrent_command_synapses": 32,
    "motor_fanin": 16,
    "sensory_to": ("inter", "command"),
    "time_constants": {"command": (0.5, 3.0)},
    "initial_gains": (6.0, 12.0),
}
"""Settings of the circuit unless given: slow command neurons, since the paper's fast ones forget within one step."""


class MemoryCell(nn.Module):
    """A recurrent cell. A state of zeros is the state before anything happened.

    :param n_inputs: width of its inputs
    :param hidden_size: width of what is read from it
    """

    state_dim: int
    """Width of its state."""

    def __init__(self, n_inputs: int, hidden_size: int) -> None:
        super().__init__()
        self.n_inputs, self.hidden_size = n_inputs, hidden_size

    def forward(self, inputs: th.Tensor, state: th.Tensor) -> th.Tensor:
        """The state ``(batch, state_dim)`` after a step with inputs ``(batch, n_inputs)``."""
        raise NotImplementedError

    def read(self, state: th.Tensor) -> th.Tensor:
        """What the networks behind it see of its states ``(..., state_dim)``, ``(..., hidden_size)``."""
        return state

    def unroll(self, inputs: th.Tensor, starts: th.Tensor) -> th.Tensor:
        """States after every step of sequences, ``(batch, time, state_dim)``, from a blank state.

        :param inputs: ``(batch, time, n_inputs)``
        :param starts: ``(batch, time)``, whether an episode begins with a step
        """
        state, trace = inputs.new_zeros(len(inputs), self.state_dim), []
        for step, start in zip(inputs.unbind(1), starts.unbind(1), strict=True):
            state = self(step, th.where(start.unsqueeze(-1), 0.0, state))
            trace.append(state)
        return th.stack(trace, dim=1)


class NDBCCell(MemoryCell):
    """The NDBC circuit; its readout is what the networks behind it see.

    :param settings: see :class:`~sb3_tbc.tbc_hrl.level_config.CircuitConfig`; by default :data:`CIRCUIT`
    """

    def __init__(self, n_inputs: int, hidden_size: int, scale: list[float], **settings: Any) -> None:
        super().__init__(n_inputs, hidden_size)
        circuit = CircuitConfig.from_dict({**CIRCUIT, "input_scale": tuple(scale), **settings}).to_dict()
        wiring = NDBCWiring(n_inputs, **{name: circuit.pop(name) for name in WIRING_KEYS})
        self.net = NDBCNet(n_inputs, hidden_size, wiring, **circuit)
        self.state_dim = self.net.state_dim

    def forward(self, inputs: th.Tensor, state: th.Tensor) -> th.Tensor:
        """See :class:`MemoryCell`."""
        return self.net(inputs, state)[1]  # type: ignore[no-any-return]

    def read(self, state: th.Tensor) -> th.Tensor:
        """The circuit's readout, a weighted sum of all potentials."""
        return self.net.read(state)

    def unroll(self, inputs: th.Tensor, starts: th.Tensor) -> th.Tensor:
        """See :class:`MemoryCell`; in one node of the autograd graph."""
        return self.net.unroll(inputs, mask=(~starts).to(inputs.dtype))


class ScaledCell(MemoryCell):
    """A cell of torch or ncps, whose inputs are divided by fixed scales.

    :param scale: what inputs are divided by, ``n_inputs`` numbers
    """

    def __init__(self, n_inputs: int, hidden_size: int, scale: list[float], **settings: Any) -> None:
        super().__init__(n_inputs, hidden_size)
        self.scale: th.Tensor
        self.register_buffer("scale", th.tensor(scale))
        self.state_dim = hidden_size
        self.cell = self._cell(settings)

    def _cell(self, settings: Plain) -> Any:
        return nn.GRUCell(self.n_inputs, self.hidden_size, **settings)

    def forward(self, inputs: th.Tensor, state: th.Tensor) -> th.Tensor:
        """See :class:`MemoryCell`."""
        return self.cell(inputs / self.scale, state)  # type: ignore[no-any-return]


class LTCCell(ScaledCell):
    """Liquid time-constant cell, fully connected (arXiv 2006.04439), from ncps; ``ode_unfolds`` is its setting."""

    def _cell(self, settings: Plain) -> Any:
        ncps = require("ncps.torch", extra="ncps", what="the LTC cell")
        return ncps.LTC(self.n_inputs, self.hidden_size, **settings).rnn_cell

    def forward(self, inputs: th.Tensor, state: th.Tensor) -> th.Tensor:
        """See :class:`MemoryCell`."""
        return self.cell(inputs / self.scale, state)[1]  # type: ignore[no-any-return]


class CfCCell(ScaledCell):
    """Closed-form continuous-time cell (arXiv 2106.13898), from ncps; ``backbone_units`` and so on are its settings."""

    def _cell(self, settings: Plain) -> Any:
        ncps = require("ncps.torch", extra="ncps", what="the CfC cell")
        return ncps.CfC(self.n_inputs, self.hidden_size, **settings).rnn_cell

    def forward(self, inputs: th.Tensor, state: th.Tensor) -> th.Tensor:
        """See :class:`MemoryCell`."""
        return self.cell(inputs / self.scale, state, 1.0)[1]  # type: ignore[no-any-return]


CELLS: dict[str, type[MemoryCell]] = {"ndbc": NDBCCell, "gru": ScaledCell, "ltc": LTCCell, "cfc": CfCCell}
"""Cells by name."""


def make_cell(name: str, n_inputs: int, hidden_size: int, scale: list[float], settings: PlainMapping) -> MemoryCell:
    """A cell by its name.

    :param name: of :data:`CELLS`
    :param n_inputs: width of its inputs
    :param hidden_size: width of what is read from it
    :param scale: what inputs are divided by, ``n_inputs`` positive numbers
    :param settings: further arguments of the cell
    :raises ConfigError: for another name, or settings that the cell does not have
    """
    if name not in CELLS:
        raise ConfigError(f"cell must be one of {', '.join(map(repr, CELLS))}, got {name!r}; {nearest(name, CELLS)}")
    try:
        return CELLS[name](n_inputs, hidden_size, scale=scale, **settings)  # type: ignore[call-arg]
    except TypeError as error:
        raise ConfigError(f"cell_kwargs do not fit the cell {name!r}: {error}") from error
