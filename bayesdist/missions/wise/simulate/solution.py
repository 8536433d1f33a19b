"""Published distortion of a band as a model, and pairs with the errors of W2 that follow it."""

from __future__ import annotations

import os
from functools import partial

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.missions.wise.published import SAMPLE_SIZES, WISE_ARRAYS, WISE_COEFFICIENTS
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate.matches import Truth, simulate_matches, simulate_partitioned
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Random, generator_of

FAINT, BRIGHT = 14.5, 7.0


def wise_solution(band: str = "W2") -> tuple[DistortionModel, Float]:
    """Published distortion of a band as a model and its parameters.

    Parameters
    ----------
    band : str
        'W1', 'W2', 'W3' or 'W4'.

    Returns
    -------
    model : DistortionModel
        Order 4; u, v are distortion-free band-frame pixels.
    theta : ndarray, shape (30,)

    Raises
    ------
    InputError
        For another band.

    Examples
    --------
    >>> from bayesdist.missions.wise import wise_solution
    >>> model, theta = wise_solution("W4")
    >>> model.order, theta.shape
    (4, (30,))
    """
    if band not in WISE_COEFFICIENTS:
        raise InputError(
            f"there is no band {band!r}", where="band", do=f"choose {', '.join(WISE_COEFFICIENTS)}"
        )
    array = WISE_ARRAYS[band]
    model = DistortionModel(4, (Chip(1, band, array.size, array.centre),))
    theta = np.empty(model.n_params)
    for axis, sip in enumerate(WISE_COEFFICIENTS[band]):
        # SIP: the corrected offset from the reference pixel is the raw one plus the polynomial
        monomial = np.array(sip)
        monomial[0] += array.centre[axis]
        monomial[1 + axis] += 1.0  # the terms x and y follow the constant
        theta[model.coefficient_slice(None, axis)] = model.basis().from_monomials(monomial)
    return model, theta


def _errors(mag: Float) -> tuple[Float, Float]:
    """Quoted error of a pair: a floor, and photon noise towards the faint end, in pixels."""
    sigma = np.hypot(0.03, 0.12 * 10 ** (0.3 * (mag - FAINT)))
    return sigma, 1.1 * sigma  # pairs are measured a little worse along the scan


def simulate_wise(
    n: int = 6000,
    *,
    band: str = "W2",
    rng: Random,
    fraction: float = 0.03,
    jitter: float = 0.03,
    outlier_scale: float = 1.0,
) -> tuple[Matches, Truth]:
    """Pairs of WISE detections and 2MASS stars, in memory.

    All bands have the magnitudes and errors of W2; sets of full size with those of each band are
    written by `write_wise_set`.

    Parameters
    ----------
    n : int
    band : str
    rng : int or numpy.random.Generator
        Seed, or source of the random numbers.
    fraction : float
        Fraction of false matches.
    jitter : float
        Error beyond the quoted ones, in pixels: the partition of the point-spread function
        (section 5 of the report) leaves residuals of this size.
    outlier_scale : float
        Standard deviation of false matches on each axis, in pixels.

    Returns
    -------
    matches : Matches
    truth : Truth

    Raises
    ------
    InputError
        For another band, and as `simulate_matches`.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, truth = simulate_wise(400, band="W2", rng=np.random.default_rng(1))
    >>> len(matches), matches.unit
    (400, 'pix')
    """
    rng = generator_of(rng)
    model, theta = wise_solution(band)
    # star counts rise as 10^(0.3 m)
    p = rng.uniform(size=n)
    low, high = 10 ** (0.3 * BRIGHT), 10 ** (0.3 * FAINT)
    mag = np.log10(low + p * (high - low)) / 0.3
    return simulate_matches(
        model,
        theta,
        n,
        rng=rng,
        sigma=_errors,
        mag=mag,
        fraction=fraction,
        jitter=jitter,
        outlier_scale=outlier_scale,
    )


def simulate_wise_partitioned(
    folder: str | os.PathLike[str],
    n: int = SAMPLE_SIZES["W2"],
    *,
    band: str = "W2",
    rng: Random,
    fraction: float = 0.03,
    jitter: float = 0.03,
    outlier_scale: float = 1.0,
) -> Truth:
    """Pairs of WISE detections and 2MASS stars, written to a folder of Parquet files as they come.

    Up to a million pairs are those of `simulate_wise`.

    Parameters
    ----------
    folder : path-like
        As `write_partitioned`.
    n : int, optional
    band, rng, fraction, jitter, outlier_scale
        As `simulate_wise`.

    Returns
    -------
    Truth
        `false` has one byte for each pair, in the order of the files.

    Raises
    ------
    InputError
        As `simulate_wise` and `write_partitioned`.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise_partitioned
    >>> truth = simulate_wise_partitioned("pairs", 400, rng=np.random.default_rng(1))
    >>> bd.open_matches("pairs").n_rows
    400
    """
    simulate = partial(
        simulate_wise,
        band=band,
        rng=generator_of(rng),
        fraction=fraction,
        jitter=jitter,
        outlier_scale=outlier_scale,
    )
    return simulate_partitioned(folder, n, simulate)
