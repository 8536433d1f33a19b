"""Stage 1 of a campaign: tables, errors, every exposure alone, and all of them jointly."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.app.campaign.gap import gap_priors, with_gap
from bayesdist.app.campaign.lines import FIXED, summarise_lines
from bayesdist.app.campaign.session import HIERARCHY, CampaignSession
from bayesdist.app.campaign.tables import fit_tables, tables_summary
from bayesdist.app.session import ERROR_COLUMNS, write_table
from bayesdist.app.stages.fit import summarise_fit
from bayesdist.data import MatchTable, centroid_errors
from bayesdist.infer import load, save_fit
from bayesdist.infer.exposures.alone import ExposureSolutions, fit_exposures
from bayesdist.infer.exposures.hierarchy import HierarchicalFit, fit_hierarchical, held_in_reference
from bayesdist.infer.exposures.trends import trend_p_values
from bayesdist.infer.linear import Rejection
from bayesdist.infer.sampler.checkpoints import write_arrays
from bayesdist.infer.series import Series
from bayesdist.limits import TREND
from bayesdist.model import Chip
from bayesdist.model.frames import RIGID

__all__ = ["run_campaign_fit"]

Float = NDArray[np.float64]

log = logging.getLogger("bayesdist")

SERIES = ("A_2", "A_3", "B_1", "B_2", "B_3")


def run_campaign_fit(session: CampaignSession) -> None:
    tables = fit_tables(session)
    _fit_errors(session)
    matches = session.matches
    assert isinstance(matches, MatchTable)
    rejection = Rejection(session.config.fit.clip_chi2, session.config.fit.clip_abs)
    number = session.reference_chip
    asked = session.config.time()
    drifting = with_gap(replace(session.plain_model, time=asked))
    model = replace(held_in_reference(matches, drifting, number), chip_deviations=True)
    shards = load(model, matches, session.config.resources())
    pixel = (session.scale_arcsec or session.unit_arcsec) / session.unit_arcsec
    joint = fit_hierarchical(
        shards,
        model,
        priors=session.rate_priors(model) or gap_priors(model, asked, pixel),
        pixel=pixel,
        seed=session.config.sampler.seed,
        rejection=rejection,
    )
    shards.close()
    save_fit(joint.fit, session.run / "fit.nc")
    write_arrays(
        session.run / HIERARCHY,
        "",
        {
            "kinds": np.array([kind.encode() for kind in joint.scatter.kinds]),
            "tau_draws": joint.tau_draws,
            "prior_centre": joint.priors.centre,
            "prior_precision": joint.priors.precision,
            **joint.settling.to_arrays(),
        },
    )
    session.fit_changed()
    alone = fit_exposures(matches, session.plain_model, chip=number, skip=True, rejection=rejection)
    session.keep_terms(_series(alone, model.chips[0]))
    summarise_fit(session, joint.fit)
    summarise_lines(session, joint)
    session.run.summarise(
        tables=tables_summary(session, tables),
        scatter={name: _scatter(joint, name) for name in joint.tau},
        deviations={"warnings": _trends(joint, matches)},
        exposures_skipped=dict(alone.skipped),
        exposures_outlying=list(joint.outlying),
    )
    log.info(
        "fit: scatter of the exposures %s",
        ", ".join(f"{name} {tau:.2g}" for name, tau in joint.tau.items()),
    )


def _fit_errors(session: CampaignSession) -> None:
    """Errors of the centroids by magnitude, from the scatter that the tables leave."""
    pairs = session.raw_matches
    assert isinstance(pairs, MatchTable)
    _, _, total = session.errors_by_magnitude(pairs)
    errors = centroid_errors(pairs, total)
    table = Table({name: getattr(errors, name) for name in ERROR_COLUMNS})
    write_table(table, session.run / "magnitude_errors.ecsv")
    session.errors_changed()


def _series(alone: ExposureSolutions, reference: Chip) -> Series:
    """Linear terms of all chips, and the constant in v, without those that the gauge fixes."""
    fixed = {f"{prefix}{term}" for prefix in ("", f"{reference.name}.") for term in FIXED}
    labels = [s for s in alone.labels if s.split(".")[-1] in SERIES and s not in fixed]
    epoch, values, cov = alone.series(*labels)
    return Series(epoch, values, cov, tuple(labels), alone.names, source="exposures")


def _trends(joint: HierarchicalFit, matches: MatchTable) -> list[str]:
    """Deviations that go with time although they are taken to scatter, each as a clause.

    Those of scale and shears: how the chips move against each other has a test of its own
    (`bayesdist.diagnose.score.gap`).
    """
    model = joint.model
    assert matches.epoch is not None
    names = np.array(model.exposures)
    code = {name: k for k, name in enumerate(matches.exposure_names)}
    first = {int(k): float(matches.epoch[row]) for k, row in _first_rows(matches)}
    kept = [k for k, name in enumerate(names) if name not in joint.outlying]
    epoch = np.array([first[code[str(names[k])]] for k in kept])
    values = joint.fit.mean[joint.index].reshape(len(joint.scatter.kinds), -1).T[kept]
    breaks = () if model.time is None else model.time.breaks
    p = trend_p_values(values, epoch, breaks)
    out = [
        f"the {kind} of the exposures drifts with time (p = {one:.1g}), and is taken to scatter "
        "between exposures: extend model.tdd.terms"
        for kind, one in zip(joint.scatter.kinds, p, strict=True)
        if kind.split(".")[-1] not in RIGID and one * len(p) < TREND.value
    ]
    for text in out:
        log.warning("fit: WARNING: %s", text)
    return out


def _first_rows(matches: MatchTable) -> Iterator[tuple[int, int]]:
    """Code of each exposure, and a row of it."""
    codes, rows = np.unique(matches.exposure, return_index=True)
    yield from zip(codes.tolist(), rows.tolist(), strict=True)


# -- summary.json ---------------------------------------------------------------------------------


def _scatter(joint: HierarchicalFit, name: str) -> dict[str, object]:
    return {"value": joint.tau[name], "interval_68": list(joint.tau_interval(0.68)[name])}
