"""What is measured of one calibrated campaign: arrays in which its errors and their sigmas are."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import chi2

from bayesdist.infer import fit_by_magnitude
from bayesdist.infer.nodes import TableFit, TablePosterior, fit_with_tables
from bayesdist.infer.solution.solution import Solution, TransformedSolution
from bayesdist.infer.solution.transforms import lines, reference_gauge, without_frames
from bayesdist.kinds.campaign.series import Series, TrendModel, fit_series
from bayesdist.missions.hst.simulate.truth import SPANS, centroid_error
from bayesdist.model import corrected
from tests.campaign.support import (
    CHIPS,
    FILTER,
    SEGMENTS,
    TERMS,
    Calibrated,
    Setting,
    calibrated,
    grids,
)

REFERENCE = 2
LEVELS = (0.683, 0.954)
POSITIONS = 100
BRIGHT = -12.5
SAME_FIELD = 0.7  # years between two exposures: motions of 0.01 px/yr are less than centroids
SHARED = 100  # stars of two exposures at least

Outcome = dict[str, Any]


def outcome(setting: Setting, seed: int) -> Outcome:
    """Simulate, calibrate, measure."""
    start = time.perf_counter()
    with calibrated(setting, seed) as found:
        rng = np.random.default_rng([setting.exposures, seed])
        out = line_errors(found, seed)
        if found.tables is not None:
            out |= node_errors(found, found.tables, setting.step)
            out |= position_errors(found, found.tables, rng) | alignments(found)
        out["tau"] = found.bare.tau
        out["epoch"] = found.terms.epoch
    out["wall"] = time.perf_counter() - start
    return out


# -- alpha and beta -------------------------------------------------------------------------------


def line_errors(found: Calibrated, seed: int) -> Outcome:
    """Values and sigmas (3, 2, 2, 2): term, chip, segment, alpha and beta.

    'joint' has the catalogue's correlated errors, 'bare' is without them, 'two' comes from the
    exposures alone.
    """
    out: Outcome = {}
    for name, solution in (("joint", found.joint), ("bare", found.bare)):
        out[f"{name} value"], out[f"{name} sigma"] = _joint_lines(solution)
    drift = found.bare.model.time
    assert drift is not None
    series = found.terms
    trend = TrendModel("lines", drift.breaks, reference=drift.epoch0)
    keep = [k for k, name in enumerate(series.coefficients) if name.split(".")[-1] in TERMS]
    some = Series(
        series.epoch,
        series.values[:, keep],
        series.cov[:, keep][:, :, keep],
        tuple(series.coefficients[k] for k in keep),
    )
    posterior = fit_series(some, trend, seed=seed, target_ess=100, target_rhat=1.05)
    names = {chip.number: chip.name for chip in found.bare.model.chips}
    draws = np.stack([posterior.alpha, posterior.beta], axis=-1)  # (n, S, k, 2)
    at = [[some.coefficients.index(f"{names[c]}.{term}") for c in CHIPS] for term in TERMS]
    drawn = np.moveaxis(draws[:, :, at], 1, 3)
    out["two value"], out["two sigma"] = drawn.mean(axis=0), drawn.std(axis=0, ddof=1)
    chains = len(posterior.raw.b)
    by_chain = drawn.reshape(chains, -1, *drawn.shape[1:]).mean(axis=1)
    error = by_chain.std(axis=0, ddof=1) / np.sqrt(chains)
    out["two monte carlo"] = float((error / out["two sigma"]).max())
    return out


def _joint_lines(solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    view = reference_gauge(without_frames(solution), REFERENCE)
    labels = [f"{term}.{kind}" for term in TERMS for kind in ("alpha", "beta")]
    values, sigma = np.empty((2, len(TERMS), len(CHIPS), len(SEGMENTS), 2))
    for c, chip in enumerate(CHIPS):
        for s in SEGMENTS:
            some = lines(view, s, chip=chip).select(*labels)
            values[:, c, s] = some.values.reshape(-1, 2)
            sigma[:, c, s] = some.sigma.reshape(-1, 2)
    return values, sigma


# -- look-up tables -------------------------------------------------------------------------------


def node_errors(found: Calibrated, tables: TableFit, step: float) -> Outcome:
    """Of the nodes of all tables: truth, error and sigma, by chip; the binned way beside it."""
    out: Outcome = {
        "rms before": tables.progress[0].rms,
        "rms after": tables.progress[-1].rms,
        "rms noise": _noise(found),
    }
    pairs = found.run.stars
    model = found.affine_model
    _, with_errors, _ = fit_by_magnitude(pairs, model)
    binned = fit_with_tables(with_errors, model, method="binned", step=(step, step))
    others = {table.chip: table for table in binned.tables}
    for posterior in tables.posteriors:
        table = posterior.table
        grid = grids(step)[table.chip]
        x, y = grid.positions
        seen = corrected(found.campaign.truth.tables, x, y, chip=table.chip, filter=FILTER)
        true = np.stack([seen[0] - x, seen[1] - y])
        # what a polynomial could follow belongs to the polynomial, by definition of a table
        true = grid.without_polynomials(true.T).T
        assert table.sigma is not None
        out[f"node truth {table.chip}"] = true
        out[f"node error {table.chip}"] = table.values.reshape(2, -1) - true
        out[f"node sigma {table.chip}"] = table.sigma.reshape(2, -1)
        out[f"binned error {table.chip}"] = others[table.chip].values.reshape(2, -1) - true
    return out


def _noise(found: Calibrated) -> float:
    """Rms of the errors of centroids and catalogue, as they were drawn, of all pairs."""
    pairs = found.run.stars
    assert pairs.star is not None
    assert pairs.sigma_u is not None and pairs.sigma_v is not None
    single = centroid_error(found.campaign.truth.stars.mag[pairs.star])
    return float(np.sqrt((single**2 + (pairs.sigma_u**2 + pairs.sigma_v**2) / 2).mean()))


# -- positions ------------------------------------------------------------------------------------


def position_errors(found: Calibrated, tables: TableFit, rng: np.random.Generator) -> Outcome:
    """Errors (N, 2) of positions in the reference gauge, anywhere, at any date, and covariances.

    Polynomial with its drift, errors of the catalogue, and tables.
    """
    view = reference_gauge(without_frames(found.joint), REFERENCE)
    posteriors = {p.table.chip: p for p in tables.posteriors}
    truth = found.campaign.truth
    chip = rng.choice(CHIPS, POSITIONS)
    x, y = rng.uniform(0.5, 4096.5, POSITIONS), rng.uniform(0.5, 2048.5, POSITIONS)
    epoch = np.array([rng.uniform(*SPANS[k]) for k in rng.integers(2, size=POSITIONS)])
    error, cov = np.empty((POSITIONS, 2)), np.empty((POSITIONS, 2, 2))
    for number in CHIPS:
        rows = chip == number
        where = {"chip": number, "epoch": epoch[rows]}
        true = truth.model.predict(
            truth.theta[FILTER],
            *corrected(truth.tables, x[rows], y[rows], chip=number, filter=FILTER),
            **where,
        )
        got, cov[rows] = _position(view, found, posteriors[number], x[rows], y[rows], where)
        error[rows] = got - true
    pull = error / np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    distance2 = np.einsum("na,na->n", error, np.linalg.solve(cov, error[..., None])[..., 0])
    limits = {level: (np.sqrt(chi2.ppf(level, 1)), chi2.ppf(level, 2)) for level in LEVELS}
    out: Outcome = {"position pull": pull, "position sigma": np.sqrt(np.einsum("naa->na", cov))}
    for level, (axis, radial) in limits.items():
        out[f"axis {level}"] = (np.abs(pull) < axis).mean()
        out[f"radial {level}"] = (distance2 < radial).mean()
    return out


def _position(
    view: TransformedSolution,
    found: Calibrated,
    posterior: TablePosterior,
    x: np.ndarray,
    y: np.ndarray,
    where: dict[str, Any],
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 2) and their covariance (N, 2, 2)."""
    px, py = corrected(found.run.tables.tables, x, y, chip=where["chip"])
    D = view.model.jacobian(view.mean, px, py, **where)
    J = view.model.slopes(view.mean, px, py, **where)
    table = posterior.position_sigma(x, y, refitted=True) ** 2
    cov = np.einsum("nap,pq,nbq->nab", D, view.cov, D, optimize=True)
    cov += np.einsum("nai,ni,nbi->nab", J, table, J)
    return view.model.predict(view.mean, px, py, **where), cov


