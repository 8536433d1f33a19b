"""Gauss-Newton iteration over the exposure frames, by re-expanding the normal equations."""

from __future__ import annotations

import numpy as np

from bayesdist.errors import DegenerateError
from bayesdist.infer.equations.normal import NormalEquations
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.rank import require_full_rank
from bayesdist.model import DistortionModel
from bayesdist.model.frames import nearest_frame
from bayesdist.utils.arrays import Float

RELINEARISED = 1e-7  # pixels: the iteration stops when the solution moves less than this
STALLED = 1e-4  # formal errors: smaller steps that do not shrink are due to rounding
FLAT = 1e-12  # limit on |determinant| of a linear map, relative to its largest element squared
TURNS = 50  # maximum number of iterations


def starting_point(first: NormalEquations, model: DistortionModel, priors: GaussianPriors) -> Float:
    """Starting parameters: frames from linear fits, then polynomials with these frames fixed."""
    groups = first.groups
    theta = np.zeros(model.n_params)
    if model.n_frame:
        _start_frames(first, theta, model)
    held = first.moved(model.effective(theta, groups))
    matrix, right = held.assemble(model, theta)
    prior = priors.matrix(model)
    n = model.n_distortion
    theta[:n] = np.linalg.lstsq(
        (matrix.border + prior.border)[:n, :n], (right + priors.pull(theta))[:n], rcond=1e-13
    )[0]
    for chip in model.chips:
        basis = model.basis(chip.number)
        rows = basis.monomial_matrix[[basis.terms.index(term) for term in ((1, 0), (0, 1))]]
        linear = [rows @ theta[model.coefficient_slice(chip.number, axis)] for axis in (0, 1)]
        _refuse_flat(np.stack(linear), chip.number)
    return theta


def _refuse_flat(linear: Float, chip: int) -> None:
    """Raise DegenerateError if a linear map (2, 2) maps a chip onto a line or a point in u, v."""
    if abs(np.linalg.det(linear)) <= FLAT * np.abs(linear).max() ** 2:
        raise DegenerateError(
            f"the positions u, v of chip {chip} lie on a line or in one point",
            where="u, v",
            do="check which columns have the reference positions, and that they are filled in",
        )


def _start_frames(first: NormalEquations, theta: Float, model: DistortionModel) -> None:
    """Set the frames in `theta` from linear fits to each exposure and chip.

    The linear map of each chip comes from the first exposure with a known frame, starting with
    exposure 0.  The frame of an exposure follows from any chip with a known linear map.
    """
    groups, o = first.groups, np.asarray(model.origin)
    affine = np.array([_affine(w, r) for w, r in zip(first.weight, first.right, strict=True)])
    of_chip: dict[int, Float] = {}  # constant and linear coefficients (2, 3) without the frame

    def enter(e: int) -> None:
        """Store the linear maps of the chips of an exposure, using its frame in `theta`."""
        M, d = model.frame(theta, e)
        for g in np.flatnonzero(groups.exposure == e):
            if int(groups.chip[g]) not in of_chip and np.isfinite(affine[g]).all():
                back = np.linalg.solve(M, affine[g] - np.column_stack([o + d, np.zeros((2, 2))]))
                back[:, 0] += o
                of_chip[int(groups.chip[g])] = back

    enter(0)
    waiting = list(range(1, len(model.exposures)))
    while waiting:
        unplaced = []
        for e in waiting:
            for g in np.flatnonzero(groups.exposure == e):
                w = of_chip.get(int(groups.chip[g]))
                if w is not None and np.isfinite(affine[g]).all():
                    _refuse_flat(w[:, 1:], model.chips[groups.chip[g]].number)
                    M = affine[g][:, 1:] @ np.linalg.inv(w[:, 1:])
                    d = affine[g][:, 0] - o - M @ (w[:, 0] - o)
                    frame = nearest_frame(model.frames, M, d)
                    theta[model.frame_slice(e)][: len(frame)] = frame
                    enter(e)
                    break
            else:
                unplaced.append(e)
        if len(unplaced) == len(waiting):
            return
        waiting = unplaced


def refuse_absorbed_drift(
    equations: NormalEquations,
    theta: Float,
    model: DistortionModel,
    priors: GaussianPriors,
) -> None:
    """Raise DegenerateError if the exposure frames absorb the drift of the linear terms.

    The test uses the linear part of the model only, for which such a degeneracy is exact.  With
    higher orders it is not exact, and the fit would converge to meaningless values.
    """
    if model.time is None or not model.n_frame:
        return
    flat = np.zeros_like(theta)
    for chip in model.chips:
        for axis in (0, 1):
            part = model.coefficient_slice(chip.number, axis)
            flat[part][:3] = theta[part][:3]
    matrix, _ = equations.assemble(model, flat)
    require_full_rank(matrix + priors.matrix(model), model, equations.groups)


def _affine(weight: Float, right: Float) -> Float:
    """Constant and linear coefficients (2, 3) of a group by itself; NaN if undetermined."""
    out = np.full((2, 3), np.nan)
    for axis, pair in ((0, 0), (1, 2)):
        W = weight[pair][:3, :3]
        singular_values = np.linalg.svd(W, compute_uv=False)  # descending
        if singular_values[-1] > 1e-10 * singular_values[0]:
            out[axis] = np.linalg.solve(W, right[axis][:3])
    return out


def gauss_newton(
    equations: NormalEquations,
    theta: Float,
    model: DistortionModel,
    priors: GaussianPriors,
) -> Float:
    """Solve the normal equations by Gauss-Newton, starting from `theta` (n_params,).

    The equations are re-expanded about each iterate without another pass over the data.  Raises
    DegenerateError if the parameters are degenerate or the iteration does not converge.
    """
    groups = equations.groups
    prior = priors.matrix(model)
    about = model.effective(theta, groups)
    decrement = np.inf
    for _ in range(TURNS):
        matrix, right = equations.moved(about).assemble(model, theta)
        matrix, pull = matrix + prior, right + priors.pull(theta)
        try:
            step = matrix.factor().solve(pull)
        except np.linalg.LinAlgError:
            require_full_rank(matrix, model, groups)
            raise
        theta = theta + step
        before, about = about, model.effective(theta, groups)
        moved = np.abs(about - before).sum(axis=2).max()
        if moved < RELINEARISED * model.pixel_size(theta):
            return theta
        # Where there are no stars, rounding alone moves high orders by more than that. Then the
        # step in formal errors decides. Without frames the problem is linear, so that steps after
        # the first are rounding.
        last, decrement = decrement, float(pull @ step)
        if decrement >= last / 4 and (not model.n_frame or decrement < STALLED**2):
            return theta
    raise DegenerateError(
        f"the exposure frames did not settle in {TURNS} iterations",
        where="fit",
        do="check that the exposures overlap and are not mirrored, lower model.order"
        + ("" if model.frames == "affine" else ", or set model.frames = 'affine'"),
    )
