"""Fit of new exposures of a campaign, to test whether its release still describes them."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from bayesdist.app.artefacts.stored_fit import load_errors
from bayesdist.app.config import Config
from bayesdist.app.run import Run
from bayesdist.app.store.made_from import input_name
from bayesdist.app.store.rundir import PAIRS, RunDirectory, part_files
from bayesdist.data import Matches, read_matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.compare.monitoring import NewFit, fit_new, with_star_errors_of
from bayesdist.infer.solution.linear import Rejection
from bayesdist.kinds.campaign.config import CampaignConfig
from bayesdist.kinds.campaign.parts import ExposureScatter


def fit_new_exposures(release: Run, new: Path) -> tuple[Matches, NewFit, tuple[str, ...]]:
    """Fit new exposures of a campaign, with deviations drawn from the scatter of the release.

    The catalogue error of a star, which is common to all its exposures, is included.  If the
    release has the same catalogue, the effect of that error on the release is taken into account.

    Parameters
    ----------
    release : Run
    new : Path
        Run directory of a campaign with completed stage 'match', or a file or folder of pairs as
        stored in a run.  Star lists must be matched first.

    Returns
    -------
    Matches
        Pairs with errors, and with pixels corrected by the look-up tables of the release.
    NewFit
        Their fit.
    tuple of str
        Exposures that are left out because the release was made from them.

    Raises
    ------
    InputError
        If pairs have no epochs, are in another filter or unit than the release, or are all of
        exposures that the release was made from, or if star lists are not matched yet.
    """
    run = RunDirectory(new) if (new / "run.json").exists() else None
    released, config = release.solution, release.config
    pairs = _pairs(run, new, released.model.unit)
    if not pairs.has_epoch:
        raise InputError("has no epochs", where=str(new), do="give a column 'epoch'")
    _refuse_other_filters(release.config, pairs, ", ".join(pairs.sources))
    is_released = np.isin(pairs.exposure_names, released.model.exposures)
    left_out = tuple(np.asarray(pairs.exposure_names)[is_released].tolist())
    fresh = ~is_released[pairs.exposure]
    if not fresh.any():
        raise InputError(
            f"all of {len(left_out)} exposures were used to make the release",
            where=str(new),
            do="give pairs of other exposures",
        )
    pairs = pairs.select(fresh)
    pairs = pairs.with_exposure_names(pairs.exposures)
    placed, errors = release.as_placed(pairs), release.errors.by_magnitude
    if run is not None and "fit" in run.record.artefacts:
        errors = load_errors(run.path).by_magnitude or errors
    if placed.mag is not None and errors is not None:
        placed = placed.with_errors(errors, in_quadrature=True)
    scatter = release.part(ExposureScatter)
    new_fit = fit_new(
        released,
        placed,
        rejection=Rejection(config.fit.clip_chi2, config.fit.clip_abs),
        compute=config.resources(),
        scatter=dict(zip(scatter.kinds, np.sqrt((scatter.tau**2).mean(axis=0)), strict=True)),
    )
    with_centroids = cast(CampaignConfig, config).campaign.sigma == "columns"
    of_catalogue = _catalogue_errors(pairs, run, with_centroids=with_centroids)
    if of_catalogue is not None:
        is_same = run is not None and _catalogue_of(run) == _catalogue_of(release.directory)
        made_from = (release.fit, release.matches) if is_same else None
        new_fit = with_star_errors_of(of_catalogue, new_fit, placed, made_from)
    return placed, new_fit, left_out


def _pairs(run: RunDirectory | None, new: Path, unit: str) -> Matches:
    """Matched pairs of another run, or of a table."""
    if run is None:
        if new.suffix == ".toml":
            raise InputError(
                "is a configuration with star lists that have to be matched first",
                where=str(new),
                do="give the folder of its 'bayesdist run', or of 'bayesdist stage match'",
            )
        if not new.exists():
            raise InputError("there is no such file", where=str(new), do="check the name")
        pairs = read_matches(new, unit=unit)
    else:
        # pairs of matched stars have no catalogue in common with those of a campaign
        if not isinstance(run.config, CampaignConfig) or not part_files(run / PAIRS):
            raise InputError(
                "is a run without matched pairs of a campaign",
                where=str(run.path),
                do="give one whose stage 'match' has been run, or a table of pairs",
            )
        pairs = read_matches(run / PAIRS, unit=unit)
    return pairs


def _refuse_other_filters(config: Config, pairs: Matches, where: str) -> None:
    mine = cast(CampaignConfig, config).campaign.filter
    other_filters = sorted({name for name in pairs.filter_names if name} - {mine})
    if mine is not None and other_filters:
        raise InputError(
            f"the pairs are in filter {other_filters[0]}, but the release is in {mine}",
            where=where,
            do="give pairs in the filter of the release",
        )


def _catalogue_errors(
    pairs: Matches, run: RunDirectory | None, *, with_centroids: bool
) -> StarErrors | None:
    """Errors of the catalogue by star code; None if there are none.

    `with_centroids` is True if the errors of the pairs include those of the centroids.  Otherwise
    they are the smallest error of each star in its pairs.
    """
    if with_centroids:
        if run is None:
            raise InputError(
                "have errors that include those of the centroids, which do not show the errors of "
                "the catalogue that all exposures of a star have in common",
                where=", ".join(pairs.sources),
                do="give the folder of the run that matched them",
            )
        matched = Run.of(run)
        return matched.kind.star_errors(matched)
    if pairs.star is None or pairs.sigma_u is None or pairs.sigma_v is None or pairs.mag is None:
        return None
    if pairs.rho_uv is not None:
        return StarErrors.contained_in(pairs)
    sigma = np.full((int(pairs.star.max()) + 1, 2), np.inf)
    for axis, values in enumerate((pairs.sigma_u, pairs.sigma_v)):
        np.minimum.at(sigma[:, axis], pairs.star, values)
    return StarErrors(np.where(np.isfinite(sigma), sigma, 0.0))


def _catalogue_of(run: RunDirectory) -> str | None:
    """Hash of the catalogue of a campaign."""
    config, base = cast(CampaignConfig, run.config), Path(run.facts["base"])
    name = input_name(base / config.campaign.catalog, base)
    digest: str | None = run.facts["inputs"].get(name)
    return digest
