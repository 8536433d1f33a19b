"""Readers of star lists of single programs, defined in `bayesdist.data`."""

from bayesdist.data import (
    read_hst1pass as read_hst1pass,
)
from bayesdist.data import (
    read_matchup as read_matchup,
)
