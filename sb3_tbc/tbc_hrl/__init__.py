"""TBC-HRL, HiTS and HAC: two SAC levels joined by windows."""

from sb3_tbc.tbc_hrl.baselines import HAC, HiTS
from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.two_level_policy import TBCPolicy

__all__ = ["HAC", "TBCHRL", "HiTS", "TBCPolicy"]
