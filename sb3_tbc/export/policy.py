"""A trained two-level policy as plain numbers, from which every export format is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import NamedTuple, Protocol, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.errors import ConfigError
from sb3_tbc.level.actors import GRUActor, MemoryActor, NDBCActor
from sb3_tbc.level.policies import LevelActor
from sb3_tbc.ndbc.dissipative import DissipativeCell
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, width
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.scheduling import ReachRule

ACTIVATIONS: dict[type[nn.Module], str] = {nn.ReLU: "relu", nn.Tanh: "tanh"}
Reads = Callable[[Mapping[str, FloatArray]], FloatArray]
"""A task's function of a (batched) observation: its local state or its point in subgoal space."""


RETRAIN = "train it with duration='joint' or 'fixed'"
TIMED = "load it with window_end='timed' to export it with windows that run to their end"


class Coordinate(NamedTuple):
    """One coordinate of a state's subgoal-space point, computed from the concatenated observation and achieved goal.

    ``kind``: ``"clip"``: entry ``first`` clipped to [low, high]; ``"wrap"``: C's fmod of entry ``first`` and ``high``;
    ``"angle"``: atan2 of entries ``first`` and ``second``.
    """

    kind: str
    first: int
    second: int = 0
    low: float = -np.inf
    high: float = np.inf

    def __call__(self, entries: FloatArray) -> FloatArray:
        """The coordinate for entries ``(..., n)``."""
        value = entries[..., self.first]
        if self.kind == "angle":
            return np.asarray(np.arctan2(value, entries[..., self.second]))
        if self.kind == "wrap":
            return np.asarray(np.fmod(value, self.high))
        return np.asarray(np.clip(value, self.low, self.high))


@dataclass(frozen=True)
class MLP:
    """A feed-forward actor: hidden layers with one activation, then the mean."""

    weights: tuple[FloatArray, ...]  # (inputs, outputs) each
    biases: tuple[FloatArray, ...]
    activation: str


@dataclass(frozen=True)
class Circuit:
    """An NDBC circuit with the conductance cell's derived arrays; see :class:`~sb3_tbc.ndbc.cell.ConductanceArrays`.

    Lean circuits have no sensory synapses (S = 0), and their reversal potentials are +1 and -1.
    """

    sub_steps: int
    order: tuple[tuple[int, ...], ...]  # groups of neurons in the order of the closed form
    input_gain: FloatArray
    sensory_gain: FloatArray  # (S,)
    sensory_threshold: FloatArray  # (S,)
    current_weight: FloatArray  # (I, M)
    current_bias: FloatArray
    from_inputs: FloatArray  # (S + M, 2 N)
    recurrent: FloatArray  # (P, 2 N)
    rest: FloatArray  # (2 N,)
    capacitance: FloatArray
    gain: FloatArray
    threshold: FloatArray
    readout: FloatArray  # (N, actions): means only
    readout_bias: FloatArray

    @property
    def n_neurons(self) -> int:
        """Neurons with a membrane potential."""
        return len(self.capacitance)

    @property
    def lean(self) -> bool:
        """Whether a synapse is one number, whose size is the conductance and whose sign is the reversal potential."""
        return len(self.sensory_gain) == 0


@dataclass(frozen=True)
class Dissipative:
    """A dissipative circuit, ``x <- shrink (x + eta tanh(W u + U x + b))``; U includes the limit of ``max_rho``."""

    sub_steps: int
    eta: float  # length of a sub-step
    input_weight: FloatArray  # (I, N)
    bias: FloatArray
    recurrent: FloatArray  # (N, N)
    shrink: FloatArray  # diagonal of (I + eta K)^-1
    readout: FloatArray  # (N, actions): means only
    readout_bias: FloatArray

    @property
    def n_neurons(self) -> int:
        """Neurons with a state."""
        return len(self.bias)


