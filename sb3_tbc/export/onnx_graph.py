"""The policy as an ONNX graph with explicit state, any batch size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike, DTypeLike
from onnx import TensorProto, helper, numpy_helper

from sb3_tbc.arrays import FloatArray
from sb3_tbc.export.policy import MLP, Circuit, Coordinate, Dissipative, ExportedPolicy
from sb3_tbc.outside import one_line

OPSET = 17


class _Graph:
    """Nodes and constants under construction; every method returns the name of a tensor."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, onnx.TensorProto] = {}

    def constant(self, value: ArrayLike, dtype: DTypeLike = np.float32) -> str:
        array = np.asarray(value, dtype=dtype)
        name = f"c{len(self.constants)}"
        self.constants[name] = numpy_helper.from_array(array, name)
        return name

    def __call__(self, op: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        output = name or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, list(inputs), [output], **attributes))
        return output

    def affine(self, x: str, scale: ArrayLike, shift: ArrayLike, dtype: DTypeLike = np.float32) -> str:
        """``x * scale + shift``."""
        return self("Add", self("Mul", x, self.constant(scale, dtype)), self.constant(shift, dtype))

    def columns(self, x: str, indices: Sequence[int]) -> str:
        return self("Gather", x, self.constant(indices, np.int64), axis=1)

    def slice(self, x: str, start: int, stop: int) -> str:
        return self(
            "Slice", x, self.constant([start], np.int64), self.constant([stop], np.int64), self.constant([1], np.int64)
        )

    def join(self, *parts: str) -> str:
        return self("Concat", *parts, axis=1)

    def cast(self, x: str, kind: int, name: str | None = None) -> str:
        return self("Cast", x, name=name, to=kind)

    def single(self, x: str) -> str:
        """Double precision, rounded to single."""
        return self.cast(self.cast(x, TensorProto.FLOAT), TensorProto.DOUBLE)


def to_onnx(policy: ExportedPolicy) -> onnx.ModelProto:
    """A graph from (observation, achieved_goal, desired_goal, state) to (action, next state).

    State tensors are ``subgoal`` (task units), ``time_budget`` and ``elapsed`` (control steps; ``elapsed`` is -1 before
    the first option), all three float64, and ``membrane``, float32; the next ones are called ``next_<name>``. Start an
    episode with elapsed -1 and zeros elsewhere. Where an input is NaN, so is the action: go on from the former state.
    All arithmetic is in double precision, rounded at the same places as in the agent.

    :param policy: what to export
    """
    g = _Graph()
    entries = g.cast(g.join("observation", "achieved_goal"), TensorProto.DOUBLE)
    here = g.join(*(_coordinate(g, entries, c) for c in policy.achieved)) if policy.achieved else None
    zero = g.constant(0.0, np.float64)
    started = g("Less", "elapsed", zero)
    over = g("Or", started, g("GreaterOrEqual", "elapsed", "time_budget"))
    if policy.event is not None:
        happened = g("Greater", g.columns("observation", [policy.event]), g.constant(0.5))
        over = g("Or", over, g("And", happened, g("Greater", "elapsed", zero)))
    if policy.window_end == "reached" and here is not None:
        late = g("GreaterOrEqual", "elapsed", g.constant(policy.dt_min, np.float64))
        over = g("Or", over, g("And", late, _reached(g, policy, here)))
    new_subgoal, new_budget = _high(g, policy)
    subgoal = g("Where", over, new_subgoal, "subgoal", name="next_subgoal")
    budget = g("Where", over, new_budget, "time_budget", name="next_time_budget")
    elapsed = g("Where", over, zero, "elapsed")
    asked = g("Sub", subgoal, here) if policy.relative_subgoals and here else subgoal
    left = g("Div", g("Sub", budget, elapsed), g.constant(policy.dt_max, np.float64))
    remaining = g("Clip", left, zero, g.constant(1.0, np.float64))
    exact = g.join(g.columns(entries, policy.local), asked, *([remaining] if policy.remaining_time else []))
    seen = g.single(exact)
    mean = _low(g, policy, seen, over, started)
    unit = g.cast(_squash(g, mean, policy.mean_bounds[1]), TensorProto.FLOAT)
    share = g("Mul", g("Add", unit, g.constant(1.0)), g.constant(0.5))
    scaled = g("Mul", share, g.constant(policy.action_high.astype(np.float32) - policy.action_low.astype(np.float32)))
    action = g("Add", g.constant(policy.action_low), scaled)
    g("Min", action, g.constant(policy.action_high), name="action")  # rounded, the sum may lie above the bound
    g("Add", elapsed, g.constant(1.0, np.float64), name="next_elapsed")
    return _model(g, policy)


