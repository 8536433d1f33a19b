"""Stage 5: figures and report.html."""

from __future__ import annotations

import logging
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from bayesdist.app.campaign.report import campaign_results
from bayesdist.app.campaign.session import CampaignSession
from bayesdist.app.config import Config
from bayesdist.app.holdout import held_out_of
from bayesdist.app.horizon import kept_horizons
from bayesdist.app.judging import budget_of, errors_of, margins_of
from bayesdist.app.margins import judged_requirements
from bayesdist.app.periods import periods_of
from bayesdist.app.rundir import as_json
from bayesdist.app.selfcal.report import selfcal_results
from bayesdist.app.selfcal.session import SelfcalSession
from bayesdist.app.session import Session
from bayesdist.app.stages.assess import relative_maps
from bayesdist.app.trust import posterior_warnings
from bayesdist.assess import (
    area_map,
    distortion_vectors,
    flagged_by_exposure,
    uncertainty_map,
)
from bayesdist.assess.budget.surface import BudgetSurface, budget_surface
from bayesdist.assess.coefficients import coefficient_table
from bayesdist.assess.mosaic import chip_places
from bayesdist.errors import InputError
from bayesdist.report.context import Check, ChipResults, Product, ReportInput

__all__ = ["run_report", "title_of"]

log = logging.getLogger("bayesdist")

YEARS_AHEAD = 10.0  # to which the page extrapolates the budget
VECTOR_GRID = 17  # vectors along the longer side of a diagram: more would hide each other


def run_report(session: Session) -> None:
    # figures take seconds to import
    from bayesdist.report.drawing import save_drawings
    from bayesdist.report.run_report import draw_report, write_report

    run, inputs = session.run, _inputs(session)
    drawings = draw_report(inputs, processes=2 if _is_command_line() else 1)
    names = [f"{name}.{kind}" for name in drawings for kind in ("png", "pdf")]
    save_drawings(drawings, run / "figures")
    for stale in set(run.summary.get("figures", [])) - set(names):
        (run / "figures" / stale).unlink(missing_ok=True)
    run.summarise(figures=names)  # what is there, should the disk be full
    write_report(run / "report.html", inputs, drawings)
    log.info("report: %s", run / "report.html")


def _is_command_line() -> bool:
    """Whether other processes may import the main module: a user's own may not be guarded."""
    path = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    name = path.parent.stem if path.name == "__main__.py" else path.stem
    return name == "bayesdist" and (os.cpu_count() or 1) > 1


def _inputs(session: Session) -> ReportInput:
    """All that the report shows."""
    run, config = session.run, session.config
    fit, posterior = session.fit, session.posterior
    several = len(fit.model.exposures) > 1
    record, folder = run.record, run.path.resolve().name
    products = tuple(
        Product(
            path=p["path"],
            what=p["kind"],
            checks=_product_checks(p),
        )
        for p in run.summary.get("products", [])
    )
    judged = judged_requirements(run)
    campaign = campaign_results(session) if isinstance(session, CampaignSession) else None
    inputs = ReportInput(
        name=title_of(config) or folder,
        config=as_json(config.model_dump(exclude_none=True)),
        stars=session.stars,
        exposures=session.sums.exposures,
        fit=fit,
        posterior=posterior,
        chips=_chip_results(session),
        coefficients=coefficient_table(fit, session.solution),
        budget=budget_of(session),
        surface=_surface(session),
        # the requirements that were judged last, be it by `assess` or by `requirements`
        margins=margins_of(session, judged),
        horizons=kept_horizons(run / "horizon.ecsv", judged),
        products=products,
        warnings=tuple(posterior_warnings(session)),
        misfits=() if isinstance(session, CampaignSession) else session.misfits,
        score_tests=session.score_tests,
        periods=periods_of(session),
        held_out=held_out_of(session),
        magnitude_errors=session.magnitude_errors,
        added_errors=session.grouped_errors,
        flagged=flagged_by_exposure(session.shards, posterior) if several else None,
        campaign=campaign,
        provenance={"folder": folder}
        | {k: record[k] for k in ("command", "created", "seed", "inputs", "versions", "stages")},
    )
    if isinstance(session, SelfcalSession):
        inputs = replace(inputs, selfcal=selfcal_results(session))
    return inputs


def title_of(config: Config) -> str:
    """What was calibrated: detector, or chips, and the filter of a campaign; may be empty."""
    detector = config.detector.name or " and ".join(chip.name for chip in config.chip)
    band = None if config.campaign is None else config.campaign.filter
    return ", ".join(part for part in (detector, band) if part)


def _surface(session: Session) -> BudgetSurface | None:
    """The budget for the page to compute from; None where its errors contradict each other."""
    try:
        errors = errors_of(session)
    except InputError as error:  # what is said to be in the residuals is larger than these
        log.warning("report: WARNING: the page's budget has no position and no epoch: %s", error)
        return None
    years, epochs = None, session.stars.table.epoch
    if session.solution.model.time is not None and epochs is not None:
        seen = [*epochs, session.epoch]
        years = float(min(seen)), float(max(seen)) + YEARS_AHEAD
    return budget_surface(errors, session.config.assess.grid, epoch=session.epoch, years=years)


def _chip_results(session: Session) -> tuple[ChipResults, ...]:
    fit, posterior, epoch = session.fit, session.solution, session.epoch
    out = []
    places = [
        {"grid": session.config.assess.grid, "epoch": epoch, "chip": chip.number}
        for chip in posterior.model.chips
    ]
    relative = dict(enumerate(relative_maps(session, places)))
    for k, (chip, place, sums) in enumerate(
        zip(
            posterior.model.chips,
            chip_places(posterior, epoch=epoch),
            session.shown_sums,
            strict=True,
        )
    ):
        on_chip = places[k]
        vectors = on_chip | {"grid": _vector_grid(chip.size)}
        out.append(
            ChipResults(
                chip=chip,
                formal_map=uncertainty_map(fit, **on_chip),
                posterior_map=session.position_map(**on_chip),
                displacement=distortion_vectors(posterior, part="no_constant", **vectors),
                non_linear=distortion_vectors(posterior, part="non_linear", **vectors),
                area=area_map(posterior, **on_chip),
                binned=sums.residuals(),
                place=place,
                relative_map=relative.get(k),
            )
        )
    return tuple(out)


def _product_checks(product: dict[str, Any]) -> tuple[Check, ...]:
    """What was verified on a file as written."""
    out = []
    if product.get("closure_pix") is not None:
        out.append(Check("worst closure of the inverse (pix)", product["closure_pix"]))
        out.append(Check("A_DMAX (pix)", product["a_dmax"]))
        out.append(Check("B_DMAX (pix)", product["b_dmax"]))
    if product.get("sky"):
        sky = product["sky"]
        name = f"rms distance from RA, Dec of {sky['n']} stars (arcsec)"
        out.append(Check(name, sky["rms_arcsec"]))
        out.append(Check("largest distance from the solution (arcsec)", sky["solution_arcsec"]))
    levels = {"error": "fail", "warning": "warn", "note": "note"}
    for finding in product["findings"]:
        level, _, text = finding.partition(": ")
        out.append(Check(text, level, "", levels.get(level, "note")))
    return tuple(out)


def _vector_grid(size: tuple[float, float]) -> tuple[int, int]:
    longest = max(size)
    nx, ny = (max(3, round(VECTOR_GRID * s / longest)) for s in size)
    return nx, ny
