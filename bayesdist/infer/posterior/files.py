"""Read and write solutions as netCDF files.

Files are replaced atomically; any problem in reading raises a single `FormatError`. A checksum
shows whether what was written has been changed; what others add is ignored.

fit.nc holds a linear fit. posterior.nc holds a posterior as a tree that ArviZ and xarray can open,
with the groups posterior, sample_stats and diagnostics. For tables in memory it also has
observed_data, constant_data and, unless it would be too large, log_likelihood. Values per star of
larger data are written to separate files in `stars/`.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any

import h5netcdf
import h5py
import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import FormatError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.documents import json_of
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import NetcdfGroup, netcdf_groups
from bayesdist.infer.convergence import DIAGNOSTICS, Convergence, Limits
from bayesdist.infer.posterior import Posterior, SamplerInfo
from bayesdist.infer.posterior.memberships import memberships, star_log_likelihood
from bayesdist.infer.posterior.posterior import SCHEMA, Group, datatree_of
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.likelihood import Clip, OutlierMixture
from bayesdist.model import DistortionModel
from bayesdist.utils.quantities import takes

if TYPE_CHECKING:
    import xarray

MOST_STARS = 1_000_000  # the file repeats the data of at most this many stars
LARGEST = 16_000_000  # bytes; a larger log-likelihood (per star and draw) is not stored
FIT_NUMBERS = ("n_rows", "n_used", "rms_u", "rms_v", "rms_rejected", "chi2", "dof", "condition")
CHECKED = ("", "posterior", "sample_stats", "diagnostics")  # groups of posterior.nc that are read
UNCHECKED = ("provenance", "wall_s")  # attributes that differ between equal runs


@takes(posterior=Posterior, matches=(Matches, NoneType))
def save_posterior(
    posterior: Posterior,
    matches: Matches | None,
    path: str | Path,
    *,
    provenance: Mapping[str, object] | None = None,
    max_stars: int = MOST_STARS,
    max_bytes: int = LARGEST,
) -> None:
    """Write a posterior to a netCDF file.

    Parameters
    ----------
    posterior : Posterior
    matches : Matches or None
        The data from which the posterior was sampled; None omits them.
    path : path
        Output file, replaced atomically.
    provenance : mapping, optional
        Facts about the run that JSON can represent, stored as an attribute.
    max_stars : int
        The matches are not stored if there are more stars than this.
    max_bytes : int
        The log-likelihood of each star at each draw is not stored if it is larger than this.

    Raises
    ------
    InputError
        If the file cannot be written.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> posterior = bd.sample(fit, matches, seed=1, target_ess=100)
    >>> bd.save_posterior(posterior, matches, "posterior.nc")
    >>> np.array_equal(bd.load_posterior("posterior.nc").theta, posterior.theta)
    True
    """
    _write(_groups(posterior, matches, provenance, max_stars, max_bytes), path)


def posterior_datatree(
    posterior: Posterior,
    matches: Matches | None = None,
    *,
    provenance: Mapping[str, object] | None = None,
) -> xarray.DataTree:
    """Data tree with the groups of posterior.nc.

    Parameters
    ----------
    posterior, matches, provenance
        See `save_posterior`.

    Returns
    -------
    xarray.DataTree
        Groups posterior, sample_stats and diagnostics; with `matches` also observed_data,
        constant_data and, unless it is too large, log_likelihood.

    Raises
    ------
    InputError
        If xarray is not installed.
    """
    return datatree_of(_groups(posterior, matches, provenance))


def _groups(
    posterior: Posterior,
    matches: Matches | None,
    provenance: Mapping[str, object] | None,
    max_stars: int = MOST_STARS,
    max_bytes: int = LARGEST,
) -> dict[str, Group]:
    """Groups of posterior.nc by name, the top group under ''."""
    groups = posterior.groups(provenance)
    if matches is not None and len(matches) <= max_stars:
        groups["observed_data"] = Group({"u": (("star",), matches.u), "v": (("star",), matches.v)})
        groups["constant_data"] = _constants(posterior, matches)
        # omitted if the stars' positions are unknowns too: they are given at a single draw only
        is_small = posterior.log_prob.size * len(matches) * 8 <= max_bytes
        if is_small and not posterior.own_places:
            values = star_log_likelihood(posterior, matches)
            groups["log_likelihood"] = Group({"uv": (("chain", "draw", "star"), values)})
    return groups


def _constants(posterior: Posterior, matches: Matches) -> Group:
    """Group constant_data: columns of the matches from which the posterior was sampled."""
    columns = {
        "x": matches.x,
        "y": matches.y,
        "sigma_u": matches.sigma_u,
        "sigma_v": matches.sigma_v,
        "exposure": np.asarray(matches.exposure),
        "chip": matches.chip_number,
        "outlier_probability": memberships(posterior, matches).outlier_probability,
        "row": matches.row,
    }
    for name in ("rho_uv", "epoch", "mag", "colour"):
        if getattr(matches, name) is not None:
            columns[name] = getattr(matches, name)
    return Group(
        {name: (("star",), values) for name, values in columns.items()},
        attrs={"unit": matches.unit, "exposure_names": json.dumps(matches.exposure_names)},
    )


def load_posterior(path: str | Path) -> Posterior:
    """Read a posterior from a netCDF file.

    Parameters
    ----------
    path : path
        A file written by `save_posterior`, or a run directory that contains posterior.nc.

    Returns
    -------
    Posterior

    Raises
    ------
    FormatError
        If the file is missing, damaged, or not a posterior.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> posterior = bd.sample(fit, matches, seed=1, target_ess=100)
    >>> bd.save_posterior(posterior, None, "posterior.nc")
    >>> bd.load_posterior("posterior.nc").model == posterior.model
    True
    """
    path = Path(path)
    if path.is_dir():
        path = path / "posterior.nc"
    with _reading(path, "a posterior", "sample"):
        groups = netcdf_groups(path)
        attrs, draws = groups[""].attrs, groups["posterior"].arrays
        checks, limits = groups["diagnostics"].arrays, groups["diagnostics"].attrs
        stats = groups["sample_stats"]
        if attrs.get("creator") != "bayesdist":
            raise KeyError("creator")
        if attrs.get("schema") != SCHEMA:
            raise FormatError(f"schema {attrs.get('schema')} is not {SCHEMA}", do="sample again")
        mixture = _tree(attrs["mixture"])
        mixture["fraction_prior"] = tuple(mixture["fraction_prior"])
        info: dict[str, Any] = {str(k): _plain(v) for k, v in stats.attrs.items()}
        if not 0 <= info["wall_s"] < np.inf:
            raise ValueError("the sampling took no finite time")
        model = DistortionModel.from_dict(_tree(attrs["model"]))
        theta, log_prob = draws["theta"], stats.arrays["lp"]
        hyper = {str(name): draws[name] for name in ("j", "f", "s_out") if name in draws}
        shape = (*theta.shape[:2], len(model.names))
        _refuse_other_shape(theta, shape)
        for values in (log_prob, *hyper.values()):
            _refuse_other_shape(values, shape[:2])
        for check in DIAGNOSTICS:  # NaN where a parameter does not move
            _refuse_other_shape(np.nan_to_num(checks[check]), checks["sampled"].shape)
        posterior = Posterior(
            model=model,
            mixture=OutlierMixture(**mixture),
            theta=theta,
            hyper=hyper,
            log_prob=log_prob,
            n_stars=int(attrs["n_stars"]),
            n_flagged=int(attrs["n_flagged"]),
            n_false=float(attrs["n_false"]),
            reference_sigma=float(attrs["reference_sigma"]),
            convergence=Convergence(
                names=tuple(str(n) for n in checks["sampled"]),
                **{name: checks[name] for name in DIAGNOSTICS},
                pareto_k=float(limits["pareto_k"]),
                importance_efficiency=float(limits["importance_efficiency"]),
                converged=bool(limits["converged"]),
                reasons=tuple(_tree(limits["reasons"])),
                limits=Limits(float(limits["limit_ess"]), float(limits["limit_rhat"])),
            ),
            sampler=SamplerInfo(**info),
            own_places=bool(attrs.get("own_places", False)),
            tangent_point=_tangent_point(attrs),
        )
        _refuse_changed({name: groups[name] for name in CHECKED})
        return posterior


def _tangent_point(attrs: Mapping[str, Any]) -> tuple[float, float] | None:
    """RA and Dec (deg) of the tangent point of u, v; None if the file does not state them."""
    point = _tree(attrs["tangent_point"]) if "tangent_point" in attrs else None
    return None if point is None else (float(point[0]), float(point[1]))


def _refuse_other_shape(values: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Raise ValueError if an array has a different shape or contains non-finite values."""
    if values.shape != shape:
        raise ValueError(f"an array has the shape {values.shape} instead of {shape}")
    if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise ValueError("an array has values that are not finite")


