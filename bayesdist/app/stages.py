"""The stages of a run: fit, sample, assess, export, report; each can be run by itself."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.config import Config
from bayesdist.app.rundir import RunDirectory, as_json
from bayesdist.assess import (
    ErrorBudget,
    Margin,
    Requirement,
    area_map,
    binned_residuals,
    check_requirements,
    distortion_vectors,
    error_budget,
    pixel_scale_of,
    uncertainty_map,
)
from bayesdist.assess.coefficients import coefficient_table
from bayesdist.assess.solution import Solution
from bayesdist.data import MagnitudeErrors, MatchTable, atomic_path, read_matches
from bayesdist.errors import InputError
from bayesdist.infer import (
    GaussianPriors,
    LinearFit,
    Posterior,
    build_model,
    fit_by_magnitude,
    fit_linear,
    load_fit,
    load_posterior,
    sample,
    save_fit,
    save_posterior,
)
from bayesdist.model import DistortionModel
from bayesdist.products import (
    IdcTab,
    SipHeader,
    idctab_from_solution,
    lint_idctab,
    lint_sip,
    read_idctab,
    read_sip,
    sip_from_solution,
    write_idctab,
    write_sip,
)
from bayesdist.products.maps_file import write_maps

__all__ = ["STAGES", "Session", "rehearse", "run_stage"]

log = logging.getLogger("bayesdist")

STAGES = ("fit", "sample", "assess", "export", "report")

ERROR_COLUMNS = ("mag", "sigma_u", "sigma_v", "n", "scatter_u", "scatter_v")
REHEARSAL_DRAWS = 100
VECTOR_GRID = 17  # vectors along the longer side of a diagram: more would hide each other
MOST_BINS = 32
STARS_PER_BIN = 25


@dataclass
class Session:
    """What the stages of one run share; everything is read when it is first needed.

    Parameters
    ----------
    run : RunDirectory
    progress : callable, optional
        Called with (steps made, most steps) while sampling.
    """

    run: RunDirectory
    progress: Callable[[int, int], None] | None = None

    @cached_property
    def config(self) -> Config:
        """The resolved configuration."""
        return self.run.config

    @cached_property
    def raw_matches(self) -> MatchTable:
        """Matches as read."""
        data = self.config.data
        return read_matches(
            self.run.matches,
            format=data.format,
            columns=data.columns,
            unit=data.unit,
            sigma=data.sigma,
            pixel_origin=data.pixel_origin,
            tangent_point=data.tangent_point,
        )

    @cached_property
    def magnitude_errors(self) -> MagnitudeErrors | None:
        """Errors by magnitude, as the fit left them."""
        path = self.run / "magnitude_errors.ecsv"
        if self.config.data.sigma != "by_magnitude" or not path.exists():
            return None
        table = Table.read(path)
        return MagnitudeErrors(**{name: np.asarray(table[name]) for name in ERROR_COLUMNS})

    @cached_property
    def matches(self) -> MatchTable:
        """Matches with their errors."""
        errors = self.magnitude_errors
        if errors is None:
            return self.raw_matches
        return self.raw_matches.with_sigma(*errors.at(self.raw_matches.mag))

    @cached_property
    def model(self) -> DistortionModel:
        """The model that the configuration asks for."""
        config = self.config
        return build_model(
            self.raw_matches,
            order=config.model.order,
            size=config.detector.size,
            reference_pixel=config.model.reference_pixel,
            name=config.detector.name,
            chips=config.chips(),
            frames=config.model.frames,
            time=config.time(),
        )

    @cached_property
    def priors(self) -> GaussianPriors:
        """Priors of the model's parameters."""
        named = {p.parameter: (p.mean, p.sigma) for p in self.config.prior}
        return GaussianPriors.of(self.model, named)

    @cached_property
    def linear(self) -> tuple[LinearFit, MagnitudeErrors | None]:
        """The linear fit that the configuration asks for, made now; nothing is written."""
        fit = self.config.fit
        options: dict[str, Any] = {
            "clip_chi2": fit.clip_chi2,
            "clip_abs": fit.clip_abs,
            "radial_weight": fit.radial_weight,
            "priors": self.priors,
        }
        if self.config.data.sigma == "by_magnitude":
            solution, _, errors = fit_by_magnitude(self.raw_matches, self.model, **options)
            return solution, errors
        return fit_linear(self.raw_matches, self.model, **options), None

    @cached_property
    def fit(self) -> LinearFit:
        """The linear fit of an earlier stage."""
        return load_fit(self.run / "fit.nc")

    @cached_property
    def posterior(self) -> Posterior:
        """The posterior of an earlier stage."""
        return load_posterior(self.run / "posterior.nc")

    @property
    def scale_arcsec(self) -> float | None:
        """Size of a pixel in arcsec, where the configuration gives it."""
        scale = self.config.detector.scale_mas
        return None if scale is None else scale / 1000

    def rng(self, stage: str) -> np.random.Generator:
        """Random numbers of a stage: all follow from the one seed."""
        return np.random.default_rng([self.config.sampler.seed, STAGES.index(stage)])

    @property
    def epoch(self) -> float | None:
        """Epoch of the assessment; the middle of the data where none is given."""
        if self.config.assess.epoch is not None or self.model.time is None:
            return self.config.assess.epoch
        assert self.raw_matches.epoch is not None
        return float(np.median(self.raw_matches.epoch))


