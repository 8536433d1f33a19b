"""The table that the observatory delivered for ACS/WFC, read once."""

from __future__ import annotations

import pytest

from bayesdist.formats.idctab.table import IdcTab, read_idctab


@pytest.fixture(scope="session")
def real(data_dir) -> IdcTab:
    """An IDCTAB of order 5 with drift and 336 combinations of filters."""
    return read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
