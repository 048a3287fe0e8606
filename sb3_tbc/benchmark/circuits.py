"""The circuits of the shipped configurations, and their sizes for ``python -m sb3_tbc.benchmark parameters``."""

from __future__ import annotations

from typing import NamedTuple

from sb3_tbc.aliases import Plain
from sb3_tbc.ndbc.diagnostics import count_parameters
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring

PAPER_TASKS = ("AntFourRooms", "UR5Reacher", "Drawbridge", "Tennis2D", "Pendulum", "Platforms")
WIRING_NUMBERS = (
    "inter",
    "command",
    "motor",
    "sensory_fanout",
    "inter_fanout",
    "recurrent_command_synapses",
    "motor_fanin",
)
"""Meaning of the numbers of table A1, in order."""


class ShippedCircuit(NamedTuple):
    """The low level's circuit of a task in a shipped configuration."""

    task: str
    config: str  # "paper" (table A1) or "tuned"
    wiring: NDBCWiring
    sub_steps: int
    synapses: str  # "paper" or "lean"
    n_actions: int
    hidden: list[int]  # widths of the MLP it replaces, the low level of HiTS

    @property
    def title(self) -> str:
        """Task; configuration, K and synapses if they are not those of the paper."""
        lean = ", lean" if self.synapses == "lean" else ""
        return self.task if self.config == "paper" else f"{self.task}, {self.config}, K = {self.sub_steps}{lean}"


def shipped_circuits() -> list[ShippedCircuit]:
    """Every task's circuit of table A1, followed by the tuned one if it differs."""
    found: list[ShippedCircuit] = []
    for task in PAPER_TASKS:
        paper, tuned = (_shipped_circuit(task, config) for config in ("paper", "tuned"))
        found.append(paper)
        if tuned._replace(config="paper", n_actions=0, hidden=[]) != paper._replace(n_actions=0, hidden=[]):
            found.append(tuned)
    return found


def paper_numbers(task: str) -> dict[str, int]:
    """Table A1's numbers of a task's circuit."""
    from sb3_tbc.zoo.config import load_config

    numbers = load_config("tbc-hrl", task, "paper").model["low"]["policy_kwargs"]["ndbc"]
    return {name: int(numbers[name]) for name in WIRING_NUMBERS}


def _shipped_circuit(task: str, config: str) -> ShippedCircuit:
    import gymnasium as gym

    import sb3_tbc.tasks
    from sb3_tbc.zoo.config import load_config

    sb3_tbc.tasks.register_tasks()
    settings = load_config("tbc-hrl", task, config)
    env = gym.make(f"sb3_tbc/{task}-v0", **settings.env_kwargs)
    subgoals = env.unwrapped.subgoals  # type: ignore[attr-defined]
    numbers = settings.model["low"]["policy_kwargs"]["ndbc"]
    drawn = {name: numbers[name] for name in (*WIRING_NUMBERS, "sensory_to") if name in numbers}
    wiring = NDBCWiring(subgoals.local_dim + subgoals.dim + 1, **drawn)
    hidden = load_config("hits", task, config).model["low"]["policy_kwargs"]["net_arch"]
    n_actions = env.action_space.shape[0]  # type: ignore[index]
    env.close()
    options = (numbers.get("sub_steps", 3), numbers.get("synapses", "paper"))
    return ShippedCircuit(task, config, wiring, *options, n_actions, hidden)


def parameters() -> tuple[list[str], Plain]:
    """The shipped circuits as SAC actors of the low level, beside the MLP of the task's configuration."""
    lines = [
        "| task | neurons | synapses | circuit, parameters | MLP, hidden layers | MLP, parameters | circuit / MLP |",
        "|---|---|---|---|---|---|---|",
    ]
    rows = []
    for circuit in shipped_circuits():
        wiring = circuit.wiring
        net = NDBCNet(wiring.n_inputs, 2 * circuit.n_actions, wiring, seed=0, synapses=circuit.synapses)
        count = count_parameters(net, circuit.hidden)
        row = {"task": circuit.task, "config": circuit.config, "hidden": circuit.hidden}
        rows.append({**row, **count._asdict(), "share": count.ratio})
        widths = "x".join(str(h) for h in circuit.hidden)
        numbers_of = (count.neurons, count.synapses, count.ndbc, widths, count.mlp)
        lines.append(f"| {circuit.title} | {' | '.join(str(n) for n in numbers_of)} | {count.ratio:.1%} |")
    return lines, {"parameters": rows}
