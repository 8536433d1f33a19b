"""The linear fit against numpy.linalg.lstsq and astropy's fit_wcs_from_points.

Seconds are compared only where the answers are close: astropy's optimiser may stop short of the
solution of lstsq, which weighs and rejects as little as it does.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayesdist as bd
from tests.benchmarks import child
from tests.benchmarks.plain import legendre_design
from tests.benchmarks.problem import SIGMA, simulated
from tests.benchmarks.timing import median, say

__all__ = ["FULL", "QUICK", "Sizes", "astropy_seconds", "run"]

PIXEL = 0.05 / 3600  # degrees
POINTING = (30.0, -20.0)


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    orders: tuple[int, ...]  # 2 or more: SIP has no linear terms
    stars: tuple[int, ...]
    astropy_s: float


FULL = Sizes(orders=(4,), stars=(10_000, 100_000), astropy_s=60)
QUICK = Sizes(orders=(2,), stars=(500,), astropy_s=60)


def astropy_seconds(n: int, order: int) -> dict[str, Any]:
    """Seconds of one call of astropy.wcs.utils.fit_wcs_from_points on the simulated pairs."""
    import astropy.units as units
    from astropy.coordinates import SkyCoord
    from astropy.wcs import WCS
    from astropy.wcs.utils import fit_wcs_from_points

    problem = simulated(n, order)
    m = problem.matches
    plane = WCS(naxis=2)
    plane.wcs.crpix = 0.0, 0.0
    plane.wcs.cdelt = -PIXEL, PIXEL
    plane.wcs.crval = POINTING
    plane.wcs.ctype = "RA---TAN", "DEC--TAN"
    sky = plane.pixel_to_world(m.u - 1, m.v - 1)
    centre = SkyCoord(*POINTING, unit=units.deg)
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = fit_wcs_from_points((m.x - 1, m.y - 1), sky, proj_point=centre, sip_degree=order)
    took = time.perf_counter() - start
    # back in the plane of the data, where the other fits have their residuals
    u, v = plane.world_to_pixel(found.pixel_to_world(m.x - 1, m.y - 1))
    design, data = legendre_design(m.x, m.y, order), np.column_stack([m.u, m.v])
    solution = design @ np.linalg.lstsq(design, data)[0]
    apart = np.column_stack([u + 1, v + 1]) - solution
    return {"seconds": took, "apart": float(np.sqrt((apart**2).sum(axis=1).mean()))}


def run(sizes: Sizes) -> dict[str, Any]:
    """Seconds of each, and how far the answers differ.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    rows = []
    for order in sizes.orders:
        stopped = False
        for n in sizes.stars:
            row = _library_and_lstsq(n, order)
            found = None
            if not stopped:
                found = child.call("linear", "astropy_seconds", sizes.astropy_s, n=n, order=order)
                stopped = found is None
            row |= _beside(found, sizes.astropy_s)
            rows.append(row)
            theirs = row["design_s"] + row["lstsq_s"]
            say(
                f"linear fit: order {order}, N = {n:,}: {row['fit_linear_s']:.4f} s, "
                f"lstsq {theirs:.4f} s, astropy {row['astropy_s']}"
            )
    return {"rows": rows}


def _library_and_lstsq(n: int, order: int) -> dict[str, Any]:
    """Seconds of the library's fit and of lstsq."""
    problem = simulated(n, order)
    m, model = problem.matches, problem.model
    data = np.column_stack([m.u, m.v])
    bd.fit_linear(m, model)  # compiled
    design = legendre_design(m.x, m.y, order)
    return {
        "order": order,
        "n_stars": n,
        "fit_linear_s": median(lambda: bd.fit_linear(m, model), 5),
        "fit_linear_unclipped_s": median(
            lambda: bd.fit_linear(m, model, rejection=bd.Rejection(np.inf, None)), 5
        ),
        "design_s": median(lambda: legendre_design(m.x, m.y, order), 5),
        "lstsq_s": median(lambda: np.linalg.lstsq(design, data), 5),
        "coefficients_differ": _difference(problem, design),
    }


def _beside(found: dict[str, Any] | None, limit: float) -> dict[str, Any]:
    """astropy's part of a row."""
    if found is None:
        flag = f"no answer within {limit:g} s here or with fewer stars"
        return {"astropy_s": None, "astropy_close": None, "flags": [flag]}
    close = found["apart"] < SIGMA
    return {
        "astropy_s": found["seconds"],
        "astropy_apart": found["apart"],
        "astropy_close": close,
        "flags": [] if close else ["astropy stops short of the solution"],
    }


def _difference(problem: Any, design: np.ndarray) -> float:
    """Largest difference of coefficients from lstsq with the same weights, in formal sigmas."""
    m, K = problem.matches, design.shape[1]
    fit = bd.fit_linear(m, problem.model, rejection=bd.Rejection(np.inf, None))
    theirs = [
        np.linalg.lstsq(design / s[:, None], value / s)[0]
        for value, s in ((m.u, m.sigma_u), (m.v, m.sigma_v))
    ]
    apart = np.abs(fit.mean - np.concatenate(theirs)) / fit.sigma
    assert len(apart) == 2 * K
    return float(apart.max())