def run_stage(session: Session, name: str) -> None:
    """Run one stage and note it as done."""
    log.info("%s: begins", name)
    with session.run.stage(name):
        _FUNCTIONS[name](session)


def rehearse(session: Session) -> None:
    """All that comes after sampling, on the linear fit and with few draws; nothing is written.

    What is wrong with the data or the configuration shows here, before hours of sampling.

    Raises
    ------
    BayesdistError
    """
    config = session.config
    fit, _ = session.linear
    _budget(session, fit, REHEARSAL_DRAWS)
    margins_of(session, config.requirements(), fit, REHEARSAL_DRAWS)
    if config.products.sip is not None:
        for chip in fit.model.chips:
            _sip(session, fit, chip.number)
    if config.products.idctab is not None:
        _idctab(session, fit)


def _fit(session: Session) -> None:
    run = session.run
    fit, errors = session.linear
    if errors is not None:
        table = Table({name: getattr(errors, name) for name in ERROR_COLUMNS})
        _write_table(table, run / "magnitude_errors.ecsv")
    save_fit(fit, run / "fit.nc")
    for stale in ("matches", "magnitude_errors", "fit"):  # this fit is what they go by from now on
        session.__dict__.pop(stale, None)
    matches = session.raw_matches
    run.summarise(
        data={
            "n_rows": matches.n_rows,
            "n_used": int(fit.used.sum()),
            "n_rejected": matches.n_rows - int(fit.used.sum()),
            "rejected": {**matches.rejected, **fit.rejected},
            "n_exposures": len(matches.exposure_names),
            "sources": list(matches.sources),
        },
        fit={
            "order": fit.model.order,
            "chi2": fit.chi2,
            "dof": fit.dof,
            "rms_u": fit.rms_u,
            "rms_v": fit.rms_v,
            "unit": fit.unit,
            "condition": fit.condition,
            "n_parameters": fit.model.n_params,
        },
    )
    log.info(
        "fit: %d stars, %d rejected, rms %.4g and %.4g %s, chi2/dof %.3f",
        fit.used.size,
        int((~fit.used).sum()),
        fit.rms_u,
        fit.rms_v,
        fit.unit,
        fit.chi2 / max(fit.dof, 1),
    )


