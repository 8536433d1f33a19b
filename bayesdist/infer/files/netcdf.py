"""netCDF files written whole or not at all, and read with one clear error."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bayesdist.data.files import atomic_path
from bayesdist.errors import FormatError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["ENGINE", "reading", "write"]

ENGINE: Final = "h5netcdf"


def write(data: xr.Dataset | xr.DataTree, path: str | Path) -> None:
    """Write a dataset or a tree, replaced atomically.

    The file is put together in memory: on a full disk HDF5 itself would crash when it is closed.
    """
    content = data.to_netcdf(engine=ENGINE)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def reading(path: Path, what: str, stage: str) -> Iterator[None]:
    """Turn whatever goes wrong while a file is read into one error.

    Parameters
    ----------
    path : Path
    what : str
        What the file should be: 'a posterior', 'a fit'.
    stage : str
        The stage that makes it.

    Raises
    ------
    FormatError
    """
    if not path.exists():
        raise FormatError(
            "there is no such file", where=str(path), do=f"run 'bayesdist stage {stage} RUN' first"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # foreign HDF5 files are told of below
            yield
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise FormatError(
            f"this is not {what} that bayesdist wrote, or it is damaged",
            where=str(path),
            do=f"make it again with 'bayesdist stage {stage} RUN'",
        ) from error
