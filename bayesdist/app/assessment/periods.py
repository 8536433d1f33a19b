"""Comparison of periods: settings, table, and section of summary.json."""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy.table import Table, vstack
from astropy.time import Time

from bayesdist.app.config import Config
from bayesdist.app.run import Run
from bayesdist.app.store.keys import attributes
from bayesdist.assess import convert, pixel_scale_of
from bayesdist.data import Matches
from bayesdist.diagnose.periods import PeriodSettings, TimeVariation, bins_for
from bayesdist.diagnose.residuals.stars import SAMPLE
from bayesdist.errors import InputError

# attributes of the largest difference of two models
POSITION = "largest sigma at chip noise_median noise_95 p_value chi2 dof p_field"


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