def _sample(session: Session) -> None:
    config, run = session.config, session.run
    s = config.sampler
    posterior = sample(
        session.fit,
        session.matches,
        outliers=config.mixture(),
        priors=session.priors,
        seed=s.seed,
        ensembles=s.ensembles,
        walkers=s.walkers,
        target_ess=s.target_ess,
        target_rhat=s.target_rhat,
        max_steps=s.max_steps,
        checkpoint_every=s.checkpoint_every,
        folder=run.path,
        progress=session.progress,
    )
    record = run.record
    provenance = {k: record[k] for k in ("inputs", "seed", "versions", "created")}
    save_posterior(posterior, session.matches, run / "posterior.nc", provenance=provenance)
    session.__dict__["posterior"] = posterior
    c, i = posterior.convergence, posterior.sampler
    run.summarise(
        outliers=_outliers(posterior),
        sampler={
            "method": i.method,
            "converged": c.converged,
            "reasons": list(c.reasons),
            "rhat_max": c.rhat_max,
            "ess_bulk_min": c.ess_bulk_min,
            "ess_tail_min": c.ess_tail_min,
            "pareto_k": c.pareto_k,
            "importance_efficiency": c.importance_efficiency,
            "ensembles": i.ensembles,
            "walkers": i.walkers,
            "steps": i.steps,
            "passes": i.passes,
            "acceptance": i.acceptance,
            "wall_s": i.wall_s,
        },
    )
    if c.converged:
        log.info("sample: converged after %d steps, %d passes", i.steps, i.passes)
    else:
        log.warning("sample: NOT CONVERGED after %d steps: %s", i.steps, "; ".join(c.reasons))


def _outliers(posterior: Posterior) -> dict[str, object]:
    out: dict[str, object] = {"model": posterior.mixture.model, "unit": posterior.unit}
    names = {"f": "fraction", "j": "jitter", "s_out": "scale"}
    for key, name in names.items():
        values = posterior.hyper.get(key)
        if values is not None:
            out[name] = {"mean": float(values.mean()), "sd": float(values.std(ddof=1))}
        elif key == "j":
            out[name] = {"mean": posterior.mixture.jitter, "sd": 0.0}
        elif key == "f":
            out[name] = {"mean": 0.0, "sd": 0.0}
    out["n_flagged"] = int((posterior.outlier_probability > 0.5).sum())
    return out


def _assess(session: Session) -> None:
    config, run = session.config, session.run
    solution, grid, epoch = session.posterior, config.assess.grid, session.epoch
    maps = [uncertainty_map(s, grid=grid, epoch=epoch) for s in (session.fit, solution)]
    write_maps(run / "maps.fits", maps, area_map(solution, grid=grid, epoch=epoch))
    _write_table(coefficient_table(session.fit, solution), run / "coefficients.ecsv")
    budget = _budget(session, solution)
    table = Table(rows=budget.rows())
    for name in ("u", "v", "radial"):
        table[name].unit = solution.unit
    table.meta = {"epoch": epoch, "grid": list(grid), "statistic": "rms over the grid"}
    _write_table(table, run / "budget.ecsv")
    margins = margins_of(session, config.requirements(), solution)
    write_margins(session, margins)
    m = maps[1]
    run.summarise(
        map={
            "unit": m.unit,
            "epoch": m.epoch,
            "sigma_u_max": m.sigma_u_max,
            "sigma_v_max": m.sigma_v_max,
            "radius_max": m.radius_max,
            "position_of_max": list(m.position_of_max),
            "radius_max_least_squares": maps[0].radius_max,
        },
        budget=budget.rows(),
    )
    log.info("assess: largest formal radius %.4g %s", m.radius_max, m.unit)


def _assessment(session: Session, solution: Solution, n_draws: int | None) -> dict[str, Any]:
    """What a budget and margins have in common."""
    config = session.config
    return {
        "terms": config.user_terms(),
        "grid": config.assess.grid,
        "epoch": session.epoch,
        "n_draws": n_draws or config.assess.draws,
        "rng": session.rng("assess"),
        "pixel_scale": pixel_scale_of(solution, scale_mas=config.detector.scale_mas),
    }


def _budget(session: Session, solution: Solution, n_draws: int | None = None) -> ErrorBudget:
    return error_budget(solution, **_assessment(session, solution, n_draws))


