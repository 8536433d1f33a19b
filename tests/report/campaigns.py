"""What a campaign adds to a run, made by hand: lines, scatter, tables and residuals are known."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from astropy.table import Table

from bayesdist.app.parts import StoredLookupTables
from bayesdist.data import MagnitudeErrors
from bayesdist.diagnose.overlap import OverlapTest, _binned, align
from bayesdist.diagnose.residuals.binned import binned_residuals
from bayesdist.kinds.campaign.kind import CAMPAIGN
from bayesdist.kinds.campaign.report.data import (
    CampaignData,
    CatalogStars,
    DetectionQuality,
    Footprints,
    LinearSeries,
    TableResiduals,
)
from bayesdist.model import LookupTable

from .runs import SketchedRun, report_run

SIZE = (512.0, 256.0)
NAMES = ("WFC1", "WFC2")
BREAK, EPOCH0 = 2009.4, (2004.5, 2012.5)
SCATTER, FORMAL, ABERRATION = 6e-6, 2e-6, 5e-5
N = 60  # exposures
LABELS = ("WFC1.A_2", "WFC1.B_1", "WFC2.A_2", "WFC2.B_2")
ALPHA = {"WFC1.A_2": 0.982, "WFC1.B_1": 2079.58, "WFC2.A_2": 0.9946, "WFC2.B_2": 0.0686}
BETA = {"WFC1.A_2": -1e-5, "WFC1.B_1": 0.0, "WFC2.A_2": -1e-5, "WFC2.B_2": 3.6e-5}
# covariance of alpha and beta of every line, in the square of the scatter
LINE_COV = np.array([[0.02, 0.004], [0.004, 0.006]])


def unit_of(label: str) -> float:
    """Scatter of a term: constants are two thousand pixels long."""
    return SCATTER * (2000.0 if label.endswith("_1") else 1.0)


def line_sigma(label: str, t, segment: int):
    """Error of a line at dates, from its covariance."""
    dt = np.asarray(t) - EPOCH0[segment]
    (a, ab), (_, b) = LINE_COV
    return unit_of(label) * np.sqrt(a + 2 * ab * dt + b * dt**2)


def linear_series(seed: int = 2) -> LinearSeries:
    rng = np.random.default_rng(seed)
    spans = ((2002.4, 2007.0), (2009.5, 2014.5))
    epoch = np.sort(np.concatenate([rng.uniform(*span, N // 2) for span in spans]))
    pa_v3 = rng.uniform(0, 360, N)
    vafactor = 1 + ABERRATION * np.cos(np.radians(pa_v3))
    segment = (epoch > BREAK).astype(int)
    columns = {"exposure": [f"e{k:03d}" for k in range(N)], "epoch": epoch}
    for label in LABELS:
        line = ALPHA[label] + BETA[label] * (epoch - np.array(EPOCH0)[segment])
        columns[label] = line + unit_of(label) * rng.standard_normal(N)
        columns[f"sigma_{label}"] = np.full(N, FORMAL * unit_of(label) / SCATTER)
    columns["outlier_probability"] = np.where(np.arange(N) == 7, 0.9, 0.01)
    dates = np.linspace(epoch[0], epoch[-1], 25)
    drift = {"epoch": dates}
    for label in LABELS:
        sigma = np.where(dates < BREAK, line_sigma(label, dates, 0), line_sigma(label, dates, 1))
        drift[f"sigma_{label}"] = sigma
        drift[f"sigma_new_{label}"] = np.hypot(sigma, unit_of(label))
    return LinearSeries(Table(columns), Table(drift), vafactor, pa_v3, (BREAK,))


def lines_alone() -> list[dict]:
    return [
        {
            "segment": s,
            "term": label,
            "epoch0": EPOCH0[s],
            "alpha": ALPHA[label],
            "sigma_alpha": unit_of(label) * 0.14,
            "beta": BETA[label],
            "sigma_beta": unit_of(label) * 0.08,
        }
        for s in (0, 1)
        for label in LABELS
    ]


def lines_joint() -> list[dict]:
    numbers = {"WFC1": 1, "WFC2": 2}
    rows = []
    for row in lines_alone():
        chip, _, term = row["term"].rpartition(".")
        rows.append(row | {"term": term, "chip": numbers[chip], "alpha": row["alpha"] * (1 + 1e-7)})
    # what the gauge fixes stands there, too
    fixed = {"alpha": 0.0, "sigma_alpha": 0.0, "beta": 0.0, "sigma_beta": 0.0}
    return [*rows, fixed | {"segment": 0, "chip": 2, "epoch0": EPOCH0[0], "term": "A_1"}]


def summary() -> dict:
    return {
        "matching": {
            "n_exposures": N,
            "n_detections": 98_765,
            "n_pairs": 43_210,
            "n_catalog": 5_390,
            "n_catalog_used": 4_964,
            "completeness": {"median": 0.9734, "least": 0.9123},
            "false_fraction": 3.21e-5,
            "radius": [0.171, 0.321],
        },
        "tables": {
            "method": "field",
            "converged": True,
            "rms_before": 0.0334,
            "rms_after": 0.0175,
            "chips": [
                {"chip": c, "nodes": [4, 8], "rms": 0.04 / c, "largest": 0.18 / c,
                 "sigma_median": 0.0047 / c}
                for c in (1, 2)
            ],
        },
        "scatter": {"scale": {"value": 5.12e-6, "interval_68": [4.8e-6, 5.5e-6]}},
        "gauge": {
            "chip": 2, "fixed": ["A_1", "B_1", "A_3"], "epoch": 2004.5, "rotation": 2e-7,
            "sigma_rotation": 9e-7, "shift": [-0.0012, 0.0002], "sigma_shift": [0.0004, 0.0004],
        },
        "lines": lines_joint(),
        "time_dependence": {
            "converged": True,
            "lines": lines_alone(),
            "scatter": {label: unit_of(label) for label in LABELS},
            "outlying_exposures": ["e007"],
            "breaks": [
                {"break": BREAK, "term": label, "step": 3.7e-5, "sigma_step": 3.6e-6,
                 "slope_change": -1.4e-5, "sigma_slope_change": 9e-7}
                for label in LABELS
            ],
            "verdicts": [
                {"term": label, "claim": "no line", "text": "No line."} for label in LABELS
            ],
        },
        "exposures_skipped": {},
        "products": [
            {"path": "acs_pre_idc.fits", "kind": "IDCTAB", "findings": [], "period": "pre",
             "lost": [{"mas": 0.0123}]},
            {"path": "acs_d2i.fits", "kind": "D2IMFILE", "findings": []},
        ],
    }  # fmt: skip


def pattern(chip: int, filter: str = "") -> LookupTable:
    rng = np.random.default_rng(chip)
    values = 0.05 * rng.standard_normal((2, 4, 8))
    return LookupTable(chip, values, filter=filter, sigma=np.full((2, 4, 8), 0.0047 / chip))


def residuals_of(chip, seed: int = 4) -> TableResiduals:
    rng = np.random.default_rng([seed, chip.number])
    x, y = (rng.uniform(0.5, s + 0.5, 4000) for s in SIZE)
    noise = 0.016 * rng.standard_normal((4000, 2))
    without = noise + pattern(chip.number).evaluate(x, y)
    binned = [binned_residuals(x, y, *r.T, bins=(8, 4), size=SIZE) for r in (without, noise)]
    return TableResiduals(chip, without, noise, *binned)


def overlap(seed: int = 5) -> OverlapTest:
    """Two exposures: the old positions have a quadratic term left, the new ones noise alone."""
    rng = np.random.default_rng(seed)
    a = rng.uniform(-50, 50, (800, 2))  # arcsec
    turn = 1.00003 * np.array([[np.cos(1.2), -np.sin(1.2)], [np.sin(1.2), np.cos(1.2)]])
    b = (a - 3.0) @ turn.T
    noise = 0.001 * rng.standard_normal((800, 2))
    bent = b + np.column_stack([3e-6 * b[:, 0] ** 2, 0 * b[:, 0]])
    old, new = (
        align(*((one - one.mean(axis=0)) / 0.05 for one in (a + noise, other)))
        for other in (bent, b)
    )
    corner, binned_old, binned_new = _binned(old, new)
    return OverlapTest(
        ("e001", "e059"), (2002.5, 2014.2), (12.0, 220.0), old, new, binned_old, binned_new,
        corner, 50.0, True,
    )  # fmt: skip


def data_of(chips) -> CampaignData:
    rng = np.random.default_rng(6)
    mag = np.sort(rng.uniform(-15, -7, 3000))
    sigma = 0.008 * 10 ** (0.15 * np.maximum(mag + 10, 0))
    series = linear_series()
    matching = Table(
        {
            "exposure": series.exposures["exposure"],
            "epoch": series.epoch,
            "completeness": rng.uniform(0.95, 0.99, N),
            "false_fraction": rng.uniform(0, 1e-4, N),
            "matched": rng.integers(600, 900, N),
            "too bright": rng.integers(10, 20, N),
            "pa_v3": series.pa_v3,
            "vafactor": series.vafactor,
        }
    )
    square = np.array([[0, 0], [400, 0], [400, 300], [0, 300], [0, 0]], float)
    grid = np.linspace(-14, -10, 9)
    return CampaignData(
        filter="F606W",
        matching=matching,
        catalog=CatalogStars(mag, sigma, sigma / 10, (grid, 0.003 + 0 * grid), "pix", 4_964),
        detections=DetectionQuality(
            mag, 10 * sigma, mag < -10, 98_765, 51_234, (-14.0, -10.0), 0.1
        ),
        footprints=Footprints(
            rng.uniform(0, 900, 500),
            rng.uniform(0, 900, 500),
            tuple(square + 20 * k for k in range(2 * N)),
            np.repeat(series.epoch, 2),
            "pix",
        ),
        residuals=tuple(residuals_of(chip) for chip in chips),
        series=series,
    )


def centroids() -> MagnitudeErrors:
    """Errors of single detections."""
    grid = np.linspace(-14, -10, 9)
    width = 0.01 * 10 ** (0.1 * (grid + 14))
    return MagnitudeErrors(grid, width, width, np.full(9, 100), width, width)


@lru_cache
def campaign_run() -> SketchedRun:
    """A campaign of two chips."""
    run = report_run(size=SIZE, names=NAMES)
    chips = run.model.chips
    release = {"period": [{"name": "pre", "years": [2002, 2009.4]}]}
    return run.having(
        configuration={**run.configuration, "products": {"release": release}},
        kind=CAMPAIGN,
        errors=replace(run.errors, by_magnitude=centroids()),
        summary=summary(),
        report_data=data_of(chips),
        overlap=overlap(),
        tables=StoredLookupTables(tuple(pattern(chip.number) for chip in chips)),
    )
