"""All measures of one agent together, as plain data and as text, with the paper's figures beside them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import FloatArray
from sb3_tbc.interpret.correlation import Correlation, correlate
from sb3_tbc.interpret.episodes import HeldOutEpisodes, Trace, outcome_of
from sb3_tbc.interpret.features import TaskSpace, features_of
from sb3_tbc.interpret.information import PhaseInformation, phase_information
from sb3_tbc.interpret.lesions import (
    LesionResult,
    Plan,
    activity,
    mean_drop,
    plan_lesions,
    run_lesions,
    run_synapses,
)
from sb3_tbc.interpret.time_constants import MemoryShare, TimeConstants, memory_share, time_constants
from sb3_tbc.interpret.units import CircuitUnits, Units, no_lesion
from sb3_tbc.ndbc.dissipative import DissipativeCell
from sb3_tbc.tbc_hrl import TBCHRL

PAPER = {
    "drop_top5": 0.128,
    "drop_top5_pm": 0.023,
    "mean_correlation": 0.47,
    "mean_correlation_pm": 0.06,
    "information_mean": 0.36,
    "information_p90": 0.52,
}
"""The paper's figures for the circuit of UR5Reacher (section 5.2)."""


class Effort(NamedTuple):
    """How many lesions are made."""

    n_random: int = 5
    max_alone: int = 24
    synapses: bool = False


class Findings(NamedTuple):
    """Everything measured on one agent."""

    task: str
    kind: str  # "circuit" or "mlp"
    dynamics: str  # of a circuit: "conductance" or "dissipative"; "" of an MLP
    memory: str
    units: Units
    traces: list[Trace]
    features: tuple[str, ...]
    success: float
    subgoals: float
    activity: FloatArray  # (N,)
    correlation: Correlation
    information: PhaseInformation | None
    time_constants: TimeConstants | None
    memory_share: MemoryShare | None
    lesions: list[LesionResult]

    @property
    def most(self) -> int:
        """Units clamped together for the figure beside the paper's: its five, or all where there are fewer."""
        return min(5, len(self.units.names))

    @property
    def all_alike(self) -> bool:
        """Whether every episode was the same, as on a task without chance: intervals then mean nothing."""
        first = self.traces[0].inputs
        return len(self.traces) > 1 and all(np.array_equal(t.inputs, first) for t in self.traces)


def investigate(
    model: TBCHRL, units: Units, space: TaskSpace, task: str, episodes: HeldOutEpisodes, effort: Effort
) -> Findings:
    """Run the held-out episodes, whole and lesioned, and measure everything.

    :param model: the agent
    :param units: of its low level
    :param space: of its task
    :param task: its short name
    :param episodes: to run
    :param effort: how many lesions
    """
    traces = episodes.record(units, no_lesion(units))
    subgoals = model.views.subgoals
    tables = [features_of(t, space, subgoals, model.rules.dt_max) for t in traces]
    whole = outcome_of([t.episode for t in traces])
    circuit = units if isinstance(units, CircuitUnits) else None
    remembers = circuit is not None and model.config.memory != "none"
    plans = plan_lesions(units, traces, n_random=effort.n_random, max_alone=effort.max_alone)
    if remembers:
        wiped = no_lesion(units)._replace(wiped=np.ones(1, dtype=bool))
        plans.append(Plan("memory", (), "", wiped))
    lesions = run_lesions(episodes, units, traces, whole, plans)
    if effort.synapses and circuit is not None:
        lesions += run_synapses(episodes, circuit, traces, whole)
    dissipative = circuit is not None and isinstance(circuit.net.cell, DissipativeCell)
    return Findings(
        task=task,
        kind="mlp" if circuit is None else "circuit",
        dynamics="" if circuit is None else "dissipative" if dissipative else "conductance",
        memory=model.config.memory,
        units=units,
        traces=traces,
        features=tuple(tables[0]),
        success=float(whole.success.mean()),
        subgoals=float(whole.subgoals.mean()),
        activity=activity(units, traces),
        correlation=correlate([t.activations for t in traces], [np.stack(list(t.values()), axis=1) for t in tables]),
        information=phase_information([t.activations[w] for t in traces for w in t.windows]),
        time_constants=None if circuit is None else time_constants(circuit, traces),
        memory_share=memory_share(units, traces) if remembers else None,
        lesions=lesions,
    )


def to_plain(found: Findings, identity: PlainMapping) -> Plain:
    """Plain data for a JSON file.

    :param identity: what the agent is, put first
    """
    information, constants, share = found.information, found.time_constants, found.memory_share
    return {
        **identity,
        "n_episodes": len(found.traces),
        "all_episodes_alike": found.all_alike,
        "units": found.kind,
        "dynamics": found.dynamics or None,
        "memory": found.memory,
        "success_rate": found.success,
        "subgoals_reached": found.subgoals,
        "summary": summary(found),
        "paper": PAPER,
        "unit_names": list(found.units.names),
        "activity": _rounded(found.activity),
        "correlation": {
            "features": list(found.features),
            **{name: _rounded(getattr(found.correlation, name)) for name in found.correlation._fields},
        },
        "information": None
        if information is None
        else {
            "bits": _rounded(information.bits),
            "control": _rounded(information.control),
            "n_windows": information.n_windows,
        },
        "time_constants": None if constants is None else {k: _rounded(v) for k, v in constants._asdict().items()},
        "memory_share": None if share is None else share._asdict(),
        "lesions": [_lesion(result) for result in found.lesions],
    }


def _lesion(result: LesionResult) -> Plain:
    plain = result._asdict()
    for name in ("success", "subgoals"):
        drop = plain[name]
        plain[name] = None if drop is None else drop._asdict()
    return plain


def _rounded(values: ArrayLike) -> list[float]:
    rounded: list[float] = np.round(np.asarray(values, dtype=np.float64), 5).tolist()
    return rounded


def summary(found: Findings) -> dict[str, float | None]:
    """Our figures by the names of :data:`PAPER`, and those of their controls."""
    information = found.information
    values: dict[str, float | None] = {}
    for form in ("rest", "mean"):
        for what in ("top", "random"):
            drop = mean_drop(found.lesions, what, found.most, form)
            values[f"drop_{what}5_{form}"] = None if drop is None else drop.drop
    values["mean_correlation"] = found.correlation.mean
    values["mean_correlation_control"] = found.correlation.control_mean
    values["significant_correlations"] = found.correlation.significant
    values["information_mean"] = None if information is None else information.mean
    values["information_p90"] = None if information is None else information.percentile_90
    values["information_control"] = None if information is None else float(information.control.mean())
    return {name: None if value is None else round(value, 4) for name, value in values.items()}
