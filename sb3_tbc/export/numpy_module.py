"""The policy as one Python file that needs only NumPy."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from importlib.resources import files

import numpy as np

from sb3_tbc.aliases import Plain
from sb3_tbc.export.policy import Circuit, ExportedPolicy
from sb3_tbc.outside import in_docstring


def to_numpy_module(policy: ExportedPolicy) -> str:
    """Source text of a module with the weights inside; see the text itself for how it is used.

    :param policy: what to export
    """
    if isinstance(policy.low, Circuit) and policy.low.lean:
        policy = replace(policy, low=_with_silent_sensory(policy.low))
    arrays: Plain = {}
    settings: Plain = {}
    for name, value in policy.plain().items():
        if name in ("high", "low"):
            for part, content in value.items():
                _sort(f"{name}.{part}", content, arrays, settings)
        else:
            _sort(name, value, arrays, settings)
    settings["low.kind"] = type(policy.low).__name__
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    packed = base64.b64encode(buffer.getvalue()).decode()
    lines = "\n".join(f'    "{packed[i : i + 110]}"' for i in range(0, len(packed), 110))
    template = (files("sb3_tbc.export") / "numpy_runtime.py").read_text(encoding="utf-8")
    runtime = template[template.index("# --- runtime ---") :]
    names = "\n".join(f"    {name!r}: {value!r}," for name, value in settings.items())
    return (
        f'"""Two-level policy for {in_docstring(policy.task)}, exported from sb3_tbc. Needs NumPy alone.\n\n'
        "    state = initial_state()\n"
        "    action, state = step(observation, achieved_goal, desired_goal, state)\n"
        '"""\n\nfrom __future__ import annotations\n\nimport base64\nimport io\nfrom typing import Any\n\n'
        "import numpy as np\nfrom numpy.typing import NDArray\n\n"
        f"SETTINGS = {{\n{names}\n}}\nWEIGHTS = (\n{lines}\n)\n\n{runtime}"
    )


def _with_silent_sensory(c: Circuit) -> Circuit:
    """A lean circuit in the paper's form, with sensory synapses of zero conductance, so that one runtime suffices."""
    silent = np.zeros(len(c.input_gain), np.float32)
    rows = np.zeros((len(silent), c.from_inputs.shape[1]), np.float32)
    return replace(c, sensory_gain=silent, sensory_threshold=silent, from_inputs=np.concatenate([rows, c.from_inputs]))


def _sort(name: str, value: object, arrays: Plain, settings: Plain) -> None:
    """Put arrays into the archive, everything else into the settings."""
    if isinstance(value, np.ndarray):
        arrays[name] = value
    elif isinstance(value, tuple) and value and isinstance(value[0], np.ndarray):
        arrays.update({f"{name}.{i}": array for i, array in enumerate(value)})
        settings[f"{name}.count"] = len(value)
    elif name == "achieved" and isinstance(value, tuple):
        settings[name] = [_finite(tuple(c)) for c in value]
    else:
        settings[name] = _finite(value) if isinstance(value, tuple) else value


def _finite(values: tuple[object, ...]) -> tuple[object, ...]:
    """Replace infinities by values whose text Python can read."""
    return tuple(_Inf(v) if isinstance(v, float) and np.isinf(v) else v for v in values)


class _Inf(float):
    def __repr__(self) -> str:
        return f"float('{float(self)}')"
