"""`bayesdist.calibrate`: from matched stars in Python to a finished run in memory."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import fields
from datetime import date
from datetime import time as time_of_day
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from bayesdist.app.config import parse_config
from bayesdist.app.config.results import RequirementBlock
from bayesdist.app.pipeline import diagnose, evaluate, rehearse, sample
from bayesdist.app.python_terms import in_python_terms
from bayesdist.app.run import Run
from bayesdist.app.runs import MATCHES_FILE
from bayesdist.app.screen import progress_bar
from bayesdist.app.stars import StarReader
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import Requirement, UserTerm
from bayesdist.assess.requirements.requirement import as_requirements
from bayesdist.assess.terms.catalogue import Catalogue, require_catalogue
from bayesdist.data import Matches, ReadOptions
from bayesdist.data.reading.options import check_sigma
from bayesdist.data.reading.table import match_arguments
from bayesdist.errors import ConfigError, InputError
from bayesdist.infer import OutlierMixture
from bayesdist.kinds.matches.config import MatchesConfig
from bayesdist.kinds.matches.kind import read_stars
from bayesdist.model import Chip, TimeDependence
from bayesdist.utils.quantities import value_in, values_in, year_of

__all__ = ["calibrate"]

WHERE = "calibrate"  # used in messages in place of the name of the configuration file
# keys of [data] that apply to reading a table
READING = (
    *("columns", "unit", "pixel_origin", "tangent_point", "epoch", "catalogue_epoch"),
    *("motion_prior", "not_finite", "same_position"),
)

# arguments that settings may replace if they have their default values
DEFAULTS = {
    "assess.exposure": "mean",
    "detector.name": "",
    "model.frames": "none",
    "sampler.seed": 1,
}

Settings = dict[str, Any]


@in_python_terms()
def calibrate(
    matches: Any,
    *,
    order: int,
    size: tuple[float, float] | None = None,
    chips: Sequence[Chip] = (),
    reference_pixel: tuple[float, float] | None = None,
    scale_mas: Any = None,
    frames: str = "none",
    time: TimeDependence | None = None,
    sigma: Any = None,
    outliers: OutlierMixture | str = "gaussian",
    catalogue: Catalogue | None = None,
    terms: Sequence[UserTerm] = (),
    requirements: Requirement | Sequence[Requirement] = (),
    epoch: Any = None,
    exposure: str = "mean",
    held_out: float = 0.0,
    seed: int = 1,
    name: str = "",
    settings: Mapping[str, Mapping[str, Any]] | None = None,
    progress: bool = False,
) -> Run:
    """Calibrate the geometric distortion of a detector from matched stars.

    The distortion is fitted and its posterior sampled, the residuals are examined, and the errors
    of positions are evaluated.  The same stars, settings and seed give the same numbers as
    ``bayesdist run``, bit for bit.

    Parameters
    ----------
    matches : Matches, table or path
        Matched stars, a table that `Matches.from_table` takes, or files that `read_matches` reads.
    order : int
        Total order of the polynomials, 1 to 12.
    size : tuple of float, optional
        Columns and rows of a detector with one chip.
    chips : sequence of Chip, optional
        Chips of a detector with several, the reference chip first, in place of `size`.
    reference_pixel : tuple of float, optional
        Zero point of the polynomials, FITS 1-based pixels; the centre of the chip by default.
    scale_mas : float or Quantity, optional
        Size of a pixel in mas, to convert requirements and to print mas in addition to pixels.
    frames : {'none', 'shift', 'shift_rotation', 'shift_rotation_scale', 'affine'}
        Transformation that is fitted to each exposure.
    time : TimeDependence, optional
        Terms of the polynomials that drift linearly with time.
    sigma : {'columns', 'by_magnitude'}, float or Quantity, optional
        Source of the errors of the matches: their own, an estimate from the residuals by magnitude,
        or one number in the unit of u and v.  By default their own if they have any, else the
        estimate by magnitude.
    outliers : OutlierMixture or {'gaussian', 'uniform', 'none'}
        Distribution of false matches.  If it has no match radius, that of `matches` is used: those
        that `match` made state it, also in the files that they were written to.
    catalogue : Catalogue, optional
        Systematic error of the reference catalogue, as in ``bd.Catalogue("Gaia DR3")``.  Without it
        verdicts are undecided, because no residual shows this error.
    terms : sequence of UserTerm
        Other errors that the data cannot show.
    requirements : Requirement or sequence of Requirement
        Limits on the position error.
    epoch : float or Time, optional
        Date of the evaluation, in decimal years; needed only if the model depends on time.  The
        date of the exposures, to which proper motions are applied, is ``data.epoch`` in `settings`.
    exposure : {'mean', 'single'}
        Evaluate errors of the mean calibration, or of a single exposure.
    held_out : float
        Fraction of the stars that are set aside to test the result.
    seed : int
        Seed of all random numbers.
    name : str
        Name of the detector.
    settings : mapping of str to mapping, optional
        Other sections and keys of the configuration, as in a TOML file, for example
        ``{"sampler": {"max_steps": 40000}, "data": {"epoch": 2024.3}}``.
    progress : bool
        Show a progress bar while sampling, if stderr is a terminal.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        If the stars or settings cannot be used: what is wrong, where, and what to do.

    Examples
    --------
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model = bd.DistortionModel(1, (chip,), "pix")
    >>> truth = [0, 1000, 0, 0, 0, 1000]
    >>> rng = np.random.default_rng(1)
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> gaia = bd.Catalogue("Gaia DR3", sigma=0.0005, unit="pix", source="a made-up example")
    >>> run = bd.calibrate(stars, order=1, size=(2048, 2048), catalogue=gaia)
    >>> run.converged
    True
    >>> run.check(bd.Requirement("whole field", "p95", 0.1))[0].verdict
    'met'
    """
    require_catalogue(catalogue)
    settings = _checked({} if settings is None else settings)
    stars, data = None, {"matches": MATCHES_FILE, "sigma": sigma}
    if _is_path(matches):
        data["matches"] = _absolute(matches)
    else:
        options = dict(settings.pop("data", {}))
        data["simulated"] = options.pop("simulated", None)
        data["same_position"] = options.get("same_position")
        stars, data["sigma"] = _stars(matches, sigma, options)
    configured: Settings = {
        "data": data,
        "detector": {
            "name": name,
            "size": _pixels(size, "size"),
            "scale_mas": _in(scale_mas, "mas", "scale_mas"),
        },
        "chip": [
            {
                "number": chip.number,
                "name": chip.name or f"chip {chip.number}",
                "size": chip.size,
                "reference_pixel": chip.reference_pixel,
                "reference": chip is chips[0],
            }
            for chip in _chips(chips)
        ],
        "model": {
            "order": order,
            "reference_pixel": _pixels(reference_pixel, "reference_pixel"),
            "frames": frames,
            "tdd": None if time is None else _drift(time),
        },
        "outliers": _outliers(outliers, None if stars is None else stars.unit),
        "sampler": {"seed": seed},
        "assess": {"epoch": None if epoch is None else year_of(epoch), "exposure": exposure},
        "holdout": None
        if isinstance(held_out, int | float) and held_out == 0
        else {"fraction": held_out},
        "catalogue": None if catalogue is None or catalogue.sigma else catalogue.section(),
        "budget": _budget(catalogue, terms, None if stars is None else stars.unit),
        "requirement": [_requirement_block(limit) for limit in as_requirements(requirements)],
    }
    text = tomli_w.dumps(_merged(configured, settings))
    config = parse_config(text, WHERE)
    if not isinstance(config, MatchesConfig):
        raise ConfigError(
            "settings describe a campaign or a self-calibration, which begins with star lists",
            where=WHERE,
            do="write a configuration file, and give it to bayesdist.run",
        )
    if stars is None:
        stars = read_stars(config, Path.cwd())
    directory = RunDirectory.unsaved(config, text, files=_is_path(matches))
    run = Run(directory, StarReader(config.resources()), made={"inputs": stars})
    return _calibrated(run, progress)


def _checked(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by section, with the file of an earlier calibration as an absolute path."""
    if not isinstance(settings, Mapping):
        raise ConfigError(
            f"settings are {settings!r}",
            where=WHERE,
            do='give sections with their keys, as in {"sampler": {"max_steps": 40000}}',
        )
    checked = dict(settings)
    for name, section in checked.items():
        blocks = section if isinstance(section, list | tuple) else [section]
        if not isinstance(name, str) or not all(isinstance(b, Mapping) for b in blocks):
            raise ConfigError(
                f"settings[{name!r}] is {section!r}",
                where=WHERE,
                do='give sections with their keys, as in {"sampler": {"max_steps": 40000}}',
            )
    earlier = checked.get("prior_calibration")
    if isinstance(earlier, Mapping) and isinstance(earlier.get("source"), str | os.PathLike):
        checked["prior_calibration"] = {**earlier, "source": _absolute(earlier["source"])}
    return checked