def margins_of(
    session: Session,
    requirements: tuple[Requirement, ...],
    solution: Solution,
    n_draws: int | None = None,
) -> tuple[Margin, ...]:
    """Margins of a solution against requirements; as many draws as configured by default."""
    return check_requirements(solution, requirements, **_assessment(session, solution, n_draws))


def margin_rows(margins: tuple[Margin, ...]) -> list[dict[str, Any]]:
    """Margins as plain rows, for files and for the screen."""
    return [
        {
            "name": m.requirement.name,
            "statistic": m.requirement.statistic,
            "limit": m.requirement.limit,
            "value": m.value,
            "interval": list(m.interval),
            "margin": m.margin,
            "unit": m.unit,
            "epoch": m.epoch,
            "probability": m.requirement.probability,
            "probability_met": m.probability_met,
            "mc_error": m.mc_error,
            "verdict": m.verdict,
            "reason": m.reason,
        }
        for m in margins
    ]


def write_margins(session: Session, margins: tuple[Margin, ...]) -> None:
    """Replace the margins of a run: margins.ecsv and summary.json."""
    rows = margin_rows(margins)
    columns: dict[str, list[Any]] = {}
    for row in rows:
        low, high = row["interval"]
        flat = {**row, "lo95": low, "hi95": high}
        del flat["interval"]
        flat["epoch"] = np.nan if flat["epoch"] is None else flat["epoch"]
        for name, value in flat.items():
            columns.setdefault(name, []).append(value)
    _write_table(Table(columns), session.run / "margins.ecsv")
    session.run.summarise(margins=rows)


def _sip(session: Session, solution: Solution, chip: int) -> SipHeader:
    sip = session.config.products.sip
    assert sip is not None
    return sip_from_solution(
        solution,
        chip=chip,
        epoch=session.epoch,
        inverse_order=sip.inverse_order,
        linear=sip.linear,
        crval=sip.crval,
        scale_arcsec=session.scale_arcsec,
    )


def _idctab(session: Session, solution: Solution) -> IdcTab:
    idc = session.config.products.idctab
    assert idc is not None
    return idctab_from_solution(
        solution, scale_arcsec=session.scale_arcsec, **idc.model_dump(exclude_none=True)
    )


def _export(session: Session) -> None:
    config, run = session.config, session.run
    products: list[dict[str, Any]] = []
    if config.products.sip is not None:
        for chip in session.posterior.model.chips:
            several = len(session.posterior.model.chips) > 1
            path = run / (f"sip_{chip.number}.hdr" if several else "sip.hdr")
            header = _sip(session, session.posterior, chip.number)
            write_sip(header, path)
            findings = lint_sip(read_sip(path), size=chip.size)
            products.append(
                {
                    "path": path.name,
                    "kind": "SIP",
                    "chip": chip.number,
                    "closure_pix": header.closure,
                    "a_dmax": header.a_dmax,
                    "b_dmax": header.b_dmax,
                    "findings": [f"{f.level}: {f.where}: {f.message}" for f in findings],
                }
            )
    idc = config.products.idctab
    if idc is not None:
        path = run / f"{idc.instrument}_{idc.detector}_idc.fits".lower()
        write_idctab(_idctab(session, session.posterior), path)
        findings = lint_idctab(read_idctab(path))
        products.append(
            {
                "path": path.name,
                "kind": "IDCTAB",
                "findings": [f"{f.level}: {f.where}: {f.message}" for f in findings],
            }
        )
    run.summarise(products=products)
    log.info("export: %s", ", ".join(p["path"] for p in products) or "no products asked for")


