"""``python -m sb3_tbc.export``."""

import sys

from sb3_tbc.export.command import main

if __name__ == "__main__":
    sys.exit(main())
