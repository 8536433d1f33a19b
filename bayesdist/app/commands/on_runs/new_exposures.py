"""New exposures of a campaign, as `bayesdist monitor` confronts a release with them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import Fitted, load_errors, required
from bayesdist.app.store.made_from import input_name
from bayesdist.app.store.rundir import PAIRS, RunDirectory, part_files
from bayesdist.data import Matches, read_matches
from bayesdist.errors import InputError
from bayesdist.infer import Posterior
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.compare.monitoring import NewFit, fit_new, with_star_errors_of
from bayesdist.infer.linear import Rejection


@dataclass(frozen=True, eq=False)
class NewExposures:
    """Pairs of exposures that a release has not seen, and what is known of them."""

    released: Posterior  # with the errors of the catalogue, and those that its stars share
    matches: Matches  # at the pixels that the release's tables have corrected, with errors
    # of the catalogue; None where stars have no codes, or pairs no errors of it
    errors: StarErrors | None
    same_catalogue: bool  # whether it is that of the release, with the same codes of stars
    left_out: tuple[str, ...]  # exposures that the release has been made from


def read_new_exposures(
    release: RunDirectory, released: Posterior, fitted: Fitted, new: Path
) -> NewExposures:
    """Matched pairs of new exposures: those of another run, or a table.

    `new`: run directory of a campaign whose stage 'match' has been run, or pairs in a file or
    folder as a run keeps them; star lists have to be matched first.
    """
    run = RunDirectory(new) if (new / "run.json").exists() else None
    pairs = _pairs(run, new, released.model.unit)
    where = ", ".join(pairs.sources)
    if not pairs.has_epoch:
        raise InputError("has no epochs", where=str(new), do="give a column 'epoch'")
    _refuse_other_filters(release.config, pairs, where)
    seen = np.isin(pairs.exposure_names, released.model.exposures)
    left_out = tuple(np.asarray(pairs.exposure_names)[seen].tolist())
    fresh = ~seen[pairs.exposure]
    if not fresh.any():
        raise InputError(
            f"all of {len(left_out)} exposures are those that the release was made from",
            where=str(new),
            do="give pairs of other exposures",
        )
    pairs = pairs.select(fresh)
    pairs = pairs.with_exposure_names(pairs.exposures)
    placed, errors = fitted.placed(pairs), fitted.errors.by_magnitude
    if run is not None and "fit" in run.record.artefacts:
        errors = load_errors(run.path).by_magnitude or errors
    if placed.mag is not None and errors is not None:
        placed = placed.with_errors(errors, in_quadrature=True)
    return NewExposures(
        released,
        placed,
        _catalogue_errors(pairs),
        run is not None and _catalogue_of(run) == _catalogue_of(release),
        left_out,
    )


def fit_exposures_of(data: FitData, config: Config, new: NewExposures) -> NewFit:
    """The new exposures fitted by themselves, deviating as those of the release scatter.

    What a star's error in the catalogue does to all its exposures is added, and where the release
    has the same catalogue, what it did to the release is taken into account.
    """
    scatter = required(data.fitted.scatter, "joint fit of exposures")
    found = fit_new(
        new.released,
        new.matches,
        rejection=Rejection(config.fit.clip_chi2, config.fit.clip_abs),
        compute=config.resources(),
        scatter=dict(zip(scatter.kinds, np.sqrt((scatter.tau**2).mean(axis=0)), strict=True)),
    )
    if new.errors is None:
        return found
    released = None
    if new.same_catalogue:
        released = (data.fit, data.stars)
    return with_star_errors_of(new.errors, found, new.matches, released)


def _pairs(run: RunDirectory | None, new: Path, unit: str) -> Matches:
    """Pairs as another run keeps them, or of a table."""
    if run is None:
        if new.suffix == ".toml":
            raise InputError(
                "is a configuration, whose star lists would have to be matched first",
                where=str(new),
                do="give the folder of its 'bayesdist run', or of 'bayesdist stage match'",
            )
        if not new.exists():
            raise InputError("there is no such file", where=str(new), do="check the name")
        found = read_matches(new, unit=unit)
    else:
        if run.config.campaign is None or not part_files(run / PAIRS):
            raise InputError(
                "is a run without matched pairs of a campaign",
                where=str(run.path),
                do="give one whose stage 'match' has been run, or a table of pairs",
            )
        found = read_matches(run / PAIRS, unit=unit)
    return found


def _refuse_other_filters(config: Config, pairs: Matches, where: str) -> None:
    mine = None if config.campaign is None else config.campaign.filter
    others = sorted({name for name in pairs.filter_names if name} - {mine})
    if mine is not None and others:
        raise InputError(
            f"the pairs are in filter {others[0]}, and the release is in {mine}",
            where=where,
            do="give pairs in the filter of the release",
        )


def _catalogue_errors(pairs: Matches) -> StarErrors | None:
    """The least error that each star of the catalogue has in its pairs, by code of the star."""
    if pairs.star is None or pairs.sigma_u is None or pairs.sigma_v is None or pairs.mag is None:
        return None
    sigma = np.full((int(pairs.star.max()) + 1, 2), np.inf)
    for axis, values in enumerate((pairs.sigma_u, pairs.sigma_v)):
        np.minimum.at(sigma[:, axis], pairs.star, values)
    return StarErrors(np.where(np.isfinite(sigma), sigma, 0.0))


def _catalogue_of(run: RunDirectory) -> str | None:
    """Hash of a run's catalogue."""
    block, base = run.config.campaign, Path(run.facts["base"])
    if block is None:
        return None
    found: str | None = run.facts["inputs"].get(input_name(base / block.catalog, base))
    return found
