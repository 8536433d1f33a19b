"""Truths outside the family of the fitted models, and what is claimed of positions there.

`python -m tests.adversarial RESULTS.json` carries each kind of truth with several seeds through a
run, as far as its assessment, and makes a table: do the stated errors cover, is a requirement
called met that the truth misses, and is a refusal given for the right reason?
"""

from . import (  # noqa: F401  (each enters its kinds)
    campaign_kinds,
    contamination_kinds,
    exposure_kinds,
    selfcal_kinds,
    star_kinds,
    static_kinds,
    time_kinds,
    varying_kinds,
)
from .truth import KINDS

__all__ = ["KINDS"]