def _calibrated(run: Run, progress: bool) -> Run:
    """Run with fit, posterior, diagnostics and evaluation."""
    run = rehearse(run)
    with progress_bar("sample") if progress else nullcontext() as update:
        run = sample(run, progress=update)
    return evaluate(diagnose(run))


def _is_path(matches: Any) -> bool:
    """True if the stars are given as names of files."""
    if isinstance(matches, str | os.PathLike):
        return True
    return (
        isinstance(matches, list | tuple)
        and len(matches) > 0
        and all(isinstance(part, str | os.PathLike) for part in matches)
    )


def _stars(matches: Any, sigma: Any, options: Mapping[str, Any]) -> tuple[Matches, str | float]:
    """Matches with the requested errors, and the source of these errors.

    `options` are keys of the section [data] that apply to reading a table.
    """
    if not isinstance(matches, Matches):
        unknown = [key for key in options if key not in READING]
        if unknown:
            raise ConfigError(
                f"data.{unknown[0]} is not an option for reading a table",
                where=WHERE,
                do=f"give one of {', '.join(READING)}",
            )
        reading = ReadOptions(**options) if sigma is None else ReadOptions(**options, sigma=sigma)
        matches = Matches(**match_arguments(matches, reading))
    elif options.keys() - {"same_position"}:
        raise ConfigError(
            f"data.{min(options.keys() - {'same_position'})} is an option for reading, but the "
            "matches have already been read",
            where=WHERE,
            do="give it to bayesdist.read_matches or Matches.from_table",
        )
    else:
        matches = matches.with_star_codes(**options)
    if sigma is None:
        sigma = "by_magnitude" if matches.has_mag and not matches.has_sigma else "columns"
    elif np.ndim(sigma):
        raise InputError(
            f"sigma has {np.size(sigma)} values",
            where=WHERE,
            do="give one number, or the errors of each star as columns sigma_u and sigma_v",
        )
    elif not isinstance(sigma, str):
        sigma = value_in(sigma, matches.unit, "sigma")
    check_sigma(sigma)
    return matches.as_read(sigma), sigma


