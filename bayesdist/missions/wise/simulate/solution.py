"""Published distortion of a band as a model, and simulated pairs with the errors of W2."""

from __future__ import annotations

import os
from functools import partial

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.missions.wise.published import SAMPLE_SIZES, WISE_ARRAYS, WISE_COEFFICIENTS
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import Truth, simulate_matches, simulate_partitioned
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Random, generator_of

FAINT, BRIGHT = 14.5, 7.0  # magnitude limits


def wise_solution(band: str = "W2") -> tuple[DistortionModel, Float]:
    """Published distortion of a band as a model and its parameters.

    Parameters
    ----------
    band : str
        'W1', 'W2', 'W3' or 'W4'.

    Returns
    -------
    model : DistortionModel
        Model of order 4; u and v are in distortion-free band-frame pixels.
    theta : ndarray, shape (30,)
        Published parameters.

    Raises
    ------
    InputError
        If the band is unknown.

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
        # SIP: corrected offset from the reference pixel = raw offset + polynomial
        monomial = np.array(sip)
        monomial[0] += array.centre[axis]
        monomial[1 + axis] += 1.0  # the terms x and y follow the constant
        theta[model.coefficient_slice(None, axis)] = model.basis().from_monomials(monomial)
    return model, theta


def _errors(mag: Float) -> tuple[Float, Float]:
    """Quoted errors of pairs in pixels: a floor, and photon noise for faint stars."""
    sigma = np.hypot(0.03, 0.12 * 10 ** (0.3 * (mag - FAINT)))
    return sigma, 1.1 * sigma  # errors are slightly larger along the scan


def simulate_wise(
    n: int = 6000,
    *,
    band: str = "W2",
    rng: Random,
    fraction: float = 0.03,
    jitter: float = 0.03,
    outlier_scale: float = 1.0,
) -> tuple[Matches, Truth]:
    """Simulate pairs of WISE detections and 2MASS stars in memory.

    All bands have the magnitudes and errors of W2.  For sets of the published size, with the
    magnitudes and errors of each band, use `write_wise_set`.

    Parameters
    ----------
    n : int
        Number of pairs.
    band : str
        'W1' to 'W4'.
    rng : int or numpy.random.Generator
        Seed or random generator.
    fraction : float
        Fraction of false matches.
    jitter : float
        Error per axis in pixels that is added in quadrature to the quoted errors.  The default is
        the size of the residuals due to the partition of the point-spread function (section 5 of
        the report).
    outlier_scale : float
        Standard deviation per axis of the offsets of false matches, in pixels.

    Returns
    -------
    matches : Matches
    truth : Truth

    Raises
    ------
    InputError
        If the band is unknown or an argument is invalid (see `simulate_matches`).

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, truth = simulate_wise(400, band="W2", rng=np.random.default_rng(1))
    >>> len(matches), matches.unit
    (400, 'pix')
    """
    rng = generator_of(rng)
    model, theta = wise_solution(band)
    # star counts increase as 10^(0.3 m)
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
    """Simulate pairs of WISE detections and 2MASS stars in a folder of Parquet files.

    The pairs are simulated in chunks of up to a million by `simulate_wise`.

    Parameters
    ----------
    folder : path-like
        Folder for the files; see `write_partitioned`.
    n : int, optional
        Number of pairs.
    band, rng, fraction, jitter, outlier_scale
        See `simulate_wise`.

    Returns
    -------
    Truth
        Truth, with `false` for all pairs in the order of the files.

    Raises
    ------
    InputError
        If `simulate_wise` or `write_partitioned` raise it.

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
