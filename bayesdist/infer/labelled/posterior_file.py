"""posterior.nc: the posterior as a netCDF tree that ArviZ and xarray open.

Groups: posterior, sample_stats, diagnostics, observed_data, constant_data, and log_likelihood --
or, where that would be too large, log_likelihood_summary with the mean and variance for each star.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.infer.labelled import netcdf
from bayesdist.infer.labelled.convergence import Convergence, Limits
from bayesdist.infer.mixture import OutlierMixture
from bayesdist.infer.posterior import Posterior, SamplerInfo
from bayesdist.infer.prior import GaussianPriors
from bayesdist.infer.stars import prepare
from bayesdist.infer.target import Target
from bayesdist.model import DistortionModel

__all__ = ["load_posterior", "save_posterior"]

SCHEMA = 1
LARGEST = 16_000_000  # bytes of log-likelihood that are kept star by star and draw by draw
SUMMARY_DRAWS = 100


def save_posterior(
    posterior: Posterior,
    matches: MatchTable,
    path: str | Path,
    *,
    provenance: Mapping[str, object] | None = None,
) -> None:
    """Write a posterior.

    Parameters
    ----------
    posterior : Posterior
    matches : MatchTable
        The data it was made from.
    path : path
        Replaced atomically.
    provenance : mapping, optional
        JSON-able facts about the run, kept as an attribute.
    """
    import xarray as xr

    c = posterior.convergence
    n_theta = len(posterior.model.names)
    parameter = ("parameter", list(posterior.model.names))
    sampled = ("sampled", list(c.names))
    groups = {
        "posterior": xr.Dataset(
            {
                "theta": (("chain", "draw", "parameter"), posterior.theta),
                **{k: (("chain", "draw"), v) for k, v in posterior.hyper.items()},
            },
            coords={"parameter": parameter, "unit": ("parameter", list(posterior.model.units))},
        ),
        "sample_stats": xr.Dataset(
            {"lp": (("chain", "draw"), posterior.log_prob)}, attrs=asdict(posterior.sampler)
        ),
        "diagnostics": xr.Dataset(
            {
                name: ("sampled", getattr(c, name))
                for name in ("rhat", "ess_bulk", "ess_tail", "mcse_mean", "mcse_sd")
            },
            coords={"sampled": sampled},
            attrs={
                "pareto_k": c.pareto_k,
                "importance_efficiency": c.importance_efficiency,
                "converged": int(c.converged),
                "reasons": json.dumps(c.reasons),
                "limit_ess": c.limits.ess,
                "limit_rhat": c.limits.rhat,
            },
        ),
        "observed_data": xr.Dataset({"u": ("star", matches.u), "v": ("star", matches.v)}),
        "constant_data": _constants(posterior, matches, xr),
        **_log_likelihood(posterior, matches, xr),
    }
    tree = xr.DataTree.from_dict({f"/{name}": data for name, data in groups.items()})
    tree.attrs = {
        "schema": SCHEMA,
        "creator": "bayesdist",
        "model": json.dumps(posterior.model.to_dict()),
        "mixture": json.dumps(asdict(posterior.mixture)),
        "provenance": json.dumps(dict(provenance or {}), default=str),
        "n_parameters": n_theta,
    }
    netcdf.write(tree, path)


def _constants(posterior: Posterior, matches: MatchTable, xr):  # type: ignore[no-untyped-def]
    columns = {
        "x": matches.x,
        "y": matches.y,
        "sigma_u": matches.sigma_u,
        "sigma_v": matches.sigma_v,
        "exposure": np.asarray(matches.exposure),
        "chip": np.asarray(matches.chip_numbers)[matches.chip],
        "outlier_probability": posterior.outlier_probability,
        "row": matches.row,
    }
    for name in ("epoch", "mag"):
        if getattr(matches, name) is not None:
            columns[name] = getattr(matches, name)
    return xr.Dataset(
        {name: ("star", values) for name, values in columns.items()},
        attrs={"unit": matches.unit, "exposure_names": json.dumps(matches.exposure_names)},
    )


def _log_likelihood(posterior: Posterior, matches: MatchTable, xr):  # type: ignore[no-untyped-def]
    target = Target(
        prepare(posterior.model, matches), posterior.mixture, GaussianPriors.none(posterior.model)
    )
    chains, draws = posterior.log_prob.shape
    psi = _psi(posterior, target)
    if chains * draws * len(matches) * 8 <= LARGEST:
        values = target.star_log_likelihood(psi.reshape(chains * draws, -1))
        values = values.reshape(chains, draws, len(matches))
        return {"log_likelihood": xr.Dataset({"uv": (("chain", "draw", "star"), values)})}
    some = np.linspace(0, chains * draws - 1, min(SUMMARY_DRAWS, chains * draws)).astype(int)
    mean, square = np.zeros(len(matches)), np.zeros(len(matches))
    for point in psi.reshape(chains * draws, -1)[some]:
        value = target.star_log_likelihood(point[None])[0]
        mean += value / len(some)
        square += value**2 / len(some)
    return {
        "log_likelihood_summary": xr.Dataset(
            {"mean": ("star", mean), "variance": ("star", np.maximum(square - mean**2, 0.0))},
            attrs={"draws": len(some)},
        )
    }


def _psi(posterior: Posterior, target: Target) -> NDArray[np.float64]:
    natural = posterior.hyper
    columns = [
        np.log(natural[k]) - np.log1p(-natural[k]) if k == "f" else np.log(natural[k])
        for k in posterior.mixture.hyper
    ]
    return np.concatenate([posterior.theta, *(c[..., None] for c in columns)], axis=-1)


def load_posterior(path: str | Path) -> Posterior:
    """Read a posterior back.

    Parameters
    ----------
    path : path
        A posterior.nc, or a run directory that holds one.

    Returns
    -------
    Posterior

    Raises
    ------
    FormatError
        When the file is missing or is not such a file.
    """
    import xarray as xr

    path = Path(path)
    if path.is_dir():
        path = path / "posterior.nc"
    with netcdf.reading(path, "a posterior", "sample"):
        with xr.open_datatree(path, engine=netcdf.ENGINE) as tree:
            tree.load()
        attrs = tree.attrs
        draws, checks = tree["posterior"].to_dataset(), tree["diagnostics"].to_dataset()
        stats = tree["sample_stats"].to_dataset()
        if attrs.get("creator") != "bayesdist":
            raise KeyError("creator")
        mixture = json.loads(attrs["mixture"])
        mixture["fraction_prior"] = tuple(mixture["fraction_prior"])
        info: dict[str, Any] = {str(k): _plain(v) for k, v in stats.attrs.items()}
        return Posterior(
            model=DistortionModel.from_dict(json.loads(attrs["model"])),
            mixture=OutlierMixture(**mixture),
            theta=draws["theta"].values,
            hyper={k: draws[k].values for k in ("j", "f", "s_out") if k in draws},
            log_prob=stats["lp"].values,
            outlier_probability=tree["constant_data"].to_dataset()["outlier_probability"].values,
            convergence=Convergence(
                names=tuple(str(n) for n in checks["sampled"].values),
                rhat=checks["rhat"].values,
                ess_bulk=checks["ess_bulk"].values,
                ess_tail=checks["ess_tail"].values,
                mcse_mean=checks["mcse_mean"].values,
                mcse_sd=checks["mcse_sd"].values,
                pareto_k=float(checks.attrs["pareto_k"]),
                importance_efficiency=float(checks.attrs["importance_efficiency"]),
                converged=bool(checks.attrs["converged"]),
                reasons=tuple(json.loads(checks.attrs["reasons"])),
                limits=Limits(float(checks.attrs["limit_ess"]), float(checks.attrs["limit_rhat"])),
            ),
            sampler=SamplerInfo(**info),
        )


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value