def _absolute(paths: Any) -> str | list[str]:
    """Names of files that do not depend on the current folder."""
    if isinstance(paths, str | os.PathLike):
        return str(Path(paths).absolute())
    return [str(Path(path).absolute()) for path in paths]


def _in(value: Any, unit: str, what: str) -> float | None:
    return None if value is None else value_in(value, unit, what)


def _pixels(pair: Any, what: str) -> Any:
    """Pair of numbers without a unit; the pixel is the only unit allowed."""
    if pair is not None and (isinstance(pair, str) or np.shape(pair) != (2,)):
        raise InputError(
            f"{what} is {pair!r}",
            where=WHERE,
            do=f"give two numbers of pixels along x and y, as in {what}=(2048, 1024)",
        )
    has_unit = hasattr(pair, "unit")
    if isinstance(pair, list | tuple):
        has_unit = any(hasattr(value, "unit") for value in pair)
    return values_in(pair, "pix", what).tolist() if has_unit else pair


def _drift(time: TimeDependence) -> Settings:
    if not isinstance(time, TimeDependence):
        raise InputError(
            f"time is {time!r}", where=WHERE, do="give bayesdist.TimeDependence(terms, epoch0)"
        )
    return {"epoch0": list(time.epoch0), "terms": list(time.terms), "breaks": list(time.breaks)}


def _chips(chips: Sequence[Chip]) -> Sequence[Chip]:
    """Chips, after a check of their types."""
    if not isinstance(chips, Sequence) or not all(isinstance(chip, Chip) for chip in chips):
        raise InputError(
            f"chips is {chips!r}", where=WHERE, do="give a list of bayesdist.Chip, or size"
        )
    return chips


