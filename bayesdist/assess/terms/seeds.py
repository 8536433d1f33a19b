"""Random numbers of each term by itself: they do not depend on what other terms there are."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Sequence

import numpy as np

from bayesdist.assess.terms.forms import ErrorTerm

__all__ = ["generators"]


def generators(terms: Sequence[ErrorTerm], seed: int) -> list[np.random.Generator]:
    """A generator for each term, by the name of its first row and how often that came before."""
    seen: Counter[str] = Counter()
    out = []
    for term in terms:
        name = term.rows[0].name
        out.append(np.random.default_rng([seed, zlib.crc32(name.encode()), seen[name]]))
        seen[name] += 1
    return out