def _high(g: _Graph, policy: ExportedPolicy) -> tuple[str, str]:
    """The high level's choice: subgoal and time budget."""
    parts = ["desired_goal", "observation"] + ([] if policy.achieved_in_observation else ["achieved_goal"])
    seen = g.cast(g.join(*parts), TensorProto.DOUBLE)
    unit = _squash(g, _mlp(g, policy.high, seen), policy.mean_bounds[0])
    # Term by term as the agent does it: rounded otherwise, a whole time budget could lie just above, a step longer.
    share = g("Mul", g("Add", unit, g.constant(1.0, np.float64)), g.constant(0.5, np.float64))
    d = policy.subgoal_dim
    width = policy.subgoal_high - policy.subgoal_low
    subgoal = g.affine(g.slice(share, 0, d), width, policy.subgoal_low, np.float64)
    if policy.fixed_budget is not None:
        return subgoal, g.constant([[policy.fixed_budget]], np.float64)
    budget = g.affine(g.slice(share, d, d + 1), policy.dt_max - policy.dt_min, policy.dt_min, np.float64)
    if policy.whole_budgets:
        budget = g("Max", g("Round", budget), g.constant([[1.0]], np.float64))
    return subgoal, budget


def _low(g: _Graph, policy: ExportedPolicy, seen: str, over: str, started: str) -> str:
    """The low level's mean; the circuit's next potentials become an output of the graph."""
    if isinstance(policy.low, MLP):
        return _mlp(g, policy.low, seen)
    zeros = g.constant(np.zeros((1, policy.state_dim)))  # the potentials are kept in single precision
    if policy.memory == "none":
        membrane = g("Mul", "membrane", zeros)
    else:
        membrane = g("Where", over if policy.memory == "window" else started, zeros, "membrane")
    membrane = g.cast(membrane, TensorProto.DOUBLE)
    if isinstance(policy.low, Dissipative):
        potentials = _dissipative(g, policy.low, seen, membrane)
    else:
        potentials = _circuit(g, policy.low, seen, membrane)
    g.cast(potentials, TensorProto.FLOAT, name="next_membrane")
    readout, bias = (g.constant(x, np.float64) for x in (policy.low.readout, policy.low.readout_bias))
    return g.single(g("Add", g("MatMul", potentials, readout), bias))


def _circuit(g: _Graph, c: Circuit, seen: str, potentials: str) -> str:
    """K semi-implicit sub-steps, in double precision as the agent itself acts."""
    n, p, wide = c.n_neurons, len(c.gain), np.float64

    def product(x: str, weight: FloatArray, shift: FloatArray) -> str:
        return g("Add", g("MatMul", x, g.constant(weight, wide)), g.constant(shift, wide))

    scaled = g("Mul", seen, g.constant(c.input_gain, wide))
    heard = [] if c.lean else [_logistic(g, g.affine(scaled, c.sensory_gain, -c.sensory_threshold, wide))]
    heard.append(g("Tanh", product(scaled, c.current_weight, c.current_bias)))
    kept = c.capacitance.astype(wide) * c.sub_steps
    source = g.join(*heard) if len(heard) > 1 else heard[0]
    constant = product(source, c.from_inputs, c.rest + np.concatenate([np.zeros(n), kept]))
    gain, threshold, recurrent, inertia = (g.constant(x, wide) for x in (c.gain, -c.threshold, c.recurrent, kept))
    for _ in range(c.sub_steps):
        released = _logistic(g, g("Add", g("Mul", g.slice(potentials, 0, p), gain), threshold))
        received = g("Add", constant, g("MatMul", released, recurrent))
        weighted = g("Add", g("Mul", potentials, inertia), g.slice(received, 0, n))
        potentials = g("Div", weighted, g.slice(received, n, 2 * n))
    return potentials


def _dissipative(g: _Graph, c: Dissipative, seen: str, state: str) -> str:
    wide = np.float64
    constant = g("Add", g("MatMul", seen, g.constant(c.input_weight, wide)), g.constant(c.bias, wide))
    recurrent, eta, shrink = (g.constant(x, wide) for x in (c.recurrent, c.eta, c.shrink))
    for _ in range(c.sub_steps):
        force = g("Tanh", g("Add", constant, g("MatMul", state, recurrent)))
        state = g("Mul", g("Add", state, g("Mul", force, eta)), shrink)
    return state


