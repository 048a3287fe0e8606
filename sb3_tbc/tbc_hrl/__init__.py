"""TBC-HRL and HiTS: two SAC levels joined by timed windows."""

from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL, HiTS
from sb3_tbc.tbc_hrl.two_level_policy import TBCPolicy

__all__ = ["TBCHRL", "HiTS", "TBCPolicy"]
