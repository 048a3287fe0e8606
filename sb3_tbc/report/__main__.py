"""``python -m sb3_tbc.report``."""

import sys

from sb3_tbc.report.command import main

if __name__ == "__main__":
    sys.exit(main())
