"""The policy as one C99 file: no allocation, no dependency beyond ``math.h``; integrated and closed form."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.arrays import FloatArray
from sb3_tbc.export.policy import MLP, Circuit, Coordinate, Dissipative, ExportedPolicy
from sb3_tbc.export.rounding import whole

Entries = tuple[NDArray[np.integer], NDArray[np.integer]]
"""Which entries of a weight matrix are stored, in which order: their rows (inputs) and columns (outputs)."""


class Storage(NamedTuple):
    """How weight matrices are stored."""

    write: Callable[[str, FloatArray, Entries], str]  # an array of a name; TBC_<NAME>_STEP(o), its unit for an output
    c_type: str
    size: int  # bytes of an entry, in single precision


def to_c(policy: ExportedPolicy) -> str:
    """Source text of the policy; the comment at its beginning explains its use.

    :param policy: what to export
    """
    data, code = _low_level(policy.low, STORAGE[policy.weights])
    values = {
        "TASK": re.sub(r"[^A-Za-z0-9_.-]", "_", policy.task),
        "SIZES": _sizes(policy),
        "LOW_DATA": data,
        "LOW_CODE": code,
        "HIGH_DATA": _mlp("high", policy.high, STORAGE["float32"]) + _option_data(policy),
        "ACHIEVED": "\n".join(_coordinate(i, c) for i, c in enumerate(policy.achieved)) or "    (void)entries;",
        "REACHED": _reached(policy),
        "EVENT": ""
        if policy.event is None
        else f"\n        || (next.elapsed > 0 && observation[{policy.event}] > 0.5f)",
        "HIGH_INPUTS": _high_inputs(policy),
        "FORGET": {"window": "over", "episode": "started", "none": "1"}[policy.memory],
        "ASKED": "(next.subgoal[i] - here[i])" if policy.relative_subgoals else "next.subgoal[i]",
        "UNITS": str(policy.subgoal_dim + (policy.fixed_budget is None)),
        "BUDGET": _budget(policy),
        "REMAINING": _REMAINING if policy.remaining_time else "",
        "LOCAL": str(len(policy.local)),
    }
    text = _template("policy.c")
    for name, value in values.items():
        text = text.replace(f"@{name}@", value)
    return text.replace("@GUARD@", f"TBC_POLICY_{zlib.crc32(text.encode()):08x}")


def _budget(policy: ExportedPolicy) -> str:
    if policy.fixed_budget is not None:
        return repr(policy.fixed_budget)
    if not policy.whole_budgets:
        return _CHOSEN
    return f"rint({_CHOSEN});\n    state->time_budget = state->time_budget < 1.0 ? 1.0 : state->time_budget"


def _template(name: str) -> str:
    return (files("sb3_tbc.export") / "templates" / name).read_text(encoding="utf-8")


def _low_level(low: MLP | Circuit | Dissipative, storage: Storage) -> tuple[str, str]:
    """Data and code."""
    if isinstance(low, Circuit):
        return _circuit(low, storage), _circuit_code(low)
    if isinstance(low, Dissipative):
        return _dissipative(low, storage), _template("dissipative.c")
    return _mlp("low", low, storage), _LOW_MLP


def _sizes(policy: ExportedPolicy) -> str:
    sizes = {
        "OBSERVATION": policy.n_observation,
        "ACHIEVED_GOAL": policy.n_achieved,
        "DESIRED_GOAL": policy.n_desired,
        "ACTION": len(policy.action_low),
        "SUBGOAL": policy.subgoal_dim,
        "LOW_INPUT": policy.n_low_inputs,
        "STATE": policy.state_dim,
    }
    return "\n".join(f"#define TBC_{name} {size}" for name, size in sizes.items())


def floats(values: FloatArray) -> str:
    """Single-precision literals that read back exactly."""
    literals = [f"{np.float32(v):.9g}" for v in np.asarray(values).ravel()]
    return ", ".join((x if any(c in x for c in ".en") else x + ".0") + "f" for x in literals)


def array(name: str, values: FloatArray, kind: str = "tbc_real") -> str:
    """A constant array of single-precision numbers, stored in the type of the computation, which is faster."""
    return f"static const {kind} {name}[{max(1, np.size(values))}] = {{{floats(values) or '0.0f'}}};\n"


def float_matrix(name: str, matrix: FloatArray, entries: Entries) -> str:
    """Weights as they are."""
    return array(name, matrix[entries]) + f"#define TBC_{name.upper()}_STEP(o) 1\n"


def whole_matrix(name: str, matrix: FloatArray, entries: Entries) -> str:
    """Weights as bytes; those that :mod:`~sb3_tbc.export.rounding` has rounded stay what they are."""
    numbers, unit, halvings = whole(matrix)
    listed = ", ".join(str(n) for n in numbers[entries]) or "0"
    text = f"static const signed char {name}[{max(1, len(entries[0]))}] = {{{listed}}};\n"
    text += _indices(f"{name}_halvings", halvings)
    step = f"({floats(np.array(unit))} / (tbc_real)(1ul << {name}_halvings[o]))"
    return f"{text}#define TBC_{name.upper()}_STEP(o) {step}\n"


STORAGE = {"float32": Storage(float_matrix, "tbc_real", 4), "int8": Storage(whole_matrix, "signed char", 1)}


def _indices(name: str, values: NDArray[np.integer]) -> str:
    kinds = {"unsigned char": 2**8, "unsigned short": 2**16, "int": 2**31}  # int is what indices are read into
    kind = next(kind for kind, end in kinds.items() if values.max(initial=0) < end)
    listed = ", ".join(str(int(v)) for v in values) or "0"
    return f"static const {kind} {name}[{max(1, len(values))}] = {{{listed}}};\n"


def _sparse(name: str, matrix: FloatArray, columns: dict[str, FloatArray], storage: Storage) -> str:
    """Compressed rows by postsynaptic neuron: where each begins, presynaptic indices, one array per set of values.

    Where nearly everything is wired to everything, zeros take less room than indices.
    """
    present = matrix.T != 0
    macro, inputs = f"#define TBC_{name.upper()}", present.shape[1]
    cell = storage.size * len(columns)
    dense = present.mean() * (cell + 1) > cell  # an index takes one byte, seldom two
    post, pre = np.nonzero(present | dense)
    if dense:
        text = f"{macro}_BEGIN(i) ((i) * {inputs})\n{macro}_PRE(i, k) ((k) - (i) * {inputs})\n"
    else:
        begin = np.concatenate([[0], np.cumsum(present.sum(axis=1))])
        text = _indices(f"{name}_begin", begin) + _indices(f"{name}_pre", pre)
        text += f"{macro}_BEGIN(i) {name}_begin[i]\n{macro}_PRE(i, k) {name}_pre[k]\n"
    return text + "".join(storage.write(f"{name}_{column}", values, (pre, post)) for column, values in columns.items())


def _full(name: str, matrix: FloatArray, storage: Storage) -> str:
    """All entries, output after output."""
    outputs, inputs = np.indices(matrix.T.shape)
    return storage.write(name, matrix, (inputs.ravel(), outputs.ravel()))


def _circuit_code(c: Circuit) -> str:
    """The functions of a circuit; lines from ``@PAPER@`` or ``@LEAN@`` to ``@END@`` are kept only for that kind."""
    kept, other = ("LEAN", "PAPER") if c.lean else ("PAPER", "LEAN")
    text = re.sub(rf"@{other}@\n.*?@END@\n", "", _template("circuit.c"), flags=re.DOTALL)
    return re.sub(rf"@(?:{kept}|END)@\n", "", text)


def _circuit(c: Circuit, storage: Storage) -> str:
    n, (inputs, driven), s = c.n_neurons, c.current_weight.shape, len(c.sensory_gain)
    sensory, currents = c.from_inputs[:s], c.from_inputs[s:]
    sizes = {} if c.lean else {"SENSORY": inputs}
    sizes |= {"INTER": driven, "PRESYNAPTIC": len(c.gain), "SUB_STEPS": c.sub_steps}
    text = "".join(f"#define TBC_{name} {size}\n" for name, size in sizes.items())
    order = np.concatenate(c.order)
    turn = np.argsort(order)
    early = [j for j, heard in enumerate(c.recurrent[:, n:] != 0) if (turn[:n][heard] <= turn[j]).any()]
    text += f"#ifndef TBC_INTEGRATED_ONLY\n#define TBC_LOOPS {len(early)}\n"
    text += _indices("heard_early", np.array(early, dtype=int)) + _indices("relaxation_order", order) + "#endif\n"
    text += array("input_gain", c.input_gain)
    if not c.lean:
        text += array("sensory_gain", c.sensory_gain) + array("sensory_threshold", c.sensory_threshold)
    text += array("gain", c.gain) + array("threshold", c.threshold)
    text += array("rest_weighted", c.rest[:n]) + array("rest_total", c.rest[n:])
    text += array("capacitance", c.capacitance) + array("current_bias", c.current_bias)
    text += array("input_conductance", currents[np.arange(driven), np.arange(driven)])
    text += _sparse("current", c.current_weight, {"weight": c.current_weight}, storage)
    columns = {"weighted": c.recurrent[:, :n]}
    if not c.lean:
        text += _sparse("sensory", sensory[:, n:], {"weighted": sensory[:, :n], "total": sensory[:, n:]}, storage)
        columns["total"] = c.recurrent[:, n:]
    text += _sparse("recurrent", c.recurrent[:, n:], columns, storage)
    return text + _full("readout", c.readout, storage) + array("readout_bias", c.readout_bias)


def _dissipative(c: Dissipative, storage: Storage) -> str:
    text = f"#define TBC_SUB_STEPS {c.sub_steps}\n#define TBC_ETA {floats(np.array(c.eta))}\n"
    text += _sparse("input", c.input_weight, {"weight": c.input_weight}, storage) + array("input_bias", c.bias)
    text += _sparse("recurrent", c.recurrent, {"weight": c.recurrent}, storage) + array("shrink", c.shrink)
    return text + _full("readout", c.readout, storage) + array("readout_bias", c.readout_bias)


_CHOSEN = """TBC_DT_MIN
        + 0.5 * ((double)(float)squash(unit[TBC_SUBGOAL], TBC_HIGH_BOUND) + 1.0) * (TBC_DT_MAX - TBC_DT_MIN)"""
_REMAINING = """
    seen[TBC_LOW_INPUT - 1] = (float)fmax(0.0, fmin((next.time_budget - next.elapsed) / TBC_DT_MAX, 1.0));"""
_LOW_MLP = """
void tbc_low_mean(float membrane[TBC_STATE + 1], const float seen[TBC_LOW_INPUT], int closed_form,
                  float mean[TBC_ACTION])
{
    (void)membrane;
    (void)closed_form;
    low_network(seen, mean);
}
"""


def _mlp(name: str, mlp: MLP, storage: Storage) -> str:
    """Weights and one function ``<name>_network(x, y)``."""
    data, declared, layers, source = "", "", "", "in"
    n_in, last = len(mlp.weights[0]), len(mlp.weights) - 1
    for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
        inputs, outputs = weight.shape
        data += _full(f"{name}_w{i}", weight, storage) + array(f"{name}_b{i}", bias)
        declared += f"    tbc_real h{i}[{outputs}];\n"
        row = f"{name}_row({inputs}, {name}_w{i} + i * {inputs}, {source})"
        layers += f"    for (i = 0; i < {outputs}; ++i) {{\n"
        layers += f"        const tbc_real sum = {name}_b{i}[i] + TBC_{name.upper()}_W{i}_STEP(i) * {row};\n"
        layers += f"        h{i}[i] = {_RULES['linear' if i == last else mlp.activation]};\n    }}\n"
        source = f"h{i}"
    read = f"    for (i = 0; i < {n_in}; ++i) {{\n        in[i] = x[i];\n    }}\n"
    written = f"    for (i = 0; i < {outputs}; ++i) {{\n        y[i] = (float){source}[i];\n    }}\n"
    body = f"    tbc_real in[{n_in}];\n{declared}    int i;\n{read}{layers}{written}"
    row = _ROW.replace("@NAME@", name).replace("@TYPE@", storage.c_type)
    return f"{data}{row}\nstatic void {name}_network(const float *x, float *y)\n{{\n{body}}}\n"


_RULES = {"linear": "sum", "relu": "sum < 0 ? 0 : sum", "tanh": "TBC_TANH(sum)"}
_ROW = """
static tbc_real @NAME@_row(int inputs, const @TYPE@ *w, const tbc_real *x)
{
    tbc_real sum = 0;
    int i;
    for (i = 0; i < inputs; ++i) {
        sum += w[i] * x[i];
    }
    return sum;
}
"""


def _doubles(name: str, values: FloatArray) -> str:
    return f"static const double {name}[{len(values)}] = {{{', '.join(repr(float(v)) for v in values)}}};\n"


def _option_data(policy: ExportedPolicy) -> str:
    text = _indices("local_entry", np.array(policy.local))
    text += _doubles("subgoal_low", policy.subgoal_low) + _doubles("subgoal_high", policy.subgoal_high)
    text += array("action_low", policy.action_low, "float") + array("action_high", policy.action_high, "float")
    bounds = [b if np.isfinite(b) else np.finfo(np.float32).max for b in policy.mean_bounds]
    text += (
        f"#define TBC_HIGH_BOUND {floats(np.array(bounds[0]))}\n#define TBC_LOW_BOUND {floats(np.array(bounds[1]))}\n"
    )
    return text + f"#define TBC_DT_MIN {policy.dt_min!r}\n#define TBC_DT_MAX {policy.dt_max!r}\n"


def _coordinate(index: int, c: Coordinate) -> str:
    if c.kind == "angle":
        return f"    here[{index}] = (tbc_real)atan2(entries[{c.first}], entries[{c.second}]);"
    if c.kind == "wrap":
        return f"    here[{index}] = (tbc_real)fmod(entries[{c.first}], {c.high!r});"
    value = f"entries[{c.first}]"
    clipped = value  # NaN stays NaN, which fmin and fmax would swallow
    if np.isfinite(c.low):
        clipped = f"({value} < {c.low!r} ? {c.low!r} : {clipped})"
    if np.isfinite(c.high):
        clipped = f"({value} > {c.high!r} ? {c.high!r} : {clipped})"
    return f"    here[{index}] = (tbc_real){clipped};"


def _reached(policy: ExportedPolicy) -> str:
    if policy.window_end != "reached":
        return "    (void)here;\n    (void)subgoal;\n    return 0;"
    tests = []
    for group, threshold in zip(policy.groups, policy.thresholds, strict=True):
        squares = " + ".join(f"(here[{i}] - subgoal[{i}]) * (here[{i}] - subgoal[{i}])" for i in group)
        tests.append(f"sqrt({squares}) < {float(threshold)!r}")
    return "    return " + "\n        && ".join(tests) + ";"


def _high_inputs(policy: ExportedPolicy) -> str:
    parts = [("desired_goal", policy.n_desired), ("observation", policy.n_observation)]
    if not policy.achieved_in_observation:
        parts.append(("achieved_goal", policy.n_achieved))
    lines = [f"    float seen[{sum(size for _, size in parts)}];"]
    start = 0
    for name, size in parts:
        lines.append(f"    memcpy(seen + {start}, {name}, {size} * sizeof(float));")
        start += size
    if policy.achieved_in_observation:
        lines.append("    (void)achieved_goal;")
    return "\n".join(lines)