@dataclass(frozen=True)
class ExportedPolicy:
    """Both levels' deterministic actors, and the rules by which an option begins and ends."""

    task: str
    n_observation: int
    n_achieved: int
    n_desired: int
    high: MLP
    low: MLP | Circuit | Dissipative
    mean_bounds: tuple[float, float]  # high, low; infinite if there is none
    local: tuple[int, ...]  # entries of (observation, achieved goal)
    achieved: tuple[Coordinate, ...]  # empty if no option ends on reaching its subgoal
    subgoal_low: FloatArray
    subgoal_high: FloatArray
    thresholds: FloatArray
    groups: tuple[tuple[int, ...], ...]
    dt_min: float
    dt_max: float
    window_end: str
    whole_budgets: bool  # whether time budgets are rounded to whole steps
    event: int | None  # entry of the observation whose flag ends an option
    memory: str
    achieved_in_observation: bool
    relative_subgoals: bool
    remaining_time: bool  # whether the low level sees it
    fixed_budget: float | None  # steps of every window, if the high level does not choose them
    action_low: FloatArray
    action_high: FloatArray
    weights: str = "float32"  # "int8": the low level's were rounded, see sb3_tbc.export.rounding

    @property
    def state_dim(self) -> int:
        """Membrane potentials; 0 for an MLP low level."""
        return 0 if isinstance(self.low, MLP) else self.low.n_neurons

    @property
    def subgoal_dim(self) -> int:
        """Number of subgoal coordinates."""
        return len(self.subgoal_low)

    @property
    def n_low_inputs(self) -> int:
        """Entries of the low level's observation: local state, subgoal, remaining time."""
        return len(self.local) + self.subgoal_dim + int(self.remaining_time)

    def plain(self) -> Plain:
        """All fields as dictionaries, numbers and arrays."""
        return asdict(self)


def extract(model: TBCHRL, task: str = "policy") -> ExportedPolicy:
    """Read everything the deterministic policy needs from a model.

    :param model: a trained agent
    :param task: name, for file names and comments
    :raises ConfigError: if a part of the model cannot be exported; the message names it
    """
    views, rules, subgoals = model.views, model.rules, model.views.subgoals
    if isinstance(model.schedule, ReachRule):
        raise ConfigError(f"duration='rule' cannot be exported: its windows come from another network; {RETRAIN}")
    if rules.may_be_reconsidered:
        raise ConfigError(
            "an agent with window_end='reconsider' cannot be exported: the high level's critic ends its windows, and "
            f"exports hold actors alone; {TIMED}"
        )
    unit_time = None if model.schedule is None else model.schedule.unit
    n_observation, n_achieved, n_desired = (width(cast(spaces.Dict, model.observation_space), key) for key in GOAL_KEYS)
    probe = _Probe(n_observation, n_achieved)
    needed = rules.window_end == "reached" or views.relative_subgoals
    if subgoals.rotations and rules.window_end == "reached":
        raise ConfigError(f"window_end='reached' with subgoals that are compared by angle cannot be exported; {TIMED}")
    high: LevelActor | _MLPActor = model.high.policy.average_actor
    low = model.low.policy.average_actor
    if model.foreign_high is not None:
        high = _foreign_actor(model.foreign_high)
    if isinstance(high, MemoryActor):
        raise ConfigError("only the low level can have a memory")
    if isinstance(low, GRUActor):
        raise ConfigError(
            "a low level with a GRU cannot be exported; train a circuit (low.policy_kwargs.ndbc) or an MLP"
        )
    actions = action_box(model)
    return ExportedPolicy(
        task=task,
        high=_read_mlp(high),
        low=read_circuit(low.net, _actions(low)) if isinstance(low, NDBCActor) else _read_mlp(low),
        mean_bounds=(_bound(high), _bound(low)),
        local=probe.selection(subgoals.local),
        achieved=probe.coordinates(subgoals.achieved) if needed else (),
        subgoal_low=subgoals.low,
        subgoal_high=subgoals.high,
        thresholds=subgoals.thresholds,
        groups=subgoals.groups,
        dt_min=float(rules.dt_min),
        dt_max=float(rules.dt_max),
        window_end=rules.window_end,
        whole_budgets=rules.whole_budgets,
        event=subgoals.event,
        memory=model.config.memory,
        achieved_in_observation=views.achieved_in_observation,
        relative_subgoals=views.relative_subgoals,
        remaining_time=views.remaining_time,
        fixed_budget=None if unit_time is None else float(rules.budget(np.array(unit_time))),
        action_low=actions.low.astype(np.float64),
        action_high=actions.high.astype(np.float64),
        n_observation=n_observation,
        n_achieved=n_achieved,
        n_desired=n_desired,
    )