def _checked(groups: Mapping[str, NetcdfGroup]) -> list[list[str]]:
    """Group and name of each attribute and variable that the checksum covers."""
    return [
        [group, name]
        for group in sorted(groups)
        for name in sorted({*groups[group].attrs, *groups[group].arrays})
        if name not in UNCHECKED
    ]


def _checksum(groups: Mapping[str, NetcdfGroup], checked: list[list[str]]) -> str:
    """SHA-256 of attributes and variables of groups; KeyError if one is missing."""
    digest = hashlib.sha256(json.dumps(checked).encode())
    for group, name in checked:
        if name in groups[group].arrays:
            values = groups[group].arrays[name]
            is_text = values.dtype.kind in "OU"
            kind = "text" if is_text else values.dtype.str
            digest.update(f"{kind} {values.shape}\n".encode())
            digest.update(json.dumps(values.tolist()).encode() if is_text else values.tobytes())
        else:
            digest.update(json.dumps(np.asarray(groups[group].attrs[name]).tolist()).encode())
    return digest.hexdigest()


def _refuse_changed(groups: Mapping[str, NetcdfGroup]) -> None:
    """Raise FormatError if the content of a file contradicts its checksum."""
    attrs = groups[""].attrs
    if "checksum" not in attrs:
        raise FormatError(
            "it has no checksum: an earlier revision of bayesdist wrote it", do="sample again"
        )
    try:
        agrees = attrs["checksum"] == _checksum(groups, _tree(attrs["checked"]))
    except KeyError:
        agrees = False
    if not agrees:
        raise FormatError(
            "its content contradicts its checksum: it is damaged or was changed",
            do="restore it, or sample again",
        )