# -- alignment ------------------------------------------------------------------------------------


def alignments(found: Calibrated) -> Outcome:
    """Shared stars of exposures that follow each other, laid on each other by a similarity.

    Rms per axis of all and of the bright stars: for the solution, for the true distortion (where
    centroids and the exposures' own scatter are left), for what the calibration began with (no
    drift, no tables); and what the solution leaves in other places than the true distortion does,
    by which it can be told from what is wrong with the exposures themselves.
    """
    truth = found.campaign.truth
    log = found.campaign.log
    lists = dict(zip(log.names, found.campaign.lists, strict=True))
    detections = dict(zip(log.names, truth.detections, strict=True))
    rows: dict[str, list[float]] = {}
    for a, b in pairwise(log):
        if b.epoch - a.epoch > SAME_FIELD:
            continue
        stars, index = [], []
        for one in (a, b):
            good = detections[one.name].star >= 0
            mag = lists[one.name].mag
            good &= ~detections[one.name].blended & (mag > -14) & (mag < -10)
            index.append(np.flatnonzero(good))
            stars.append(detections[one.name].star[good])
        shared, i, k = np.intersect1d(*stars, return_indices=True)
        if len(shared) < SHARED:
            continue
        mag = truth.stars.mag[shared]
        seen = [
            (lists[one.name].x[of], lists[one.name].y[of], lists[one.name].chip[of], one.epoch)
            for one, of in ((a, index[0][i]), (b, index[1][k]))
        ]
        left = {
            name: _after_similarity(*(place(*where) for where in seen))
            for name, place in _calibrations(found).items()
        }
        left["own"] = left["new"] - left["true"]
        for kind, of in (("all", mag < 0), ("bright", mag < BRIGHT)):
            for name, vectors in left.items():
                rows.setdefault(f"{name} {kind}", []).append((vectors[of] ** 2).mean())
    return {f"alignment {name}": np.sqrt(values) for name, values in rows.items()}


