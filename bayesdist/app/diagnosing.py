"""Diagnostics of the solution of a run, including held-out stars and the comparison of periods."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from astropy.table import Table, vstack
from astropy.time import Time

from bayesdist.app.config import Config
from bayesdist.app.evaluating import assessment_rng
from bayesdist.app.run import Run
from bayesdist.app.stars import in_circle
from bayesdist.app.store.record import attributes
from bayesdist.app.store.summary import CoverageRow, HoldoutSection, HoldoutTest
from bayesdist.assess import convert, pixel_scale_of
from bayesdist.assess.domain import WHOLE, in_region
from bayesdist.data import Matches, ReferenceCatalog
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose_fit, diagnose_posterior
from bayesdist.diagnose.holdout.validation import HoldoutValidation, holdout_validation
from bayesdist.diagnose.periods import PeriodSettings, TimeVariation, bins_for
from bayesdist.diagnose.residuals.stars import SAMPLE
from bayesdist.errors import InputError
from bayesdist.infer import Posterior

# attributes of the largest difference of two models
POSITION = "largest sigma at chip noise_median noise_95 p_value chi2 dof p_field"


def diagnostics_of_run(run: Run) -> Diagnostics:
    """Diagnostics of a run: of its posterior and of the held-out stars, or of the fit alone."""
    if not run.is_sampled:
        return _from_residuals(run, None)
    config, kind = run.config, run.kind
    questions = kind.questions(run)
    diagnostics = diagnose_posterior(
        _from_residuals(run, run.posterior),
        run.fit,
        run.posterior,
        run.matches,
        run.shards,
        rng=assessment_rng(config),
        tested=_with_motions(run.sample, run.catalogue),
        discrepancy=config.discrepancy.priors(),
        priors=run.priors,
        match_radius=config.match_radius(run.stars.match_radius),
        structure=questions.structure,
        exposures=questions.exposures,
        settling=questions.settling,
        catalogue=kind.star_errors(run),
        eliminated=questions.eliminated,
        periods=period_settings(run),
    )
    diagnostics = replace(diagnostics, overlap=kind.overlap(run))
    if run.held_out is None:
        return diagnostics
    predictive = kind.predictive(run.having(diagnostics=diagnostics))
    held = holdout_validation(predictive, run.held_out, whole=run.held_exposures)
    return replace(diagnostics, holdout=held)


def _from_residuals(run: Run, posterior: Posterior | None) -> Diagnostics:
    """Diagnostics from residuals, of a posterior or of a fit alone."""
    config, kind = run.config, run.kind
    questions = kind.questions(run)
    diagnostics = diagnose_fit(
        run.fit,
        posterior,
        run.matches,
        run.shards,
        run.sample,
        eliminated=questions.eliminated,
        centroid=questions.centroid,
        known=run.priors.joint is not None,
        match_radius=config.match_radius(run.stars.match_radius),
        in_circle=in_circle(run.stars, config),
        matched_before=config.begins_with == "fit",
        error_scale=run.error_scale_sentence,
        rows=kind.words.rows,
        chooser=kind.words.rejection,
    )
    if config.field == WHOLE:
        return diagnostics
    inside = partial(in_region, config.field, run.model.chips[0].size)
    return replace(
        diagnostics, coverage=tuple(coverage.within(inside) for coverage in diagnostics.coverage)
    )


def _with_motions(stars: Matches, catalogue: ReferenceCatalog | None) -> Matches:
    """Stars with their proper motions and errors of these, if the catalogue has them."""
    if catalogue is None or stars.star is None:
        return stars
    names = ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v")
    motions = catalogue.by_code(*names)
    if motions is None:
        return stars
    return stars.with_columns(**dict(zip(names, motions[stars.star].T, strict=True)))


def holdout_table(found: HoldoutValidation) -> Table:
    """Table of all tests, the most significant first."""
    names = "name part is_omnibus where n value expected p_value p_corrected limit".split()
    table = Table({name: [getattr(t, name) for t in found.tests] for name in names})
    table["lo95"], table["hi95"] = np.array([t.interval for t in found.tests]).T
    table["limit"].description = "of tails, in sigma; scatter of deviations"
    table["value"].description = (
        f"offset: {found.unit}; spread: factor on the predicted errors; distribution: largest "
        "difference of distribution functions; tails: fraction of stars; deviation: in its own unit"
    )
    table.meta = {
        "verdict": found.verdict,
        "n": found.n,
        "n_excluded": found.n_left_out,
        "exposures": list(found.exposures),
        "p_corrected": "Holm 1979, over all tests of this table",
    }
    return table


def holdout_summary(found: HoldoutValidation) -> dict[str, Any]:
    """Section 'holdout' of summary.json."""
    return HoldoutSection.row(
        found,
        n_excluded=found.n_left_out,
        coverage=[CoverageRow.row(row, sigma=row.level) for row in found.coverage],
        tests=[HoldoutTest.row(row) for row in found.tests],
    )


def check_pairs(raw: Matches, config: Config) -> dict[str, int]:
    """Approximate number of pairs in each period, from the epochs of all or a sample.

    Empty if there are no periods.  Raises InputError for pairs without epochs and for a period
    without pairs, before anything is sampled.
    """
    spans = config.spans()
    if not spans:
        return {}
    files = ", ".join(raw.sources)
    if not raw.has_epoch:
        raise InputError(
            "[periods] needs an epoch for every pair", where=files, do="map column 'epoch'"
        )
    subset = raw if raw.in_memory else raw.sample(SAMPLE)
    epoch = subset.column("epoch")
    share = len(raw) / len(subset)
    out = {}
    for name, (start, stop) in spans.items():
        n = int(((epoch >= start) & (epoch < stop)).sum())
        if not n:
            years = [epoch.min(), epoch.max(), start, stop]
            first, last, begin, end = Time(years, format="decimalyear", scale="tt").mjd
            raise InputError(
                f"the period about MJD {name} has no pairs: the pairs span MJD {first:.3f} to "
                f"{last:.3f}, and it from {begin:.3f} to {end:.3f}",
                where=files,
                do="correct periods.centres and periods.days, or leave the period out",
            )
        out[name] = round(n * share)
    return out


def period_settings(run: Run) -> PeriodSettings | None:
    """Settings of the comparison of periods; None if none are configured."""
    config, fit = run.config, run.fit
    if config.periods is None:
        return None
    fewest = min(check_pairs(run.placed, config).values())
    scale = pixel_scale_of(fit, scale_mas=config.detector.scale_mas)
    angle = fit.unit != "pix" or scale is not None
    limits = [
        convert(r.limit, r.unit, fit.unit, scale, where=f"requirement {r.name!r}")
        for r in (requirement.in_unit_of(fit.unit) for requirement in config.requirements())
    ]
    return PeriodSettings(
        config.spans(),
        bins=bins_for(fewest // len(fit.model.chips)),
        radial_weight=config.fit.radial_weight,
        tolerance=min(limits, default=None),
        unit_arcsec=convert(1.0, fit.unit, "arcsec", scale) if angle else None,
    )


def periods_table(found: TimeVariation) -> Table:
    """Differences of all coefficients: each period from the combined model, and last from first."""
    comparison = found.comparison
    parts = []
    for name, against in (*((n, None) for n in comparison.names), (found.last, found.first)):
        change, monomial = (
            comparison.coefficients(name, against, monomial=m) for m in (False, True)
        )
        n = len(change.names)
        parts.append(
            Table(
                {
                    "period": [name] * n,
                    "against": [against or "combined"] * n,
                    "name": list(change.names),
                    "difference": change.difference,
                    "sigma": change.sigma,
                    "z": change.z,
                    "p_value": change.p_value,
                    "monomial_difference": monomial.difference,
                    "monomial_sigma": monomial.sigma,
                }
            )
        )
    out = vstack(parts)
    chi2, dof, p = comparison.homogeneity
    out.meta = {
        "verdict": found.verdict,
        "chi2": chi2,
        "dof": dof,
        "p_value": p,
        "error_scale": comparison.error_scale,
        "unit": comparison.model.unit,
    }
    return out


def periods_summary(found: TimeVariation) -> dict[str, Any]:
    """Section 'periods' of summary.json."""
    comparison = found.comparison
    chi2, dof, p = comparison.homogeneity
    rows = [
        {
            "name": name,
            "start": found.spans[name][0],
            "stop": found.spans[name][1],
            "n_pairs": n,
            **attributes(found.changes[name], POSITION),
            "z_max": float(np.abs(comparison.coefficients(name).z).max()),
        }
        for name, n in zip(comparison.names, comparison.counts, strict=True)
    ]
    numbers = [chip.number for chip in comparison.model.chips]
    return {
        **attributes(found, "verdict significant tolerance n_outside n_repeated"),
        "pattern": found.pattern_sentence,
        "unit": comparison.model.unit,
        "error_scale": comparison.error_scale,
        "chi2": chi2,
        "dof": dof,
        "p_value": p,
        "periods": rows,
        "first_vs_last": {
            "period": found.last,
            "against": found.first,
            **attributes(found.ends, POSITION),
        },
        "residuals": [
            {"chip": number, "unit": table.unit, "rows": [_statistics(row) for row in table.rows]}
            for table, number in zip(found.residuals, numbers, strict=True)
        ],
        "patterns": [
            attributes(pattern, "period axis p_value rms correlation n_bins") | {"chip": number}
            for several, number in zip(found.patterns, numbers, strict=True)
            for pattern in several
        ],
    }


def _statistics(row: Any) -> dict[str, Any]:
    return {
        **attributes(row, "label n_bins"),
        **row.value,
        "sigma_error": row.error["sigma"],
        "sigma_noise_free": row.noise_free["sigma"],
    }
