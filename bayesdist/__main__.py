"""``python -m bayesdist``."""

import sys

from bayesdist.app.cli import program

if __name__ == "__main__":
    sys.exit(program())