def _report(session: Session) -> None:
    # figures take seconds to import
    from bayesdist.report import (
        Check,
        Product,
        ReportInput,
        all_figures,
        save_figures,
        write_report,
    )

    run, config = session.run, session.config
    fit, posterior, epoch = session.fit, session.posterior, session.epoch
    chip, grid = fit.model.chips[0], config.assess.grid
    vectors = {"grid": _vector_grid(chip.size), "epoch": epoch}
    matches = session.matches
    on_chip = np.asarray(matches.chip_numbers)[matches.chip] == chip.number
    if len(fit.model.chips) == 1:
        on_chip = np.ones(len(matches), bool)
    good = on_chip & fit.used
    side = int(np.clip(np.sqrt(good.sum() / STARS_PER_BIN), 4, MOST_BINS))
    record = run.record
    products = tuple(
        Product(
            path=p["path"],
            what=p["kind"],
            checks=tuple(_product_checks(p, Check)),
        )
        for p in run.summary.get("products", [])
    )
    inputs = ReportInput(
        name=run.path.resolve().name,
        config=as_json(config.model_dump(exclude_none=True)),
        matches=matches,
        fit=fit,
        posterior=posterior,
        formal_map=uncertainty_map(fit, grid=grid, epoch=epoch),
        posterior_map=uncertainty_map(posterior, grid=grid, epoch=epoch),
        displacement=distortion_vectors(posterior, part="no_constant", **vectors),
        non_linear=distortion_vectors(posterior, part="non_linear", **vectors),
        area=area_map(posterior, grid=grid, epoch=epoch),
        binned=binned_residuals(
            matches.x[good],
            matches.y[good],
            fit.residual[good, 0],
            fit.residual[good, 1],
            bins=side,
            size=chip.size,
        ),
        coefficients=coefficient_table(fit, posterior),
        budget=_budget(session, posterior),
        # the requirements that were judged last, be it by `assess` or by `validate`
        margins=margins_of(session, judged_requirements(run), posterior),
        products=products,
        magnitude_errors=session.magnitude_errors,
        provenance={
            k: record[k] for k in ("command", "created", "seed", "inputs", "versions", "stages")
        },
    )
    figures = all_figures(inputs)
    names = [f"{name}.png" for name in figures]
    for stale in set(run.summary.get("figures", [])) - set(names):
        (run / "figures" / stale).unlink(missing_ok=True)
    run.summarise(figures=names)
    save_figures(figures, run / "figures")
    write_report(run / "report.html", inputs, figures)
    log.info("report: %s", run / "report.html")


def judged_requirements(run: RunDirectory) -> tuple[Requirement, ...]:
    """The requirements behind the margins in summary.json."""
    keys = ("name", "statistic", "limit", "unit", "probability", "epoch")
    return tuple(Requirement(**{k: row[k] for k in keys}) for row in run.summary.get("margins", []))


def _product_checks(product: dict[str, Any], check: Callable[..., Any]) -> list[Any]:
    out = []
    if product.get("closure_pix") is not None:
        out.append(check("worst closure of the inverse (pix)", product["closure_pix"]))
        out.append(check("A_DMAX (pix)", product["a_dmax"]))
        out.append(check("B_DMAX (pix)", product["b_dmax"]))
    levels = {"error": "fail", "warning": "warn", "note": "note"}
    for finding in product["findings"]:
        level, _, text = finding.partition(": ")
        out.append(check(text, level, "", levels.get(level, "note")))
    return out


def _vector_grid(size: tuple[float, float]) -> tuple[int, int]:
    longest = max(size)
    nx, ny = (max(3, round(VECTOR_GRID * s / longest)) for s in size)
    return nx, ny


def _write_table(table: Table, path: Path) -> None:
    with atomic_path(path) as temporary:
        table.write(temporary, format="ascii.ecsv")


def require(session: Session, stage: str, needs: tuple[str, ...]) -> None:
    """Refuse a stage whose predecessors have not been run.

    Raises
    ------
    InputError
    """
    for earlier in needs:
        if not session.run.done(earlier):
            raise InputError(
                f"stage '{stage}' needs stage '{earlier}', which has not been run",
                where=str(session.run.path),
                do=f"run 'bayesdist {earlier} {session.run.path}' first",
            )


NEEDS = {
    "fit": (),
    "sample": ("fit",),
    "assess": ("fit", "sample"),
    "export": ("fit", "sample"),
    "report": ("fit", "sample", "assess"),
}

_FUNCTIONS: dict[str, Callable[[Session], None]] = {
    "fit": _fit,
    "sample": _sample,
    "assess": _assess,
    "export": _export,
    "report": _report,
}
