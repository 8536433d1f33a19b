"""Test for matches that are missing at large radii: residuals that end too abruptly.

Matching takes no pair beyond its radius.  Where that cuts into the true matches, their residuals
are too small: the errors seem too large, chi-square is too small, and so is the scatter that
everything else is judged by.  Errors that are merely quoted too large shrink all residuals alike;
so the scale of the residuals is taken from themselves, and the question is how many of them should
lie beyond the last ones that there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from bayesdist.diagnose.projection import Projection
from bayesdist.diagnose.result import Outcome

__all__ = ["truncation_test"]

Float = NDArray[np.float64]

FEWEST_STARS = 50
FEW = 0.5  # expected matches whose absence says nothing
BEYOND = (0, 3)  # stars that may lie beyond a radius: the edge need not be sharp
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
ANGLES = (np.arange(8) + 0.5) * np.pi / 16  # of a quarter of the circle


@dataclass(frozen=True, eq=False)
class _Deficit:
    """True matches expected beyond a radius, and detections that are there.

    Parameters
    ----------
    expected : float
    beyond : int
    radius : float
    unit : str
    spread : float
        Standard deviation of the logarithm of `expected`, as the scale is not known exactly.
    """

    expected: float
    beyond: int
    radius: float
    unit: str
    spread: float

    @property
    def p_value(self) -> float:
        """Probability of so few, over what the scale may be."""
        if self.expected < FEW:
            return 1.0
        at = self.expected * np.exp(self.spread * NODES)
        chance = special.gammaincc(self.beyond + 1, at)
        return float(WEIGHTS @ chance / WEIGHTS.sum())


def truncation_test(projection: Projection, match_radius: float | None = None) -> Outcome | None:
    """Test for true matches missing beyond some radius.

    Parameters
    ----------
    projection : Projection
    match_radius : float, optional
        In the unit of u and v.

    Returns
    -------
    Outcome or None
        None for less than `FEWEST_STARS` true matches.
    """
    sample = projection.sample
    inlier = sample.inlier
    n = float(inlier.sum())
    if n < FEWEST_STARS:
        return None
    # given back what the fit has taken of them
    variance = sample.variance * (1.0 - projection.leverage)
    square = sample.residual**2 / variance
    t = square.mean(axis=0)
    scale2 = float(inlier @ t) / n
    spread2 = float(inlier @ (t - scale2) ** 2) / n
    relative = float(np.sqrt(spread2 / n)) / scale2
    variance = variance * scale2
    found = [
        *_in_sigmas(t / scale2, n, relative),
        *_along_an_axis(square.max(axis=0) / scale2, n, relative),
        *_in_units(projection, variance, relative, match_radius),
    ]
    worst = min(found, key=lambda one: (one.p_value, -one.expected))
    sigma = float(np.sqrt(np.median(variance)))
    end = float(t.max()) / scale2
    radius = f"{worst.radius:.3g} {worst.unit}"
    return Outcome(
        name="truncation",
        statistic=worst.expected,
        dof=1,
        dof_residual=None,
        p_value=min(1.0, len(found) * worst.p_value),
        size=sigma * _lost(end),
        smallest=partial(_smallest, sigma, n, len(found)),
        unit=sample.model.unit,
        remedy="match again with a wider radius",
        present=f"the residuals end too abruptly: {worst.expected:.3g} true matches are expected "
        f"beyond {radius}, and there are {worst.beyond}, so that the matching has cut the "
        f"scatter, and chi-square ({scale2:.2g} of each degree of freedom) says nothing of the "
        "quoted errors",
        absent="the residuals do not end abruptly",
    )


def _in_sigmas(t: Float, n: float, relative: float) -> list[_Deficit]:
    """Deficits by the radius in units of the errors: half its square is exponential."""
    out = []
    for k in BEYOND:
        end = float(np.partition(t, -k - 1)[-k - 1])
        out.append(_Deficit(n * np.exp(-end), k, np.sqrt(2 * end), "sigma", relative * end))
    return out


def _along_an_axis(square: Float, n: float, relative: float) -> list[_Deficit]:
    """Deficits by the larger of both axes, as a match in a square leaves them."""
    out = []
    for k in BEYOND:
        end = float(np.partition(square, -k - 1)[-k - 1])
        tail = special.erfc(np.sqrt(end / 2))
        expected = n * (2 * tail - tail**2)
        out.append(
            _Deficit(float(expected), k, np.sqrt(end), "sigma along an axis", relative * end / 2)
        )
    return out


def _in_units(
    projection: Projection, variance: Float, relative: float, match_radius: float | None
) -> list[_Deficit]:
    """Deficits by the radius itself, whatever the errors of each star are."""
    sample = projection.sample
    radius2 = (sample.residual**2).sum(axis=0)
    ends = [(k, float(np.partition(radius2, -k - 1)[-k - 1])) for k in BEYOND]
    if match_radius is not None:
        ends.append((int((radius2 > match_radius**2).sum()), match_radius**2))
    out = []
    for k, end in ends:
        tail = _tail(variance, end)
        expected = float(sample.inlier @ tail)
        # by how much the expected number goes with the scale
        slope = float(sample.inlier @ (tail * end / variance.sum(axis=0)))
        spread = relative * slope / max(expected, 1e-300)
        out.append(_Deficit(expected, k, np.sqrt(end), sample.model.unit, spread))
    return out


def _tail(variance: Float, radius2: float) -> Float:
    """Probability (N,) of a residual beyond a radius, by the variances (2, N) along both axes."""
    u, v = variance
    if np.allclose(u, v, rtol=1e-3):
        return np.asarray(np.exp(-radius2 / (u + v)))
    out = np.zeros(len(u))
    for angle in ANGLES:
        inverse = np.cos(angle) ** 2 / u + np.sin(angle) ** 2 / v
        out += np.exp(-radius2 / 2 * inverse) / inverse
    return out / (len(ANGLES) * np.sqrt(u * v))


def _lost(end: float) -> float:
    """Scatter along an axis that was cut off, in units of what is left.

    Parameters
    ----------
    end : float
        Half the square of the radius in units of the scatter that is left.
    """
    # mean of an exponential of scale s cut at `end`: s - end / (exp(end / s) - 1) = 1
    if end <= 2.0:  # as flat a distribution as there is
        return 1.0

    def mean(s: float) -> float:
        return s - end / np.expm1(min(end / s, 700.0)) - 1.0

    s = optimize.brentq(mean, 1.0, 50.0) if mean(50.0) > 0 else 50.0
    return float(np.sqrt(max(s - 1.0, 0.0)))


def _smallest(sigma: float, n: float, several: int, level: float) -> float:
    """Scatter that is lost where just so many stars are as have to be missed."""
    expected = -np.log(level / several)
    if expected >= n:
        return sigma
    end = np.log(n / expected)
    return float(sigma * np.sqrt(end / np.expm1(end)))
