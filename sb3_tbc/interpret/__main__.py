"""``python -m sb3_tbc.interpret``."""

import sys

from sb3_tbc.interpret.command import main

if __name__ == "__main__":
    sys.exit(main())
