"""fit.nc: the linear fit as a netCDF file."""

from __future__ import annotations

import json
from pathlib import Path

from bayesdist.infer.files import netcdf
from bayesdist.infer.linear import Clip, LinearFit
from bayesdist.model import DistortionModel

__all__ = ["load_fit", "save_fit"]

NUMBERS = ("n_rows", "n_used", "rms_u", "rms_v", "rms_rejected", "chi2", "dof", "condition")


def save_fit(fit: LinearFit, path: str | Path) -> None:
    """Write a linear fit; the file is replaced atomically."""
    import xarray as xr

    names = list(fit.model.names)
    data = xr.Dataset(
        {
            "mean": ("parameter", fit.mean),
            "cov": (("parameter", "parameter_2"), fit.cov),
            "clip": ("parameter", fit.clip.theta),
        },
        coords={"parameter": names, "parameter_2": names},
        attrs={
            "creator": "bayesdist",
            "model": json.dumps(fit.model.to_dict()),
            "rejected": json.dumps(fit.rejected),
            "clip_chi2_limit": fit.clip.chi2_limit,
            "clip_abs_limit": fit.clip.abs_limit,
            **{name: getattr(fit, name) for name in NUMBERS},
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
            clip=Clip(
                data["clip"].values,
                float(data.attrs["clip_chi2_limit"]),
                float(data.attrs["clip_abs_limit"]),
            ),
            rejected=json.loads(data.attrs["rejected"]),
            **{name: data.attrs[name].item() for name in NUMBERS},
        )
