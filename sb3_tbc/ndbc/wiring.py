"""Who is wired to whom: four layers of neurons and their signed synapses. NumPy only."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeGuard

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.outside import one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SignMatrix = NDArray[np.int8]
"""Synapses as a matrix ``[presynaptic, postsynaptic]``: +1 excitatory, -1 inhibitory, 0 none."""

MOST_NEURONS = 10_000
"""Neurons of a layer; wirings are dense matrices."""
logger = logging.getLogger(__name__)

LAYERS = ("inter", "command", "motor")


class NDBCWiring:
    """Sparse wiring sensory -> inter -> command -> motor, drawn once from a seed (paper, section 4.3 and table A1).

    Inputs are the sensory neurons; they have no state. The neurons with a membrane potential are numbered inter,
    command, motor. Targets are drawn evenly, so fan-ins within a layer differ as little as possible, and a neuron that
    no draw has reached gets one synapse more: every neuron has at least one incoming synapse.

    :param n_inputs: number of sensory neurons
    :param inter: number of inter neurons
    :param command: number of command neurons
    :param motor: number of motor neurons
    :param sensory_fanout: inter neurons each sensory neuron projects to
    :param inter_fanout: command neurons each inter neuron projects to
    :param recurrent_command_synapses: synapses among the command neurons, in all (no autapses)
    :param motor_fanin: command neurons each motor neuron listens to
    :param seed: seed of the draw, of targets as well as of polarities
    :param sensory_to: layers that sensory neurons project to, each with ``sensory_fanout``: the paper's ``("inter",)``,
        or with reflexes that bypass inter neurons, ``("inter", "command")`` or ``("inter", "command", "motor")``
    :raises ValueError: if a size is not a positive integer, a fan is negative or ``sensory_to`` is something else
    """

    drawer: ClassVar[Callable[..., Axes] | None] = None
    """The function that :meth:`draw` calls; set in the package's ``__init__``, as its module imports this one."""

    def __init__(
        self,
        n_inputs: int,
        inter: int,
        command: int,
        motor: int,
        sensory_fanout: int,
        inter_fanout: int,
        recurrent_command_synapses: int,
        motor_fanin: int,
        seed: int = 0,
        sensory_to: Sequence[str] = ("inter",),
    ) -> None:
        self._set_sizes(n_inputs, inter, command, motor, sensory_to=sensory_to)
        self.seed = seed
        self.notes: tuple[str, ...] = ()
        check_seed(seed)
        rng = np.random.default_rng(seed)
        sensory_fanout = self._clip("sensory_fanout", sensory_fanout, inter, "inter neurons")
        inter_fanout = self._clip("inter_fanout", inter_fanout, command, "command neurons")
        motor_fanin = self._clip("motor_fanin", motor_fanin, command, "command neurons")
        pairs = [(i, j) for i in range(command) for j in range(command) if i != j]
        recurrent = self._clip(
            "recurrent_command_synapses", recurrent_command_synapses, len(pairs), "ordered pairs of command neurons", 0
        )
        self.sensory = np.zeros((n_inputs, self.n_neurons), dtype=np.int8)
        self.recurrent = np.zeros((self.n_neurons, self.n_neurons), dtype=np.int8)
        inter_at, command_at, motor_at = (self.layer(name) for name in LAYERS)
        self.sensory[:, inter_at] = _signed(rng, _fan_out(rng, n_inputs, inter, sensory_fanout))
        self.recurrent[inter_at, command_at] = _signed(rng, _fan_out(rng, inter, command, inter_fanout))
        among = np.zeros((command, command), dtype=bool)
        for k in rng.permutation(len(pairs))[:recurrent]:
            among[pairs[k]] = True
        self.recurrent[command_at, command_at] = _signed(rng, among)
        self.recurrent[command_at, motor_at] = _signed(rng, _fan_out(rng, motor, command, motor_fanin, rescue=False).T)
        for name in self.sensory_to[1:]:  # last, so that all other draws are those of the wiring without reflexes
            size = getattr(self, name)
            fan = min(sensory_fanout, size)
            self.sensory[:, self.layer(name)] = _signed(rng, _fan_out(rng, n_inputs, size, fan))

    def _set_sizes(
        self, n_inputs: int, inter: int, command: int, motor: int, *, sensory_to: Sequence[str] = ("inter",)
    ) -> None:
        for name, size in {"n_inputs": n_inputs, "inter": inter, "command": command, "motor": motor}.items():
            if not _is_whole(size) or not 1 <= size <= MOST_NEURONS:
                raise ValueError(f"{name} must be a whole number from 1 to {MOST_NEURONS}, got {size!r}")
        self.n_inputs, self.inter, self.command, self.motor = int(n_inputs), int(inter), int(command), int(motor)
        self.sensory_to = (sensory_to,) if isinstance(sensory_to, str) else tuple(sensory_to)
        allowed = [LAYERS[: i + 1] for i in range(len(LAYERS))]
        if self.sensory_to not in allowed:
            listed = ", ".join(str(list(layers)) for layers in allowed)
            raise ValueError(f"sensory_to must be one of {listed}, got {sensory_to!r}")

    def _clip(self, name: str, fan: int, limit: int, of_what: str, least: int = 1) -> int:
        if not _is_whole(fan) or fan < least:
            raise ValueError(f"{name} must be a whole number of at least {least}, got {fan!r}")
        if fan > limit:
            note = f"{name}={fan} exceeds the {limit} {of_what}: clipped to {limit}"
            logger.info(note)
            self.notes = (*self.notes, note)
        return int(min(fan, limit))

    @property
    def n_neurons(self) -> int:
        """Neurons with a membrane potential: inter + command + motor."""
        return self.inter + self.command + self.motor

    @property
    def n_driven(self) -> int:
        """Neurons that inputs act on directly: the first ones of the state vector, as many as ``sensory_to`` holds."""
        return int(self.layer(self.sensory_to[-1]).stop)

    @property
    def n_synapses(self) -> int:
        """Synapses from sensory neurons and among the others."""
        return int(np.count_nonzero(self.sensory) + np.count_nonzero(self.recurrent))

    def layer(self, name: str) -> slice:
        """Where a layer's neurons lie in the state vector.

        :param name: ``"inter"``, ``"command"`` or ``"motor"``
        :raises ValueError: for any other name
        """
        if name not in LAYERS:
            raise ValueError(f"layer must be one of {LAYERS}, got {name!r}; sensory neurons have no state")
        sizes = (self.inter, self.command, self.motor)
        start = sum(sizes[: LAYERS.index(name)])
        return slice(start, start + sizes[LAYERS.index(name)])

    def layer_of(self, neuron: int) -> str:
        """Name of the layer a neuron of the state vector belongs to."""
        return next(name for name in LAYERS if self.layer(name).start <= neuron < self.layer(name).stop)

    def neuron_names(self) -> tuple[str, ...]:
        """A name per neuron, ``("inter0", ..., "motor0", ...)``, in the order of the state vector."""
        return tuple(f"{name}{i}" for name in LAYERS for i in range(getattr(self, name)))

    def relaxation_order(self) -> tuple[tuple[int, ...], ...]:
        """Groups of neurons, each of which hears only neurons of earlier groups, as far as there is no loop.

        The closed form (paper, section 4.3) takes the neurons in this order, so that a signal passes from sensory to
        motor neurons within one control step. A loop is opened at the neuron that hears the fewest neurons not yet
        placed.
        """
        # Transitive closure (Warshall): two neurons that reach each other are in one loop. A neuron is free once all
        # neurons upstream of its loop are placed. Each round places the free neurons that hear no waiting neuron; if
        # there are none (a loop), the free neuron that hears the fewest of them, as they were before the step.
        heard = self.recurrent != 0
        np.fill_diagonal(heard, False)
        before = heard.copy()  # whether a path leads from one neuron to the other
        for via in range(self.n_neurons):
            before |= np.outer(before[:, via], before[via])
        downstream = before & ~before.T  # of another neuron that is not in the same loop
        waiting = np.ones(self.n_neurons, dtype=bool)
        groups = []
        while waiting.any():
            free = np.flatnonzero(waiting & ~downstream[waiting].any(axis=0))
            missing = heard[waiting][:, free].sum(axis=0)
            ready = free[missing == 0] if not missing.all() else free[[missing.argmin()]]
            waiting[ready] = False
            groups.append(tuple(ready.tolist()))
        return tuple(groups)

    def to_dict(self) -> Plain:
        """Plain data: sizes, seed, notes, and every synapse as ``[presynaptic, postsynaptic, polarity]``."""
        return {
            **{name: getattr(self, name) for name in ("n_inputs", *LAYERS)},
            "seed": self.seed,
            "sensory_to": list(self.sensory_to),
            "notes": list(self.notes),
            "sensory_synapses": _to_list(self.sensory),
            "synapses": _to_list(self.recurrent),
        }

    @classmethod
    def from_dict(cls, data: PlainMapping) -> NDBCWiring:
        """The wiring that :meth:`to_dict` described; or, given the constructor's numbers, a freshly drawn one.

        :raises ValueError: if a synapse names a neuron that does not exist or has a polarity other than +1 and -1, or
            the data describe no wiring
        """
        try:
            return cls._described(data)
        except (TypeError, KeyError, IndexError, OverflowError, AttributeError) as error:
            raise ValueError(f"this describes no wiring: {type(error).__name__}: {one_line(error)}") from error

    @classmethod
    def _described(cls, data: PlainMapping) -> NDBCWiring:
        if "synapses" not in data:
            return cls(**data)
        wiring = cls.__new__(cls)
        sizes = (data[name] for name in ("n_inputs", *LAYERS))
        wiring._set_sizes(*sizes, sensory_to=data.get("sensory_to", ("inter",)))
        wiring.seed = int(data.get("seed", 0))
        wiring.notes = tuple(data.get("notes", ()))
        wiring.sensory = _from_list(data["sensory_synapses"], (wiring.n_inputs, wiring.n_neurons))
        wiring.recurrent = _from_list(data["synapses"], (wiring.n_neurons, wiring.n_neurons))
        if wiring.sensory[:, wiring.n_driven :].any():
            raise ValueError(f"a sensory synapse ends outside of sensory_to={list(wiring.sensory_to)}; name its layer")
        return wiring

    def with_signs(self, sensory: SignMatrix, recurrent: SignMatrix) -> NDBCWiring:
        """The same synapses with other polarities.

        :param sensory: ``(n_inputs, n_neurons)``
        :param recurrent: ``(n_neurons, n_neurons)``
        """
        lists = {"sensory_synapses": _to_list(sensory), "synapses": _to_list(recurrent)}
        return NDBCWiring.from_dict({**self.to_dict(), **lists})

    @classmethod
    def from_ncps(cls, wiring: Any) -> NDBCWiring:
        """The same neurons and synapses as a built ``ncps.wirings.NCP`` or ``AutoNCP``.

        ncps numbers motor neurons first; here they come last.

        :param wiring: an ncps wiring, after ``wiring.build(n_inputs)``
        :raises ValueError: if it was not built or has no inter, command and motor neurons
        """
        if getattr(wiring, "sensory_adjacency_matrix", None) is None:
            raise ValueError("the ncps wiring does not know its inputs yet: call wiring.build(n_inputs) first")
        types = [wiring.get_type_of_neuron(i) for i in range(wiring.units)]
        members = [[i for i, kind in enumerate(types) if kind == name] for name in LAYERS]
        if not all(members):
            raise ValueError(f"need inter, command and motor neurons, as in NCP and AutoNCP; got {sorted(set(types))}")
        order = [i for layer in members for i in layer]
        drawn = cls.__new__(cls)
        sensory = np.asarray(wiring.sensory_adjacency_matrix)
        drawn._set_sizes(len(sensory), *(len(m) for m in members))
        drawn.seed, drawn.notes = 0, ("from ncps",)
        drawn.sensory = np.sign(sensory[:, order]).astype(np.int8)
        drawn.recurrent = np.sign(np.asarray(wiring.adjacency_matrix)[np.ix_(order, order)]).astype(np.int8)
        return drawn

    def draw(self, ax: Axes | None = None, input_names: Sequence[str] | None = None, **more: object) -> Axes:
        """Draw neurons and synapses with matplotlib; see :func:`sb3_tbc.ndbc.drawing.draw_wiring`.

        :param ax: matplotlib axes to draw into; new ones by default
        :param input_names: a name per sensory neuron
        :param more: weights of a readout, names of its outputs, and how much each synapse is used
        :return: the axes
        """
        if self.drawer is None:
            raise RuntimeError("nothing draws wirings yet: import sb3_tbc.ndbc")
        return self.drawer(self, ax, input_names, **more)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NDBCWiring) and self.to_dict() == other.to_dict()

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        sizes = f"{self.n_inputs} sensory, {self.inter} inter, {self.command} command, {self.motor} motor"
        reflexes = f", sensory_to={list(self.sensory_to)}" if len(self.sensory_to) > 1 else ""
        return f"NDBCWiring({sizes} neurons, {self.n_synapses} synapses, seed={self.seed}{reflexes})"


