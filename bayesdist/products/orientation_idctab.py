"""The orientation of a solution from an existing IDCTAB."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.solution import Solution
from bayesdist.errors import DegenerateError, InputError
from bayesdist.products.formats.idctab.hst import parity_of
from bayesdist.products.formats.idctab.table import IdcTab
from bayesdist.products.orientation import (
    Agreement,
    Orientation,
    check_epoch,
    check_frames,
    cov_about,
    held_scale,
    mirrored,
)

__all__ = ["orientation_from_idctab"]

Float = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Nodes of each axis for integrals over a chip: exact to order 19, for squares of polynomials to 9.
_NODES = 10
_MAP = (33, 17)


def orientation_from_idctab(
    solution: Solution,
    reference: IdcTab,
    *,
    chip: int = 2,
    filter: str | tuple[str, ...] | None = None,
    epoch: float | None = None,
    reference_drift: bool = True,
    scale_arcsec: float | None = None,
    scale_sigma: float = 0.0,
) -> Orientation:
    """Lay a solution on an existing IDCTAB.

    Shift, rotation and, for u, v in pixels, scale make the mean square distance between the two
    maps smallest over the area of the chip.  A fit over the whole chip is used, not the linear
    terms at the reference pixel: each pixel then counts alike, and a term that one table has and
    the other has not, or a poorly measured fifth order, cannot tilt the whole.  Where the two maps
    differ by a similarity only, both ways give the same.

    Parameters
    ----------
    solution : Solution
        Without exposure frames.
    reference : IdcTab
    chip : int
        The chip that is laid on its counterpart; the others follow from the fit.
    filter : str or tuple of str, optional
        Row of the reference; needed where its rows differ.
    epoch : float, optional
        Decimal years at which the two are compared; needed by a model with time dependence.
    reference_drift : bool
        Whether the reference's time-dependent terms are applied at `epoch`.
    scale_arcsec : float, optional
        Arcseconds in one unit of u, v, held.  Without it the scale is fitted for u, v in pixels,
        and is that of the unit for others.
    scale_sigma : float
        Standard deviation of a held scale, arcseconds in one unit of u, v.

    Returns
    -------
    Orientation

    Raises
    ------
    InputError
        For a model with exposure frames, a chip or filter that is not there, a chip of another
        size, a missing epoch, a drift of the reference that cannot be evaluated, a scale that is
        not positive, or u, v mirrored against x, y.

    Notes
    -----
    What the fit leaves is a field of 2 K - 4 free coefficients (K terms of one axis).  The
    four that it cannot see are given the mean variance of those it can: the reference may be as
    wrong in its roll and scale as it is, on average, in any other single term.  White noise on the
    same pixels would make them known far too well.
    """
    model = solution.model
    check_frames(solution)
    code = model.chip_code(chip)
    size = model.chips[code].size
    parity_of(reference.instrument, reference.detector)
    row = reference.rows[reference.row(chip, filter)]
    if (float(row["XSIZE"]), float(row["YSIZE"])) != (float(size[0]), float(size[1])):
        raise InputError(
            f"chip {chip} has {int(row['XSIZE'])} x {int(row['YSIZE'])} pixels and the solution "
            f"{size[0]:g} x {size[1]:g}",
            where=reference.name,
            do="give a reference of the same detector",
        )
    check_epoch(solution, epoch)
    then = epoch if reference_drift and reference.is_acs_wfc else None
    if then is not None and reference.tdd_scheme != "2015":
        raise InputError(
            f"the reference's time-dependent terms are of the scheme {reference.tdd_scheme!r}",
            where=reference.name,
            do="give a table with TDD_DATE and TDD_CTB1, or leave its drift out (reference_drift)",
        )

    def ours_at(x: Float, y: Float) -> Complex:
        return _complex(model.predict(solution.mean, x, y, epoch=epoch, chip=chip))

    def theirs_at(x: Float, y: Float) -> Complex:
        Xc, Yc = reference.evaluate(chip, x, y, filter=filter, epoch=then)
        return Xc + 1j * Yc

    x, y, weight = _quadrature(size)
    ours, theirs = ours_at(x, y), theirs_at(x, y)
    slopes = _complex(
        np.swapaxes(model.jacobian(solution.mean, x, y, epoch=epoch, chip=chip), 1, 2)
    )
    centre_z, centre_w = weight @ ours, weight @ theirs
    z, w = ours - centre_z, theirs - centre_w
    S, Q = np.sum(weight * np.conj(z) * w), float(np.sum(weight * np.abs(z) ** 2))
    _check_handed(S, Q, z, w, weight, reference.name)
    dS = (weight * w) @ np.conj(slopes)
    held = held_scale(model.unit, scale_arcsec)
    if held is None:
        b = S / Q
        d_log = (dS / Q - b * 2 * np.real((weight * np.conj(z)) @ slopes) / Q) / b
    else:
        b = held * S / abs(S)
        d_log = 1j * np.imag(dS / S)
    shift = centre_w - b * centre_z
    d_shift = -b * d_log * centre_z - b * (weight @ slopes)

    agreement = _agreement(size, lambda x, y: theirs_at(x, y) - shift - b * ours_at(x, y))
    K = (max(model.order, reference.norder) + 1) * (max(model.order, reference.norder) + 2) // 2
    n_free = 2 * K - (4 if held is None else 3)
    variance = (1e-3 * agreement.rms) ** 2 / n_free
    angular = variance / (abs(b) ** 2 * Q)
    log_scale = angular if held is None else (scale_sigma / held) ** 2
    return Orientation(
        angle=float(np.angle(b)),
        scale=float(abs(b)) if held is None else held,
        shift=np.array([shift.real, shift.imag]),
        v2v3=(float(row["V2REF"]), float(row["V3REF"])),
        reference_cov=cov_about(b * centre_z, variance, log_scale, angular),
        derivative=np.stack([d_shift.real, d_shift.imag, d_log.real, d_log.imag]),
        base=solution,
        source=f"chip {chip} laid on {reference.name.rpartition('/')[2]}"
        + ("" if epoch is None else f" at {epoch:g}"),
        agreement=agreement,
    )


def _check_handed(S: complex, Q: float, z: Complex, w: Complex, weight: Float, where: str) -> None:
    """A mirrored map correlates with the conjugate instead."""
    if Q == 0 or S == 0:
        raise DegenerateError(
            "the solution maps the chip to one point", where=where, do="check its linear terms"
        )
    if abs(np.sum(weight * z * w)) > abs(S):
        raise mirrored(where)


def _complex(pairs: ArrayLike) -> Complex:
    pairs = np.asarray(pairs, float)
    return pairs[..., 0] + 1j * pairs[..., 1]


def _quadrature(size: tuple[float, float]) -> tuple[Float, Float, Float]:
    """Pixels and weights whose sums are means over the area of a chip."""
    t, q = legendre.leggauss(_NODES)
    x, y = ((n + 1) / 2 + n / 2 * t for n in size)
    X, Y = np.meshgrid(x, y)
    return X.ravel(), Y.ravel(), np.outer(q, q).ravel() / 4


def _agreement(
    size: tuple[float, float], difference: Callable[[Float, Float], Complex]
) -> Agreement:
    """Over a chip, from reference minus solution [arcsec] at any pixels."""
    axes = [np.linspace(1, n, m) for n, m in zip(size, _MAP, strict=True)]
    x, y = (g.ravel() for g in np.meshgrid(*axes))
    left = 1e3 * difference(x, y)
    nodes_x, nodes_y, weight = _quadrature(size)
    return Agreement(
        rms=1e3 * float(np.sqrt(weight @ np.abs(difference(nodes_x, nodes_y)) ** 2)),
        worst=float(np.abs(left).max()),
        x=x,
        y=y,
        difference=np.stack([left.real, left.imag], axis=1),
    )