def action_box(model: TBCHRL) -> spaces.Box:
    """The agent's action space, which is always a Box."""
    space = model.action_space
    if not isinstance(space, spaces.Box):
        raise TypeError(f"expected an agent with a Box action space, got {space}")
    return space


def _actions(actor: LevelActor) -> int:
    return int(np.prod(actor.action_space.shape))


class _MLPActor(Protocol):
    """What an MLP actor has, ours or SB3's."""

    @property
    def activation_fn(self) -> type[nn.Module]:
        """Kind of the hidden layers' activation."""

    @property
    def latent_pi(self) -> nn.Module:
        """Hidden layers."""

    @property
    def mu(self) -> nn.Module:
        """Layer of the means."""


def _bound(actor: object) -> float:
    head = getattr(actor, "head", None)  # SB3's SAC limits its means only by tanh
    return np.inf if head is None or head.mean_bound is None else float(head.mean_bound)


def _foreign_actor(algorithm: BaseAlgorithm) -> _MLPActor:
    """The actor of another algorithm that serves as high level, if it is an MLP whose means are squashed by tanh.

    :raises ConfigError: if it is of another kind
    """
    from sb3_contrib.tqc.policies import Actor as TQCActor
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from stable_baselines3.sac.policies import Actor as SACActor

    actor = getattr(algorithm.policy, "actor", None)
    if not isinstance(actor, SACActor | TQCActor) or actor.use_sde:
        raise ConfigError(
            f"the policy of {type(algorithm).__name__} cannot be exported as a high level; SAC's and TQC's can"
        )
    if type(actor.features_extractor) is not FlattenExtractor:
        raise ConfigError(
            f"a high level behind {type(actor.features_extractor).__name__} cannot be exported; train it without "
            "features_extractor_class"
        )
    return cast(_MLPActor, actor)


def _read_mlp(actor: _MLPActor) -> MLP:
    if actor.activation_fn not in ACTIVATIONS:
        allowed = ", ".join(ACTIVATIONS.values())
        raise ConfigError(f"only networks with {allowed} can be exported, this one has {actor.activation_fn.__name__}")
    layers = [m for m in (*actor.latent_pi.modules(), actor.mu) if isinstance(m, nn.Linear)]
    weights = tuple(_numpy(layer.weight).T.copy() for layer in layers)
    return MLP(weights, tuple(_numpy(layer.bias) for layer in layers), ACTIVATIONS[actor.activation_fn])


@th.no_grad()
def read_circuit(net: NDBCNet, n_actions: int) -> Circuit | Dissipative:
    """The numbers of a network whose first ``n_actions`` outputs are the means.

    :raises ConfigError: for networks with half-step checks
    """
    if net.step_rule is not None and net.step_rule.half_step_check:
        raise ConfigError(
            "a circuit with half_step_check cannot be exported: its number of sub-steps varies from step to step"
        )
    cell, wiring = net.cell, net.wiring
    readout = np.zeros((wiring.n_neurons, n_actions), np.float32)
    readout[net.read_from :] = _numpy(net.readout_weight)[:n_actions].T
    if isinstance(cell, DissipativeCell):
        arrays = cell.arrays()
        eta = cell.step_terms(arrays, 1.0 / net.sub_steps)
        return Dissipative(
            sub_steps=net.sub_steps,
            eta=float(eta[0]),
            input_weight=_numpy(net.input_gain.unsqueeze(-1) * arrays.input_weight),
            bias=_numpy(cell.bias),
            recurrent=_numpy(cell.enforced(arrays, eta)),
            shrink=_numpy(1.0 / (1.0 + eta * arrays.damping)),
            readout=readout,
            readout_bias=_numpy(net.readout_bias)[:n_actions],
        )
    a = cell.arrays()
    return Circuit(
        sub_steps=net.sub_steps,
        order=wiring.relaxation_order(),
        input_gain=_numpy(net.input_gain),
        sensory_gain=_numpy(a.sensory_gain),
        sensory_threshold=_numpy(cell.sensory_threshold),
        current_weight=_numpy(a.current_weight),
        current_bias=_numpy(cell.current_bias),
        from_inputs=_numpy(a.from_inputs),
        recurrent=_numpy(a.recurrent),
        rest=_numpy(a.rest),
        capacitance=_numpy(a.capacitance),
        gain=_numpy(a.gain),
        threshold=_numpy(cell.threshold),
        readout=readout,
        readout_bias=_numpy(net.readout_bias)[:n_actions],
    )


