"""Fit of a campaign: look-up tables, errors, all exposures jointly, and each exposure alone."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np

from bayesdist.app.artefacts.stars import QUOTED
from bayesdist.app.artefacts.stored_fit import FitArtefacts
from bayesdist.app.run import Run
from bayesdist.data.matches import Matches
from bayesdist.infer import load
from bayesdist.infer.exposures.alone import ExposureSolutions, fit_exposures
from bayesdist.infer.exposures.hierarchy import (
    HierarchicalFit,
    fit_hierarchical,
    held_in_reference,
    trend_p_values,
)
from bayesdist.infer.nodes import corrected_matches, on_the_chips
from bayesdist.infer.solution.linear import Rejection
from bayesdist.kinds.campaign.input_validation import frames_not_set
from bayesdist.kinds.campaign.inputs import Inputs
from bayesdist.kinds.campaign.linear_terms import FIXED, gap_priors, line_sections, with_gap
from bayesdist.kinds.campaign.matched import affine_model_of
from bayesdist.kinds.campaign.parts import ExposuresAlone, ExposureScatter
from bayesdist.kinds.campaign.reference import rate_priors
from bayesdist.kinds.campaign.series import Series
from bayesdist.kinds.campaign.tables import errors_with_catalogue, fit_tables, tables_section
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.frames import RIGID
from bayesdist.utils.limits import TREND

SERIES = ("A_2", "A_3", "B_1", "B_2", "B_3")


def fit_campaign(run: Run) -> Run:
    """Fit the look-up tables, the errors, all exposures jointly, and each exposure alone."""
    with frames_not_set():
        return run.having(**_fitted(run.stars, run.inputs))


def _fitted(pairs: Matches, inputs: Inputs) -> FitArtefacts:
    """Artefacts of the stage 'fit'."""
    config = inputs.config
    affine = affine_model_of(config, pairs)
    tables, fit_of_tables = fit_tables(pairs, inputs)
    if tables.tables:
        pairs = on_the_chips(corrected_matches(tables.tables, pairs), affine)
    errors = QUOTED if inputs.has_quoted_errors else errors_with_catalogue(pairs, inputs)
    stars = errors.applied(pairs)
    rejection = Rejection(config.fit.clip_chi2, config.fit.clip_abs)
    joint = _joint(stars, affine, inputs, rejection)
    number = config.chips()[0].number
    alone = fit_exposures(stars, affine, chip=number, rejection=rejection)
    facts = {
        **line_sections(joint, number),
        "tables": tables_section(config, tables, fit_of_tables),
        "scatter": {
            name: {"value": tau, "interval_68": list(joint.tau_interval(0.68)[name])}
            for name, tau in joint.tau.items()
        },
        "deviations": {"warnings": _trends(joint, stars)},
        "exposures_skipped": dict(alone.skipped),
        "exposures_outlying": list(joint.outlying),
    }
    return {
        "fit": joint.fit,
        "errors": errors,
        "priors": joint.priors,
        "parts": {
            "tables": tables,
            "scatter": ExposureScatter(joint.scatter.kinds, joint.tau_draws, joint.settling),
            "alone": ExposuresAlone(_series(alone, joint.model.chips[0])),
        },
        "fit_facts": facts,
    }


def _joint(
    stars: Matches, affine: DistortionModel, inputs: Inputs, rejection: Rejection
) -> HierarchicalFit:
    """Fit all exposures jointly; they deviate from the model by the scatter that is found."""
    config = inputs.config
    asked, scale = config.time(), config.detector.scale_mas
    pixel = 1.0 if scale is None else inputs.pixel_arcsec / inputs.unit_arcsec
    drifting = with_gap(replace(affine, time=asked))
    held = held_in_reference(stars, drifting, config.chips()[0].number)
    model = replace(held, chip_deviations=True)
    with closing(load(model, stars, config.resources())) as shards:
        return fit_hierarchical(
            shards,
            model,
            priors=rate_priors(config, model, inputs.base) or gap_priors(model, asked, pixel),
            pixel=pixel,
            seed=config.sampler.seed,
            rejection=rejection,
        )


def _series(alone: ExposureSolutions, reference: Chip) -> Series:
    """Linear terms of all chips and the constant in v, without terms that the gauge fixes."""
    fixed = {f"{prefix}{term}" for prefix in ("", f"{reference.name}.") for term in FIXED}
    labels = [s for s in alone.labels if s.split(".")[-1] in SERIES and s not in fixed]
    epoch, values, cov = alone.series(*labels)
    return Series(epoch, values, cov, tuple(labels), alone.names, source="exposures")


def _trends(joint: HierarchicalFit, stars: Matches) -> list[str]:
    """Clauses about deviations that drift with time although they are modelled as scatter.

    Only scale and shears are tested: motion of the chips relative to each other has its own test
    (`bayesdist.diagnose.score.motions`).
    """
    if stars.epoch is None:
        return []
    model = joint.model
    codes, rows = np.unique(stars.exposure, return_index=True)
    dates = dict(zip((stars.exposure_names[k] for k in codes), stars.epoch[rows], strict=True))
    typical = [k for k, name in enumerate(model.exposures) if name not in joint.outlying]
    epoch = np.array([dates[model.exposures[k]] for k in typical])
    values = joint.fit.mean[joint.index].reshape(len(joint.scatter.kinds), -1).T[typical]
    breaks = () if model.time is None else model.time.breaks
    p = trend_p_values(values, epoch, breaks)
    return [
        f"the {kind} of the exposures drifts with time (p = {p_k:.1g}), and is taken to scatter "
        "between exposures: extend model.tdd.terms"
        for kind, p_k in zip(joint.scatter.kinds, p, strict=True)
        if kind.split(".")[-1] not in RIGID and p_k * len(p) < TREND.value
    ]
