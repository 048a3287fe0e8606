"""Parts of the ONNX graph that onnxruntime lacks, beside NumPy's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exported import make

from sb3_tbc.export.policy import MLP, Coordinate, extract
from sb3_tbc.smdp.options import OptionRules

EDGES = (0.0, -0.0, 1.0, -1.0, 1e-35, -1e-35, 3e38, -3e38)


def test_an_angle_is_numpys_at_signed_zeros_and_extremes() -> None:
    """A quantised sensor says -0.0: half a turn to the other side, and a relative subgoal a whole turn away."""
    onnx = pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    from sb3_tbc.export import onnx_graph

    g = onnx_graph._Graph()
    g("Identity", onnx_graph._coordinate(g, "entries", Coordinate("angle", 0, 1)), name="angle")
    double, make = onnx.TensorProto.DOUBLE, onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        g.nodes, "angle", [make("entries", double, ["n", 2])], [make("angle", double, ["n", 1])], g.constants.values()
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", onnx_graph.OPSET)])
    model.ir_version = 8
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    entries = np.array([(y, x) for y in EDGES for x in EDGES if x or y])
    (angles,) = session.run(None, {"entries": entries})
    np.testing.assert_allclose(angles[:, 0], np.arctan2(entries[:, 0], entries[:, 1]), atol=1e-6)


def test_time_budgets_at_their_bounds_are_those_of_the_agent() -> None:
    """A high level whose mean is not bounded reaches them: 2 steps last 2 steps, 2.0000000000000004 last 3."""
    pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    from sb3_tbc.export import onnx_graph

    policy, rules = extract(make("mlp")[0]), OptionRules(dt_max=100 / 13, dt_min=2.0)
    inputs, outputs = policy.n_desired + policy.n_observation, policy.subgoal_dim + 1
    policy = replace(policy, dt_min=rules.dt_min, dt_max=rules.dt_max, mean_bounds=(np.inf, policy.mean_bounds[1]))
    for unit in (-1.0, 1.0):
        high = MLP((np.zeros((inputs, outputs), np.float32),), (np.full(outputs, 50 * unit, np.float32),), "relu")
        graph = onnx_graph.to_onnx(replace(policy, high=high)).SerializeToString()
        session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
        kinds = {"tensor(float)": np.float32, "tensor(double)": np.float64}
        given = {i.name: np.zeros((1, i.shape[1]), kinds[i.type]) for i in session.get_inputs()}
        given["elapsed"] -= 1.0
        (budget,) = session.run(["next_time_budget"], given)
        assert budget == rules.budget(np.array(unit))
