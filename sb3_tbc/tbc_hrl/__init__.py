"""TBC-HRL, HiTS and HAC: two SAC levels joined by windows."""

from sb3_tbc.tbc_hrl.baselines import HAC, HiTS
from sb3_tbc.tbc_hrl.policy import TBCPolicy
from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL

__all__ = ["HAC", "TBCHRL", "HiTS", "TBCPolicy"]
