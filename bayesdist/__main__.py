"""``python -m bayesdist``."""

import sys

from bayesdist.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
