"""Folders of the real sets; without BAYESDIST_DATA their tests are skipped by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from .megacam import Pairs, of_file


@pytest.fixture(scope="session")
def every_pair(data_dir: Path) -> Pairs:
    """Candidate pairs of MegaCam and Gaia."""
    return of_file(data_dir / "megacam_gaia" / "megacam744331p_gaiadr1_pairs_8arcsec.csv")


@pytest.fixture(scope="session")
def megacam(every_pair: Pairs, full: bool) -> Pairs:
    """Those of six of the 36 CCDs, or all."""
    return every_pair if full else every_pair.of_ccds(range(6))
