"""Linear terms of a campaign, and the shift between its chips, as in ACS ISR 2015-06.

ACS ISR 2015-06, Section 4.4.1, adopts one mean B_1 of WFC1 before SM4 and another after it.  A
drift in the model has a rate, and a step at each break, for every term and chip.  Those that are
not wanted are held at zero by a prior much narrower than any measurement error.

The terms of single exposures scatter about those of the model, and are a series in time.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import Table

from bayesdist.app.parts import Part
from bayesdist.app.run import Run
from bayesdist.app.store.record import attributes, write_table
from bayesdist.errors import DegenerateError
from bayesdist.infer import GaussianPriors, Posterior
from bayesdist.infer.exposures.hierarchy import Settling
from bayesdist.infer.solution.solution import Solution, TransformedSolution
from bayesdist.infer.solution.transforms import lines, reference_gauge, without_frames
from bayesdist.kinds.campaign.series import (
    Series,
    SeriesPosterior,
    TrendModel,
    describe,
    fit_series,
)
from bayesdist.model import DistortionModel, TimeDependence
from bayesdist.utils.arrays import Float

CONSTANTS = (("u", 0, 0), ("v", 0, 0))
SIGMA_HELD = 1e-6  # pixels, and pixels per year

log = logging.getLogger("bayesdist")

N_EPOCHS = 25  # epochs at which the drift is tabulated
MIN_EXPOSURES = 8  # fewest exposures for a statement about time


def with_gap(model: DistortionModel) -> DistortionModel:
    """Model with steps of the constant terms, if it has several chips and breaks."""
    time = model.time
    if time is None or not time.breaks or len(model.chips) == 1:
        return model
    terms = (*time.terms, *(t for t in CONSTANTS if t not in time.terms))
    return replace(model, time=replace(time, terms=terms))


def gap_priors(
    model: DistortionModel, asked: TimeDependence | None, pixel: float
) -> GaussianPriors:
    """Priors that restrict the drift of constant terms to steps of all chips except the first.

    The first chip is the reference chip: its constant terms are the pointing of the exposures.

    Parameters
    ----------
    model : DistortionModel
    asked : TimeDependence or None
        Configured drift.  Constant terms among its terms keep their rates.
    pixel : float
        Pixel size in the unit of u, v.
    """
    reference, named = model.chips[0].number, () if asked is None else asked.terms
    held = {
        p.name: (0.0, SIGMA_HELD * pixel)
        for p in model.parameters
        if p.kind == "tdd"
        and (p.axis, p.i, p.j) in CONSTANTS
        and (p.chip == reference or (".rate" in p.name and (p.axis, p.i, p.j) not in named))
    }
    return GaussianPriors.of(model, held)


FIXED = ("A_1", "B_1", "A_3")  # fixed by the gauge, on the reference chip


def line_sections(solution: Solution, chip: int) -> dict[str, object]:
    """Sections 'gauge' and 'lines' of summary.json: alpha and beta of each term."""
    view = reference_gauge(without_frames(solution), chip)
    gauge = attributes(view.gauge, "chip epoch rotation sigma_rotation shift sigma_shift")
    return {"gauge": gauge | {"fixed": FIXED}, "lines": _lines(view)}


def _lines(view: TransformedSolution) -> list[dict[str, object]]:
    """alpha and beta of the joint fit in the reference gauge, as in Tables 1 to 3 of the ISR."""
    time, out = view.model.time, []
    for s, epoch0 in enumerate(() if time is None else time.epoch0):
        for chip in view.model.chips:
            drift = lines(view, s, chip=chip.number)
            for term in dict.fromkeys(label.split(".")[0] for label in drift.labels):
                row: dict[str, object] = {"segment": s, "chip": chip.number, "epoch0": epoch0}
                row["term"] = term
                for part in ("alpha", "beta"):
                    line = drift.select(f"{term}.{part}")
                    row |= {part: float(line.values[0]), f"sigma_{part}": float(line.sigma[0])}
                out.append(row)
    return out


@dataclass(frozen=True, eq=False)
class LinearTermScatter(Part):
    """Scatter of the linear terms of the exposures about those of the model.

    Parameters
    ----------
    kinds : tuple of str
        Names of the k linear terms that scatter.
    tau : ndarray, shape (n, k)
        Posterior draws of the standard deviation of each term.
    offsets : Settling
        Relation between the constant terms of chips and the shifts of single chips.
    """

    title = "joint fit of exposures"
    recorded = is_hierarchy = True

    kinds: tuple[str, ...]
    tau: Float
    offsets: Settling

    def averaged(self, posterior: Posterior, rng: np.random.Generator) -> Posterior:
        """Posterior in which each chip has its mean position over the exposures."""
        tau = self.tau[rng.integers(len(self.tau), size=len(posterior.flat))]
        flat = self.offsets.draws(posterior.flat, tau, rng)
        before, after = posterior.flat.std(axis=0), flat.std(axis=0)
        scale = np.divide(after, before, out=np.ones_like(after), where=before > 0)
        c = posterior.convergence
        scale = np.append(scale, np.ones(len(c.names) - len(scale)))  # hyperparameters come last
        return replace(
            posterior,
            theta=flat.reshape(posterior.theta.shape),
            # the number of effective draws is unchanged, but the draws scatter less
            convergence=replace(c, mcse_mean=c.mcse_mean * scale, mcse_sd=c.mcse_sd * scale),
        )


@dataclass(frozen=True, eq=False)
class ExposuresAlone(Part):
    """Linear terms of the exposures, each fitted without the others."""

    title = "fits of single exposures"
    recorded = True

    series: Series


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
            "lines": _trend_lines(posterior),
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


def _trend_lines(posterior: SeriesPosterior) -> list[dict[str, object]]:
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