def _calibrations(found: Calibrated) -> dict[str, Callable[..., np.ndarray]]:
    """Positions (N, 2) of x, y, chip and epoch by three calibrations."""
    truth, tables = found.campaign.truth, found.run.tables.tables
    view = reference_gauge(without_frames(found.joint), REFERENCE)

    def new(x: np.ndarray, y: np.ndarray, chip: np.ndarray, epoch: float) -> np.ndarray:
        x, y = corrected(tables, x, y, chip=chip)
        return view.model.predict(view.mean, x, y, chip=chip, epoch=np.full(len(x), epoch))

    def true(x: np.ndarray, y: np.ndarray, chip: np.ndarray, epoch: float) -> np.ndarray:
        return old(*corrected(truth.tables, x, y, chip=chip, filter=FILTER), chip, epoch)

    def old(x: np.ndarray, y: np.ndarray, chip: np.ndarray, epoch: float) -> np.ndarray:
        date = np.full(len(x), epoch)
        return truth.model.predict(truth.theta[FILTER], x, y, chip=chip, epoch=date)

    return {"new": new, "true": true, "old": lambda x, y, chip, _: old(x, y, chip, 2004.5)}


def _after_similarity(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """What shift, rotation and scale leave between two sets of positions (N, 2)."""
    za, zb = a @ [1, 1j], b @ [1, 1j]
    za, zb = za - za.mean(), zb - zb.mean()
    left = za - zb * (np.vdot(zb, za) / np.vdot(zb, zb))
    return np.stack([left.real, left.imag], axis=1)