def _numpy(tensor: th.Tensor) -> NDArray[np.float32]:
    array = np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32).copy()
    if not np.isfinite(array).all():
        raise ConfigError("an agent with weights that are NaN or infinite cannot be exported; take an earlier one")
    return array


class _Probe:
    """Finds out how a task computes its local state and subgoal-space point, by calling its functions with many inputs.

    Tasks give these as Python functions. In practice every coordinate is an entry of the observation, possibly clipped
    or wrapped, or the angle of two entries. The result is checked on further observations; other functions are refused.
    """

    def __init__(self, n_observation: int, n_achieved: int) -> None:
        self.split, self.n = n_observation, n_observation + n_achieved
        self.rng = np.random.default_rng(0)

    def _ask(self, function: Reads, entries: FloatArray, desired: float = 0.0) -> FloatArray:
        observation, achieved = entries[..., : self.split], entries[..., self.split :]
        goal = np.full_like(achieved, desired)
        answer = function({"observation": observation, "achieved_goal": achieved, "desired_goal": goal})
        return np.asarray(answer, dtype=np.float64)

    def selection(self, function: Reads) -> tuple[int, ...]:
        """The index of the entry that each coordinate equals.

        :raises ConfigError: if a coordinate is not simply an entry
        """
        found = self.coordinates(function)
        for i, c in enumerate(found):
            if c.kind != "clip" or np.isfinite(c.low) or np.isfinite(c.high):
                raise ConfigError(f"entry {i} of the local state is not an entry of the observation: cannot export")
        return tuple(c.first for c in found)

    def coordinates(self, function: Reads) -> tuple[Coordinate, ...]:
        """A formula for each coordinate.

        :raises ConfigError: if a coordinate has none of the known forms
        """
        base = self.rng.normal(size=(8, self.n))
        values = self._ask(function, base)
        if not np.array_equal(values, self._ask(function, base, desired=np.pi), equal_nan=True):
            raise ConfigError(
                "the task's SubgoalSpace computes the local state or the subgoal from desired_goal, which the low "
                "level of an exported policy does not see: cannot export"
            )
        depends = np.zeros((values.shape[1], self.n), dtype=bool)
        for entry in range(self.n):
            moved = base.copy()
            moved[:, entry] = self.rng.normal(size=len(base))
            depends[:, entry] = (self._ask(function, moved) != values).any(axis=0)
        tests = self.rng.normal(size=(400, self.n)) * np.logspace(-2, 3, 400)[:, None]
        answers = self._ask(function, tests)
        far = self._ask(function, np.array([[-1e9], [1e9]]) * np.ones(self.n))
        return tuple(
            self._formula(i, np.flatnonzero(depends[i]).tolist(), far[:, i], tests, answers[:, i])
            for i in range(values.shape[1])
        )

    def _formula(
        self, index: int, entries: list[int], far: FloatArray, tests: FloatArray, answers: FloatArray
    ) -> Coordinate:
        candidates = []
        if len(entries) == 1:
            low, high = (-np.inf if far[0] == -1e9 else far[0]), (np.inf if far[1] == 1e9 else far[1])
            candidates = [Coordinate("clip", entries[0], 0, float(low), float(high))]
            candidates += [Coordinate("wrap", entries[0], 0, -np.inf, 2 * np.pi)]
        elif len(entries) == 2:
            candidates = [Coordinate("angle", *pair) for pair in (entries, entries[::-1])]
        for candidate in candidates:
            if np.allclose(candidate(tests), answers, rtol=1e-9, atol=1e-12):
                return candidate
        raise ConfigError(
            f"subgoal coordinate {index} depends on entries {entries} of the observation in a way that cannot be "
            "exported (possible: an entry, clipped, wrapped to a full turn, or the angle of two entries)"
        )
