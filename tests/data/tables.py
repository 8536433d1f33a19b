"""Matches of a table by options alone: errors may be missing."""

from __future__ import annotations

from bayesdist.data import Matches
from bayesdist.data.reading.table import match_arguments


def matches_from_table(table, options=None, **names):
    return Matches(**match_arguments(table, options, **names))