def _logistic(g: _Graph, x: str) -> str:
    """``1 / (1 + exp(-x))`` in double precision."""
    one = g.constant(1.0, np.float64)
    return g("Div", one, g("Add", one, g("Exp", g("Neg", x))))


def _mlp(g: _Graph, mlp: MLP, x: str) -> str:
    for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
        x = g("Add", g("MatMul", x, g.constant(weight, np.float64)), g.constant(bias, np.float64))
        if i < len(mlp.weights) - 1:
            x = g({"relu": "Relu", "tanh": "Tanh"}[mlp.activation], x)
    return g.single(x)


def _squash(g: _Graph, mean: str, bound: float) -> str:
    wide = np.float64
    bounded = g("Clip", mean, g.constant(-bound, wide), g.constant(bound, wide)) if np.isfinite(bound) else mean
    return g.single(g("Tanh", bounded))


def _coordinate(g: _Graph, entries: str, c: Coordinate) -> str:
    value = g.columns(entries, [c.first])
    if c.kind == "wrap":
        return g("Mod", value, g.constant(c.high, np.float64), fmod=1)
    if c.kind == "angle":  # onnxruntime has no arctangent in double precision
        y, x = (g.cast(part, TensorProto.FLOAT) for part in (value, g.columns(entries, [c.second])))
        return g.cast(_angle(g, y, x), TensorProto.DOUBLE)
    value = g("Max", value, g.constant(c.low, np.float64)) if np.isfinite(c.low) else value
    return g("Min", value, g.constant(c.high, np.float64)) if np.isfinite(c.high) else value


def _angle(g: _Graph, y: str, x: str) -> str:
    """atan2 from atan, dividing by the larger of the two."""
    zero, one, tiny = g.constant(0.0), g.constant(1.0), g.constant(1e-30)
    steep = g("Greater", g("Abs", y), g("Abs", x))
    below = g("Where", steep, y, x)
    below = g("Where", g("Equal", below, zero), tiny, below)
    ratio = g("Atan", g("Div", g("Where", steep, x, y), below))
    negative = g("Or", g("Less", y, zero), g("Less", g("Div", one, y), zero))  # -0.0, too, whose inverse is -inf
    side = g("Where", negative, g.constant(-1.0), one)
    flat = g("Add", ratio, g("Where", g("Less", x, zero), g("Mul", side, g.constant(np.pi)), zero))
    return g("Where", steep, g("Sub", g("Mul", side, g.constant(np.pi / 2)), ratio), flat)


def _reached(g: _Graph, policy: ExportedPolicy, here: str) -> str:
    member = np.zeros((policy.subgoal_dim, len(policy.groups)))
    for column, group in enumerate(policy.groups):
        member[list(group), column] = 1.0
    difference = g("Sub", here, "subgoal")
    distances = g("Sqrt", g("MatMul", g("Mul", difference, difference), g.constant(member, np.float64)))
    within = g.cast(g("Less", distances, g.constant(policy.thresholds, np.float64)), TensorProto.FLOAT)
    return g("Greater", g("ReduceMin", within, axes=[1], keepdims=1), g.constant(0.5))


def _model(g: _Graph, policy: ExportedPolicy) -> onnx.ModelProto:
    def tensor(name: str, width: int, kind: int = TensorProto.FLOAT) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, kind, ["n", width])

    widths = {"observation": policy.n_observation, "achieved_goal": policy.n_achieved, "desired_goal": policy.n_desired}
    inputs = [tensor(name, width) for name, width in widths.items()]
    outputs = [tensor("action", len(policy.action_low))]
    state = {"subgoal": policy.subgoal_dim, "time_budget": 1, "elapsed": 1, "membrane": policy.state_dim}
    for name, width in state.items():
        if width:
            kind = TensorProto.FLOAT if name == "membrane" else TensorProto.DOUBLE
            inputs.append(tensor(name, width, kind))
            outputs.append(tensor(f"next_{name}", width, kind))
    graph = helper.make_graph(g.nodes, one_line(policy.task), inputs, outputs, list(g.constants.values()))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="sb3_tbc")
    model.ir_version = 8
    onnx.checker.check_model(model)
    return model
