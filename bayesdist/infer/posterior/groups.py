"""Groups of variables, as in posterior.nc and in the data trees of ArviZ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesdist.errors import InputError

if TYPE_CHECKING:
    import xarray

SAMPLED = ("chain", "draw")  # dimensions that are numbered from 0


@dataclass(frozen=True, eq=False)
class Group:
    """Group of a netCDF file.

    `variables` maps each name to (names of its dimensions, values); `attrs` are the attributes.
    """

    variables: Mapping[str, tuple[tuple[str, ...], Any]] = field(default_factory=dict)
    attrs: Mapping[str, Any] = field(default_factory=dict)


def datatree_of(groups: Mapping[str, Group]) -> xarray.DataTree:
    """Convert groups to a data tree; '' is the root group, chains and draws are numbered from 0.

    Raises InputError if xarray is not installed.
    """
    try:
        import xarray
    except ImportError:
        raise InputError(
            "xarray is not installed", where="to_datatree", do="pip install 'bayesdist[arviz]'"
        ) from None
    return xarray.DataTree.from_dict(
        {f"/{name}": _dataset(group, xarray.Dataset) for name, group in groups.items()}
    )


def _dataset(group: Group, dataset: type[xarray.Dataset]) -> xarray.Dataset:
    sizes: dict[str, int] = {}
    data: dict[str, tuple[tuple[str, ...], Any]] = {}
    coordinates: dict[str, tuple[tuple[str, ...], Any]] = {}
    for name, (along, content) in group.variables.items():
        values = np.asarray(content)
        sizes |= dict(zip(along, values.shape, strict=True))
        (coordinates if along == (name,) else data)[name] = (along, values)
    for name in SAMPLED:
        if name in sizes:
            coordinates[name] = ((name,), np.arange(sizes[name]))
    return dataset(data, coordinates, dict(group.attrs))
