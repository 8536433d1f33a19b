"""New exposures of a campaign, as `bayesdist monitor` confronts a release with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.kinds.fitted import load_errors, required
from bayesdist.app.results import Results
from bayesdist.app.store.made_from import input_name
from bayesdist.app.store.rundir import PAIRS, RunDirectory, part_files
from bayesdist.data import Matches, read_matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.compare.monitoring import NewFit, fit_new, with_star_errors_of
from bayesdist.infer.solution.linear import Rejection


def fit_new_exposures(release: Results, new: Path) -> tuple[Matches, NewFit, tuple[str, ...]]:
    """New exposures of a campaign by themselves, deviating as those of the release scatter.

    `new`: run directory of a campaign whose stage 'match' has been run, or pairs in a file or
    folder as a run keeps them; star lists have to be matched first.  What a star's error in the
    catalogue does to all its exposures is added, and where the release has the same catalogue, what
    it did to the release is taken into account.

    Result: pairs with errors, at the pixels that the release's tables have corrected; their fit;
    and exposures that are left out, as the release has been made from them.
    """
    run = RunDirectory(new) if (new / "run.json").exists() else None
    released, fitted, config = release.solution, release.fitted, release.config
    pairs = _pairs(run, new, released.model.unit)
    if not pairs.has_epoch:
        raise InputError("has no epochs", where=str(new), do="give a column 'epoch'")
    _refuse_other_filters(config, pairs, ", ".join(pairs.sources))
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
    scatter = required(fitted.scatter, "joint fit of exposures")
    found = fit_new(
        released,
        placed,
        rejection=Rejection(config.fit.clip_chi2, config.fit.clip_abs),
        compute=config.resources(),
        scatter=dict(zip(scatter.kinds, np.sqrt((scatter.tau**2).mean(axis=0)), strict=True)),
    )
    of_catalogue = _catalogue_errors(pairs)
    if of_catalogue is not None:
        same = run is not None and _catalogue_of(run) == _catalogue_of(release.run)
        made_from = (release.data.fit, release.data.stars) if same else None
        found = with_star_errors_of(of_catalogue, found, placed, made_from)
    return placed, found, left_out


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