def _tree(text: object) -> Any:
    """Parse an attribute that holds JSON."""
    if not isinstance(text, str):
        raise TypeError("an attribute is not a string")
    return json_of(text, "")


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


def save_fit(fit: LinearFit, path: str | Path) -> None:
    """Write a linear fit to a netCDF file.

    Parameters
    ----------
    fit : LinearFit
    path : path
        Output file, replaced atomically.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    names = fit.model.names
    data = Group(
        {
            "mean": (("parameter",), fit.mean),
            "cov": (("parameter", "parameter_2"), fit.cov),
            "clip": (("parameter",), fit.clip.theta),
            "parameter": (("parameter",), names),
            "parameter_2": (("parameter_2",), names),
        },
        attrs={
            "creator": "bayesdist",
            "model": json.dumps(fit.model.to_dict()),
            "rejected": json.dumps(fit.rejected),
            "clip_chi2_limit": fit.clip.chi2_limit,
            "clip_abs_limit": fit.clip.abs_limit,
            "clip_spared_chi2": fit.clip.spared_chi2,
            **{name: getattr(fit, name) for name in FIT_NUMBERS},
            "tangent_point": json.dumps(fit.tangent_point),
        },
    )
    _write({"": data}, path)


def load_fit(path: str | Path) -> LinearFit:
    """Read a linear fit from a netCDF file.

    Parameters
    ----------
    path : path
        A file written by `save_fit`.

    Returns
    -------
    LinearFit

    Raises
    ------
    FormatError
        If the file is missing, damaged, or not a fit.
    """
    path = Path(path)
    with _reading(path, "a fit", "fit"):
        top = netcdf_groups(path)[""]
        data, attrs = top.arrays, top.attrs
        if attrs.get("creator") != "bayesdist":
            raise KeyError("creator")
        model = DistortionModel.from_dict(_tree(attrs["model"]))
        n = len(model.names)
        for name, shape in (("mean", (n,)), ("cov", (n, n)), ("clip", (n,))):
            _refuse_other_shape(data[name], shape)
        fit = LinearFit(
            model=model,
            mean=data["mean"],
            cov=data["cov"],
            clip=Clip(
                data["clip"],
                float(attrs["clip_chi2_limit"]),
                float(attrs["clip_abs_limit"]),
                float(attrs["clip_spared_chi2"]),
            ),
            rejected=_tree(attrs["rejected"]),
            tangent_point=_tangent_point(attrs),
            **{name: attrs[name].item() for name in FIT_NUMBERS},
        )
        _refuse_changed({"": top})
        return fit


def _write(groups: Mapping[str, Group], path: str | Path) -> None:
    """Write the groups to a file, which is replaced atomically; '' is the root group.

    The file is built in memory because HDF5 crashes when it closes a file on a full disk.
    """
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        for name, group in groups.items():
            _fill(file.create_group(name) if name else file, group)
        written = {name: _as_read(groups[name]) for name in CHECKED if name in groups}
        checked = _checked(written)
        file.attrs.update(checked=json.dumps(checked), checksum=_checksum(written, checked))
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def _as_read(group: Group) -> NetcdfGroup:
    """Content of a group as `netcdf_groups` returns it."""
    arrays = {name: np.asarray(content) for name, (_, content) in group.variables.items()}
    return NetcdfGroup(arrays, dict(group.attrs))


def _fill(target: h5netcdf.Group, group: Group) -> None:
    """Write the attributes, dimensions and variables of a group."""
    target.attrs.update(group.attrs)
    for name, (along, content) in group.variables.items():
        values = np.asarray(content)
        if values.dtype.kind == "U":
            values = values.astype(h5py.string_dtype())
        for dimension, size in zip(along, values.shape, strict=True):
            target.dimensions.setdefault(dimension, size)
        target.create_variable(name, along, values.dtype, values)


@contextmanager
def _reading(path: Path, what: str, stage: str) -> Iterator[None]:
    """Convert any exception raised while a file is read to a FormatError.

    `what` names the expected content ('a posterior', 'a fit'), `stage` the stage that produces it.
    """
    if not path.exists():
        raise FormatError(
            "there is no such file", where=str(path), do=f"run 'bayesdist stage {stage} RUN' first"
        )
    with restoring(path, what, do=f"make it again with 'bayesdist stage {stage} RUN'"):
        yield