def _outliers(outliers: OutlierMixture | str, unit: str | None) -> Settings:
    """Section [outliers] of a mixture; `unit` is that of u and v, None if not known yet."""
    if not isinstance(outliers, str | OutlierMixture):
        raise InputError(
            f"outliers is {outliers!r}",
            where=WHERE,
            do="give 'gaussian', 'uniform', 'none' or bayesdist.OutlierMixture(...)",
        )
    if isinstance(outliers, str):
        return {} if outliers == "gaussian" else {"model": outliers}
    if unit is not None:
        outliers = outliers.in_unit(unit)
    section = {field.name: getattr(outliers, field.name) for field in fields(outliers)}
    jitter = section["jitter"]
    return section | {"jitter": "fit" if jitter is None else jitter}


def _budget(
    catalogue: Catalogue | None, terms: Sequence[UserTerm], unit: str | None
) -> list[Settings]:
    """[[budget]] rows of the errors that the user states; `unit` is that of u, v if known."""
    rows = [] if catalogue is None or not catalogue.sigma else [catalogue.budget_row()]
    if isinstance(terms, UserTerm):
        terms = [terms]
    if not isinstance(terms, Sequence):
        raise InputError(f"terms is {terms!r}", where=WHERE, do="give a list of bayesdist.UserTerm")
    for term in terms:
        if not isinstance(term, UserTerm):
            raise InputError(
                f"a term is a {type(term).__name__}",
                where="terms",
                do="give bayesdist.UserTerm, or use bayesdist.error_budget for terms of your own",
            )
        names = "name kind sigma_u sigma_v unit source included_in_scatter".split()
        row = {key: getattr(term, key) for key in names} | {"unit": term.unit or unit}
        if row["unit"] is None:
            raise InputError(
                f"the unit of {term.name!r} is not stated, and the matches have not been read yet",
                where="terms",
                do='give UserTerm a unit, such as unit="arcsec"',
            )
        rows.append(row)
    return rows


def _requirement_block(requirement: Requirement) -> Settings:
    block = {key: getattr(requirement, key) for key in RequirementBlock.model_fields}
    return block | {"unit": requirement.unit or None}


def _merged(configured: Settings, settings: Mapping[str, Any]) -> Settings:
    """Merge the user's settings into the configuration, and drop sections without content."""
    out = _plain(configured)
    for key, section in _plain(settings).items():
        existing = out.get(key) or {}
        if not isinstance(section, Mapping):
            if existing:
                raise _given_twice(key)
            out[key] = section
            continue
        for name, value in section.items():
            old_value = existing.get(name, value)
            if old_value != value and old_value != DEFAULTS.get(f"{key}.{name}"):
                raise _given_twice(f"{key}.{name}")
        out[key] = {**existing, **section}
    return {key: value for key, value in out.items() if value not in ({}, [])}


def _given_twice(key: str) -> ConfigError:
    return ConfigError(
        "is given both as an argument and in settings", where=f"{WHERE}: {key}", do="give it once"
    )


def _plain(tree: Any, key: str = "") -> Any:
    """Convert a tree of values to TOML values and drop None; `key` is its dotted key."""
    if isinstance(tree, Mapping):
        for name in tree:
            if not isinstance(name, str):
                raise _no_value(name, key)
        dotted = {name: f"{key}.{name}" if key else name for name in tree}
        return {
            name: _plain(value, dotted[name]) for name, value in tree.items() if value is not None
        }
    if isinstance(tree, list | tuple):
        return [_plain(value, key) for value in tree]
    if hasattr(tree, "unit"):
        raise ConfigError(
            f"{tree} has a unit, which the configuration cannot hold",
            where=f"{WHERE}: {key}",
            do="give the number in the unit that docs/configuration.md states; lengths of an "
            "OutlierMixture may have units if the stars have already been read",
        )
    if isinstance(tree, np.ndarray | np.generic):
        return tree.tolist()
    if isinstance(tree, Path):
        return str(tree)
    if not isinstance(tree, str | int | float | date | time_of_day):
        raise _no_value(tree, key)
    return tree


def _no_value(value: Any, key: str) -> ConfigError:
    return ConfigError(
        f"{value!r} cannot be stored in TOML",
        where=f"{WHERE}: {key}",
        do="give numbers, strings, lists and mappings",
    )
