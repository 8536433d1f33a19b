"""Linear terms as a function of time: series of exposures, and predicted drift."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np
from astropy.table import Table

from bayesdist.app.run import Run
from bayesdist.app.store.output import write_table
from bayesdist.errors import DegenerateError
from bayesdist.kinds.campaign.parts import ExposuresAlone
from bayesdist.kinds.campaign.series import (
    Series,
    SeriesPosterior,
    TrendModel,
    describe,
    fit_series,
)

log = logging.getLogger("bayesdist")

N_EPOCHS = 25  # epochs at which the drift is tabulated
MIN_EXPOSURES = 8  # fewest exposures for a statement about time


def write_series_tables(run: Run) -> None:
    """Write series.ecsv and drift.ecsv, and the section 'time_dependence' of summary.json."""
    series, directory = run.part(ExposuresAlone).series, run.directory
    time, seed = run.model.time, run.config.sampler.seed
    if time is None or len(series.names) < MIN_EXPOSURES:
        return
    trend = TrendModel("lines" if time.breaks else "line", time.breaks, reference=time.epoch0)
    try:
        posterior = fit_series(series, trend, seed=seed)
    except DegenerateError as error:
        if run.config.has_free_rates:
            raise
        log.info("diagnose: no drift from these exposures alone: %s", error.cause)
        return
    write_table(_exposures(series, posterior), directory / "series.ecsv")
    write_table(_predictions(posterior), directory / "drift.ecsv")
    outlying = [
        name for name, p in zip(series.names, posterior.outlier_probability, strict=True) if p > 0.5
    ]
    verdicts = [_verdict(series, k, time.breaks, seed) for k in range(len(series.coefficients))]
    scatter = posterior.scatter_sigma.mean(axis=0).tolist()
    directory.summarise(
        time_dependence={
            "converged": posterior.convergence.converged,
            "lines": _lines(posterior),
            "scatter": dict(zip(series.coefficients, scatter, strict=True)),
            "outlying_exposures": outlying,
            "warnings": list(_disagreements(run.fit_facts["exposures_outlying"], outlying)),
            "breaks": _changes(posterior),
            "verdicts": verdicts,
        }
    )
    for row in verdicts:
        log.info("diagnose: %s: %s", row["term"], row["claim"])


def _disagreements(known: Sequence[str], outlying: Sequence[str]) -> Iterator[str]:
    """Clause on exposures that are outliers when fitted alone, but not in the joint fit."""
    missed = [name for name in outlying if name not in known]
    if missed:
        yield (
            f"{', '.join(missed)}, each fitted alone, {'lie' if len(missed) > 1 else 'lies'} off "
            "the trend of the others, and the joint fit counts them as scatter"
        )


def _verdict(series: Series, k: int, breaks: tuple[float, ...], seed: int) -> dict[str, object]:
    """Trend that describes one term best, judged by held-out exposures."""
    verdict = describe(series.only(series.coefficients[k]), breaks=breaks, seed=seed)
    return {"term": series.coefficients[k], "claim": verdict.claim, "text": verdict.text}


def _lines(posterior: SeriesPosterior) -> list[dict[str, object]]:
    out: list[dict[str, object]] = []
    for s, epoch0 in enumerate(posterior.reference):
        for k, name in enumerate(posterior.series.coefficients):
            row: dict[str, object] = {"segment": s, "term": name, "epoch0": float(epoch0)}
            for part in ("alpha", "beta"):
                draws = getattr(posterior, part)[:, s, k]
                row |= {part: float(draws.mean()), f"sigma_{part}": float(draws.std(ddof=1))}
            out.append(row)
    return out


def _changes(posterior: SeriesPosterior) -> list[dict[str, object]]:
    out: list[dict[str, object]] = []
    for number, date in enumerate(posterior.trend.breaks):
        changes = dict(zip(("step", "slope_change"), posterior.change(number), strict=True))
        for k, name in enumerate(posterior.series.coefficients):
            row: dict[str, object] = {"break": date, "term": name}
            for part, change in changes.items():
                row |= {part: float(change.value[k]), f"sigma_{part}": float(change.sigma[k])}
            out.append(row)
    return out


def _exposures(series: Series, posterior: SeriesPosterior) -> Table:
    columns: dict[str, object] = {"exposure": list(series.names), "epoch": series.epoch}
    sigma = np.sqrt(np.maximum(np.einsum("ekk->ek", series.cov), 0.0))
    for k, name in enumerate(series.coefficients):
        columns[name] = series.values[:, k]
        columns[f"sigma_{name}"] = sigma[:, k]
    columns["outlier_probability"] = posterior.outlier_probability
    return Table(columns)


def _predictions(posterior: SeriesPosterior) -> Table:
    first, last = posterior.series.span
    prediction = posterior.predict(np.linspace(first, last, N_EPOCHS))
    columns: dict[str, object] = {"epoch": prediction.epoch}
    for k, name in enumerate(posterior.series.coefficients):
        columns[name] = prediction.mean[:, k]
        columns[f"sigma_{name}"] = prediction.sigma[:, k]
        columns[f"sigma_new_{name}"] = prediction.sigma_new[:, k]
    return Table(columns)
