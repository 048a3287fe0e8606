"""``python -m sb3_tbc.tune``."""

import sys

from sb3_tbc.tune.command import main

if __name__ == "__main__":
    sys.exit(main())
