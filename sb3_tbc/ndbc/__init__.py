"""The NDBCNet: sparse wiring, conductance and dissipative cells, the network, and its NumPy form for acting."""

from sb3_tbc.ndbc.drawing import draw_wiring
from sb3_tbc.ndbc.frozen import FrozenNDBC
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring

NDBCWiring.drawer = staticmethod(draw_wiring)

__all__ = ["FrozenNDBC", "NDBCNet", "NDBCWiring"]
