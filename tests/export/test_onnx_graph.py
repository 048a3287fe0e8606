"""Parts of the ONNX graph that onnxruntime lacks, beside NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_tbc.export.policy import Coordinate

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
