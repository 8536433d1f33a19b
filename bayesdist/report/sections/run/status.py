"""Status on top of the report: each criterion with its number and limit, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.assess.requirements.verdict import LEAST_CHI2, scatter_too_small
from bayesdist.report.contents import REPORT
from bayesdist.report.context import Check, ReportInput
from bayesdist.report.numbers import count, number, percent, rounded, with_mas
from bayesdist.report.sections.campaign.checks import campaign_checks
from bayesdist.report.sections.checks import check_cells, structure_check
from bayesdist.report.sections.run.holdout import holdout_checks
from bayesdist.report.sections.run.margins import VERDICT_LEVELS
from bayesdist.report.texttable import TextTable

__all__ = [
    "Verdict",
    "status_checks",
    "status_table",
    "verdict",
]

_PARETO_K = 0.7  # above it importance weights cannot be trusted (Vehtari et al. 2024)
_EFFICIENCY = 0.1
_MCSE = 0.1  # of a posterior sd: adds half a percent to the error of a mean
_MOST_CHI2 = 1.5  # per degree of freedom: quoted errors right within some twenty percent
_LEFT_OUT = 0.2  # of the stars: rejection of more has shaped the result that it was to protect
_CONDITION = 1e8  # leaves half the digits of a double


@dataclass(frozen=True)
class Verdict:
    """Verdict on the run in words; `level` is 'pass', 'warn' or 'fail'."""

    level: str
    headline: str
    sentences: tuple[str, ...]


def status_checks(r: ReportInput) -> dict[str, tuple[Check, ...]]:
    """Criteria by subject; empty groups are left out.

    Groups are 'Held-out truth', 'Campaign', 'Sampling', 'Fit', 'Requirements', 'Products'.
    """
    groups = {
        "Held-out truth": holdout_checks(r.held_out),
        "Campaign": () if r.campaign is None else campaign_checks(r.campaign),
        "Sampling": _sampling_checks(r),
        "Fit": _fit_checks(r),
        "Requirements": _margin_checks(r),
        "Products": tuple(
            Check(f"{p.path}: {c.name}", c.value, c.limit, c.level)
            for p in r.products
            for c in p.checks
            if c.level != "note"
        ),
    }
    return {name: checks for name, checks in groups.items() if checks}


@REPORT.table("status")
def status_table(r: ReportInput) -> TextTable:
    """Table of all criteria with value, limit and outcome."""
    rows = tuple(
        (group, check.name, *check_cells(check))
        for group, checks in status_checks(r).items()
        for check in checks
    )
    heads = ("Group", "Criterion", "Found", "Limit", "Status")
    return TextTable("Status", heads, rows, words=tuple(range(5)), stacked=(2, 3), grouped=True)


def _level(good: bool, bad: str = "fail") -> str:
    return "pass" if good else bad


def _sampling_checks(r: ReportInput) -> tuple[Check, ...]:
    if r.posterior is None:
        return (Check("Posterior", "not sampled", "sampled and converged", "warn"),)
    c = r.posterior.convergence
    D = len(r.posterior.mean)
    sd = np.sqrt(np.diag(r.posterior.cov))
    with np.errstate(divide="ignore", invalid="ignore"):
        mcse = float(np.nanmax(np.where(sd > 0, c.mcse_mean[:D] / sd, 0.0), initial=0.0))
    # advice does not fail by itself: the limits of R-hat and ESS decide
    return (
        Check("Converged", "yes" if c.converged else "NO", "yes", _level(c.converged)),
        Check(
            f"Largest R-hat, {r.posterior.sampler.ensembles} independent ensembles",
            f"{c.rhat_max:.4f}" if np.isfinite(c.rhat_max) else "∞",
            f"at most {c.limits.rhat:g}",
            _level(c.rhat_max <= c.limits.rhat),
        ),
        Check(
            "Smallest bulk effective sample size",
            count(np.floor(c.ess_bulk_min)),
            f"at least {c.limits.ess:g}",
            _level(c.ess_bulk_min >= c.limits.ess),
        ),
        Check(
            "Smallest tail effective sample size",
            count(np.floor(c.ess_tail_min)),
            f"at least {c.limits.ess:g}",
            _level(c.ess_tail_min >= c.limits.ess),
        ),
        Check(
            "Largest Monte-Carlo error of a mean, in posterior sd",
            number(mcse, 2),
            f"at most {_MCSE:g}",
            _level(mcse <= _MCSE, "warn"),
        ),
        Check(
            "Pareto k of the proposal",
            number(c.pareto_k, 2),
            f"at most {_PARETO_K:g}",
            _level(c.pareto_k <= _PARETO_K, "warn"),
        ),
        Check(
            "Importance efficiency of the proposal",
            percent(c.importance_efficiency, 2),
            f"at least {percent(_EFFICIENCY, 2)}",
            _level(c.importance_efficiency >= _EFFICIENCY, "warn"),
        ),
    )


def _fit_checks(r: ReportInput) -> tuple[Check, ...]:
    fit = r.fit
    ratio = fit.chi2 / fit.dof if fit.dof > 0 else float("nan")
    left_out = fit.n_rejected / fit.n_rows
    small = scatter_too_small(fit.chi2, fit.dof)
    structure = (structure_check(r.misfits, fit="the fit"),) if r.misfits else ()
    return (
        Check(
            "Chi-square per degree of freedom, quoted errors",
            number(ratio),
            f"{LEAST_CHI2:g} to {_MOST_CHI2:g}",
            _level(not small and ratio <= _MOST_CHI2, "warn"),
        ),
        Check(
            f"{r.words.things.capitalize()} left out by the {r.words.chooser}",
            percent(left_out),
            f"at most {percent(_LEFT_OUT, 2)}",
            _level(left_out <= _LEFT_OUT, "warn"),
        ),
        Check(
            "Condition number of the scaled normal matrix",
            number(fit.condition, 2),
            f"at most {number(_CONDITION, 1)}",
            _level(fit.condition <= _CONDITION, "warn"),
        ),
        *structure,
    )


def _margin_checks(r: ReportInput) -> tuple[Check, ...]:
    return tuple(
        Check(
            f"{m.requirement.name}: {m.requirement.statistic}, {m.verdict}",
            f"{rounded(m.value, (m.interval[1] - m.interval[0]) / 4)}\u202f{m.unit}, probability"
            f" {number(m.probability_met)}",
            f"at most {m.requirement.limit:g}\u202f{m.unit}, with probability"
            f" {m.requirement.probability:g}",
            VERDICT_LEVELS[m.verdict],
        )
        for m in r.margins
    )


def verdict(r: ReportInput) -> Verdict:
    """Verdict on the run.

    'fail' when the posterior is not converged, a requirement is missed or a product fails its
    check; 'warn' when something is undecided or nothing was sampled.
    """
    sentences = [_margin_sentence(r), _accuracy_sentence(r)]
    failed = [f"{p.path} ({c.name})" for p in r.products for c in p.checks if c.level == "fail"]
    if failed:
        sentences.append(f"Products that fail their own check: {', '.join(failed)}.")
    verdicts = {m.verdict for m in r.margins}
    if r.provisional:
        reasons = r.posterior.convergence.reasons  # type: ignore[union-attr]
        sentences.insert(0, f"Why: {'; '.join(reasons) or 'no reason was recorded'}.")
        return Verdict("fail", "NOT CONVERGED: do not rely on these numbers", tuple(sentences))
    if r.posterior is None:
        headline, level = "Least squares only: no posterior was sampled", "warn"
    else:
        headline, level = "The posterior is converged", "pass"
    if r.warnings:
        sentences[:0] = [f"{text}." for text in r.warnings]
        headline, level = f"{headline}, but read the warnings", _worse(level, "warn")
    if "missed" in verdicts:
        headline, level = f"{headline}; not every requirement is met", "fail"
    elif "undecided" in verdicts:
        headline, level = f"{headline}; not every requirement is decided", _worse(level, "warn")
    elif verdicts:
        headline = f"{headline}; every requirement is met"
    if failed:
        headline, level = f"{headline}; a product fails its check", "fail"
    return Verdict(level, headline, tuple(sentences))


def _worse(a: str, b: str) -> str:
    order = ("pass", "warn", "fail")
    return max(a, b, key=order.index)


def _margin_sentence(r: ReportInput) -> str:
    if not r.margins:
        return "No requirement was stated."
    by_verdict: dict[str, list[str]] = {}
    for m in r.margins:
        by_verdict.setdefault(m.verdict, []).append(m.requirement.name)
    parts = [
        f"{len(by_verdict[v])} {v} ({', '.join(by_verdict[v])})"
        for v in ("met", "missed", "undecided")
        if v in by_verdict
    ]
    return f"Requirements: {'; '.join(parts)}."


def _accuracy_sentence(r: ReportInput) -> str:
    whose = "posterior" if r.posterior is not None else "formal"
    if r.provisional:
        whose = f"provisional {whose}"
    worst = max(r.chips, key=lambda c: c.best_map.radius_max)
    best = worst.best_map
    median = float(np.median(np.concatenate([c.best_map.radius.ravel() for c in r.chips])))
    x, y = best.position_of_max
    text = (
        f"The {whose} uncertainty of the distortion (radial, 1 σ) is"
        f" {with_mas(median, r.unit, r.scale_mas)} at the median"
        f" place and at most {with_mas(best.radius_max, r.unit, r.scale_mas)},"
        f" at pixel ({x:.0f}, {y:.0f}){r.on_chip(worst.chip)}"
        f"{_with_shift(r)}"
    )
    if r.budget is None:
        return f"{text}."
    total = r.budget.rows()[-1]["radial"]
    with_budget = with_mas(total, r.budget.unit, r.scale_mas)
    whom = (
        ""
        if r.campaign is None
        else " for a new exposure whose shift and rotation are fitted by whoever uses it"
    )
    return f"{text}; with all terms of the budget the rms over the detector is {with_budget}{whom}."


def _with_shift(r: ReportInput) -> str:
    """Words on the part of a common shift and rotation in the errors of positions."""
    if r.selfcal is not None:
        return ", in the gauge of the solution"
    return ", shift and rotation included" if r.fit.model.n_frame else ""