WIRING_KEYS = tuple(inspect.signature(NDBCWiring).parameters)[1:]
"""What a wiring takes besides its number of inputs; other settings of a circuit are the network's."""


def check_seed(seed: object) -> None:
    """Refuse what NumPy or torch would refuse without naming it.

    :raises ValueError: unless it is a whole number of at least 0, or None
    """
    if seed is not None and (not _is_whole(seed) or seed < 0):
        raise ValueError(f"seed must be a whole number of at least 0, or None, got {seed!r}")


def _is_whole(value: object) -> TypeGuard[int]:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _fan_out(rng: np.random.Generator, sources: int, targets: int, fan: int, rescue: bool = True) -> NDArray[np.bool_]:
    """Each source picks ``fan`` targets, the least used first; ``rescue`` gives an unreached target one source."""
    chosen = np.zeros((sources, targets), dtype=bool)
    used = np.zeros(targets)
    for source in rng.permutation(sources):
        picked = np.lexsort((rng.random(targets), used))[:fan]
        chosen[source, picked] = True
        used[picked] += 1
    if rescue:
        for target in np.flatnonzero(used == 0):
            chosen[rng.integers(sources), target] = True
    return chosen


def _signed(rng: np.random.Generator, mask: NDArray[np.bool_]) -> SignMatrix:
    return np.where(mask, rng.choice(np.array([-1, 1], dtype=np.int8), size=mask.shape), 0).astype(np.int8)


def _to_list(signs: SignMatrix) -> list[list[int]]:
    return [[int(i), int(j), int(signs[i, j])] for i, j in np.argwhere(signs)]


def _from_list(synapses: list[list[int]], shape: tuple[int, int]) -> SignMatrix:
    signs = np.zeros(shape, dtype=np.int8)
    for i, j, polarity in synapses:
        if not (0 <= i < shape[0] and 0 <= j < shape[1]) or polarity not in (-1, 1):
            raise ValueError(
                f"synapse {[i, j, polarity]} does not fit {shape[0]} x {shape[1]} neurons with polarity +-1"
            )
        signs[i, j] = polarity
    return signs
