"""Errors of groups of stars in addition to the quoted ones: estimate, summary and sentence."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

from bayesdist.app.config import Config
from bayesdist.data import Matches
from bayesdist.errors import DegenerateError
from bayesdist.infer import GaussianPriors, LinearFit
from bayesdist.infer.catalogue.added_errors import ONE, GroupedErrors, grouped_errors

log = logging.getLogger("bayesdist")

MOST_LISTED = 4  # largest number of groups that are listed individually


def compared_errors(
    config: Config, fit: LinearFit, sample: Matches, priors: GaussianPriors
) -> GroupedErrors | None:
    """Errors added to groups of stars, or a single jitter, from a fit with the quoted errors.

    None if groups are not compared: the errors come from the residuals, the jitter is given or is
    to be a single one, or the match circle has truncated the residuals.
    """
    if not config.compares_jitters or in_circle(sample, config):
        return None
    by = config.outliers.jitter_by
    try:
        return grouped_errors(
            sample,
            fit,
            by="" if by == "auto" else by,
            outliers=config.outliers.model != "none",
            priors=priors,
        )
    except DegenerateError as error:
        log.info("fit: one jitter for all stars: groups are not compared, as %s", error.cause)
        return None


def in_circle(stars: Matches, config: Config) -> bool:
    """True if stars were matched within a known radius of nominal positions that are in the data.

    The likelihood then accounts for this selection.
    """
    if config.begins_with != "fit" or not stars.has_nominal:
        return False
    return config.match_radius(stars.match_radius) is not None


def added_errors_rows(found: GroupedErrors) -> dict[str, Any]:
    """Entry 'added_errors' of the section 'fit' of summary.json."""
    columns = {
        "n": found.n,
        "added": found.sigma,
        "added_error": found.sigma_error,
        "excess": found.excess,
        "variance": found.variance,
        "variance_error": found.error,
    }
    return {
        "grouping": found.grouping,
        "by": found.by,
        "evidence": dict(found.evidence),
        "dispersion": found.dispersion,
        "groups": [
            {"label": label, "axis": axis} | {k: float(v[g, a]) for k, v in columns.items()}
            for g, label in enumerate(found.labels)
            for a, axis in enumerate("uv")
        ],
    }


def grouping_sentence(found: GroupedErrors, unit: str) -> str:
    """Clause about errors in addition to the quoted ones; `unit` is that of u and v."""
    evidence = ", ".join(f"{name} {gain:.3g}" for name, gain in found.evidence.items())
    head = f"ln evidence gained by groups: {evidence}"
    if found.grouping == ONE:
        return f"one jitter for both axes ({head})"
    each, joint = list(_each(found)), ", "
    if len(each) > MOST_LISTED:
        each, joint = [min(each), max(each)], " to "
    sizes = joint.join(
        f"{value:.3g} +- {error:.2g} {unit} {group_name}" for value, error, group_name in each
    )
    return (
        f"the errors beyond the quoted ones differ by {found.grouping}: {sizes} ({head}); what "
        "each has beyond the least was added to the quoted errors, and the jitter is the least"
    )


def _each(found: GroupedErrors) -> Iterator[tuple[float, float, str]]:
    """Added error, its standard error, and the name of the group, for each group and axis."""
    for g, label in enumerate(found.labels):
        of = f"of {found.by} {label}" if found.by else ""
        for a in range(2 if found.by_axis else 1):
            along = f"along {'uv'[a]}" if found.by_axis else ""
            group_name = " ".join(part for part in (along, of) if part)
            yield float(found.sigma[g, a]), float(found.sigma_error[g, a]), group_name
