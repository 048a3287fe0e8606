"""``python -m sb3_tbc.benchmark``."""

import sys

from sb3_tbc.benchmark.command import main

if __name__ == "__main__":
    sys.exit(main())
