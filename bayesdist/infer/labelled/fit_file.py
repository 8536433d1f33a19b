"""fit.nc: the linear fit as a netCDF file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from bayesdist.infer.labelled import netcdf
from bayesdist.infer.linear import LinearFit
from bayesdist.model import DistortionModel

__all__ = ["load_fit", "save_fit"]


def save_fit(fit: LinearFit, path: str | Path) -> None:
    """Write a linear fit; the file is replaced atomically."""
    import xarray as xr

    names = list(fit.model.names)
    data = xr.Dataset(
        {
            "mean": ("parameter", fit.mean),
            "cov": (("parameter", "parameter_2"), fit.cov),
            "residual": (("star", "axis"), fit.residual),
            "used": ("star", fit.used.astype(np.int8)),
        },
        coords={"parameter": names, "parameter_2": names, "axis": ["u", "v"]},
        attrs={
            "creator": "bayesdist",
            "model": json.dumps(fit.model.to_dict()),
            "rejected": json.dumps(fit.rejected),
            "chi2": fit.chi2,
            "dof": fit.dof,
            "condition": fit.condition,
        },
    )
    netcdf.write(data, path)


def load_fit(path: str | Path) -> LinearFit:
    """Read a linear fit back.

    Raises
    ------
    FormatError
        When the file is missing or is not such a file.
    """
    import xarray as xr

    path = Path(path)
    with netcdf.reading(path, "a fit", "fit"):
        with xr.open_dataset(path, engine=netcdf.ENGINE) as data:
            data.load()
        return LinearFit(
            model=DistortionModel.from_dict(json.loads(data.attrs["model"])),
            mean=data["mean"].values,
            cov=data["cov"].values,
            residual=data["residual"].values,
            used=data["used"].values.astype(bool),
            rejected=json.loads(data.attrs["rejected"]),
            chi2=float(data.attrs["chi2"]),
            dof=int(data.attrs["dof"]),
            condition=float(data.attrs["condition"]),
        )
