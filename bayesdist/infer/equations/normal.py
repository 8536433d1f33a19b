"""Normal equations as sums over groups of stars, accumulated in chunks, and their rank.

Within a group the model is a single polynomial, so the data enter only through the moments of the
basis functions.  Partial sums over chunks of the data can be added.  Since positions are linear in
the effective coefficients, the equations can be re-expanded about other coefficients exactly and
without the data.  Gauss-Newton over the exposure frames therefore needs no further pass.

Parameters that the data do not determine are found, by name and with the reason, before the
equations are solved, because solving a degenerate least-squares problem returns numbers without
any warning.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from bayesdist.errors import DegenerateError
from bayesdist.infer import kernel
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.kernel import Constants
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.shards import Survey
from bayesdist.infer.stars.stars import Stars, Sums
from bayesdist.model import DistortionModel, Groups
from bayesdist.model.frames import DEVIATIONS, FRAME_KINDS, frame_names, nearest_frame
from bayesdist.utils.arrays import Float

RELINEARISED = 1e-7  # pixels: the iteration stops when the solution moves less than this
STALLED = 1e-4  # formal errors: smaller steps that do not shrink are due to rounding
FLAT = 1e-12  # limit on |determinant| of a linear map, relative to its largest element squared
TURNS = 50  # maximum number of iterations


@dataclass(frozen=True, eq=False)
class NormalEquations(Sums):
    """Sums over G groups of stars that form the normal equations for K polynomial terms.

    Sums over different stars of a group can be added if they have the same `about`.
    """

    weight: Float  # sum (G, 3, K, K) of w phi phi^T for the axis pairs uu, uv, vv
    right: Float  # sum (G, 2, K) of phi (W r), with r the residual at `about`
    about: Float  # effective coefficients (G, 2, K) at which r is computed
    chi2: float  # sum of r^T W r
    cross: Float  # mixed second derivatives (G, h, 2, K) with h additional parameters
    scalars: Float  # additional sums over the stars, documented by the kernel that computes them
    groups: Groups

    BY_GROUP = ("weight", "right", "cross")
    OF_GROUP = ("about",)

    def moved(self, about: Float) -> NormalEquations:
        """Re-expand about other effective coefficients (G, 2, K); exact, and without the data."""
        step = about - self.about
        pull = self._apply(step)
        chi2 = self.chi2 - 2 * float((self.right * step).sum()) + float((pull * step).sum())
        return replace(self, right=self.right - pull, about=about, chi2=chi2)

    def _apply(self, E: Float) -> Float:
        uu, uv, vv = self.weight[:, 0], self.weight[:, 1], self.weight[:, 2]
        u = np.einsum("gkl,gl->gk", uu, E[:, 0]) + np.einsum("gkl,gl->gk", uv, E[:, 1])
        v = np.einsum("gkl,gl->gk", uv, E[:, 0]) + np.einsum("gkl,gl->gk", vv, E[:, 1])
        return np.stack([u, v], axis=1)

    def assemble(self, model: DistortionModel, theta: Float) -> tuple[Arrow, Float]:
        """Normal matrix and right-hand side (n_params,) for the model's parameters.

        The model is linearised at `theta` (n_params,); its effective coefficients must be `about`.
        The h additional parameters form the tail of the matrix, with the mixed derivatives `cross`
        and zeros elsewhere.
        """
        G, q, h = model.n_global, model.n_frame, self.cross.shape[1]
        n_blocks = len(model.local_blocks)
        border = np.zeros((G + h, G + h))
        edge = np.zeros((n_blocks, G + h, q))
        blocks = np.zeros((n_blocks, q, q))
        right = np.zeros(model.n_params)
        tail = slice(G, G + h)
        for rows, columns, d in model.jacobian_blocks(theta, self.groups):
            du, dv = d[:, 0], d[:, 1]
            uu, uv, vv = np.moveaxis(self.weight[rows], 1, 0)
            H = du.mT @ (uu @ du + uv @ dv) + dv.mT @ (uv @ du + vv @ dv)
            np.add.at(right, columns, np.einsum("nakm,nak->nm", d, self.right[rows]))
            X = np.einsum("nhak,nakm->nhm", self.cross[rows], d)
            n, m = int((columns[0] < G).sum()), columns.shape[1]
            glob = columns[0, :n]
            border[np.ix_(glob, glob)] += H[:, :n, :n].sum(axis=0)
            across = X[:, :, :n].sum(axis=0)
            border[tail, glob] += across
            border[glob, tail] += across.T
            if n < m:
                # groups are sorted by exposure; an exposure may have several of them (chips, dates)
                e, first = divmod(columns[:, n] - G, q)
                local = columns[0, n:] - columns[0, n] + first[0]
                at, starts = np.unique(e, return_index=True)
                by_local = np.concatenate([H[:, :, n:], X[:, :, n:]], axis=1)
                of_exposure = np.add.reduceat(by_local, starts)
                edge[np.ix_(at, glob, local)] += of_exposure[:, :n]
                edge[np.ix_(at, np.r_[tail], local)] += of_exposure[:, m:]
                blocks[np.ix_(at, local, local)] += of_exposure[:, n:m]
        return Arrow(border, edge, blocks, n_tail=h, parts=model.chip_of_global), right


def least_squares(
    stars: Stars,
    about: Float | None,
    clip: Clip | None = None,
    corner: float = 1.0,
    power: int = 1,
) -> NormalEquations:
    """Accumulate the normal equations of weighted least squares in one pass over the stars.

    Residuals are computed at the parameters `about` (n_params,); None means zero, so that they are
    the data.  `clip` has the rejection limits; None keeps all stars.  See
    `kernel.least_squares_moments` for `corner`, `power` and the `scalars` of the result.
    """
    moments = kernel.least_squares_moments(
        stars.pieces,
        stars.columns,
        stars.powers(about),
        stars.powers(None if clip is None else clip.theta),
        stars.model.order,
        chi2_limit=np.inf if clip is None else clip.chi2_limit,
        abs_limit=np.inf if clip is None else clip.abs_limit,
        spared_chi2=0.0 if clip is None else clip.spared_chi2,
        corner=corner,
        power=power,
    )
    if about is None:
        E = np.zeros((len(stars.groups), 2, stars.model.n_terms))
    else:
        E = stars.model.effective(about, stars.groups)
    chi2, no_cross = float(moments.scalars[6]), moments.cross[:, :0]
    return NormalEquations(
        moments.weight, moments.right, E, chi2, no_cross, moments.scalars, stars.groups
    )


def mixture(stars: Stars, theta: Float, constants: Constants, em: bool = False) -> NormalEquations:
    """Gradient and Hessian of the mixture log-likelihood at `theta`, in one pass over the stars.

    `right` of the result is the gradient with respect to the effective coefficients, and `weight`
    minus the Hessian.  See `kernel.mixture_moments` for `em` and `scalars`.
    """
    powers, order = stars.powers(theta), stars.model.order
    if circle := stars.circle(constants):
        moments = kernel.truncated_moments(
            stars.pieces, stars.columns, circle, powers, order, constants, em=em
        )
    else:
        moments = kernel.mixture_moments(
            stars.pieces, stars.columns, powers, order, constants, em=em
        )
    E = stars.model.effective(theta, stars.groups)
    return NormalEquations(
        moments.weight, moments.right, E, 0.0, moments.cross, moments.scalars, stars.groups
    )


# -- Gauss-Newton iteration over the exposure frames, without another pass over the data -----------
def starting_point(first: NormalEquations, model: DistortionModel, priors: GaussianPriors) -> Float:
    """Starting parameters (n_params,), from the normal equations `first` about zero.

    Frames are derived from linear fits, and polynomials are then fitted with these frames fixed.
    """
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


# Eigenvalues of the unit-diagonal normal matrix below this count as zero. Rounding alone gives
# ~1e-15, and a fit that loses 11 of 16 digits is meaningless.
RANK_TOLERANCE = 1e-11

# Smallest fraction of the chip area within the convex hull of its stars; below it, the polynomial
# would be an extrapolation over most of the chip.
LEAST_COVERAGE = 0.25


@dataclass(frozen=True)
class NullSpace:
    """Null space of a normal matrix: directions that the data do not determine."""

    rank: int
    n_params: int
    # condition number of the normal matrix scaled to unit diagonal; infinite if it is singular
    condition: float
    # names of the parameters with large components in each null direction, largest first
    directions: tuple[tuple[str, ...], ...]


def null_space(matrix: Arrow, names: tuple[str, ...]) -> NullSpace:
    """Rank, condition number and null directions of a normal matrix; `names` are its rows."""
    scale = np.sqrt(matrix.diagonal())
    dead = scale == 0
    scale[dead] = 1.0
    unit = matrix.dense() / np.outer(scale, scale)
    values = np.linalg.eigvalsh(unit)
    free = values < RANK_TOLERANCE * max(values[-1], 1.0)
    directions = []
    # eigenvectors take twice as long as eigenvalues and are rarely needed
    for vector in np.linalg.eigh(unit).eigenvectors[:, free].T if free.any() else ():
        size = np.abs(vector)
        parts = np.argsort(-size)[:6]
        directions.append(tuple(names[k] for k in parts if size[k] > 0.1 * size.max()))
    return NullSpace(
        rank=int((~free).sum()),
        n_params=len(names),
        condition=float("inf") if free.any() else float(values[-1] / values[0]),
        directions=tuple(directions),
    )


def require_full_rank(matrix: Arrow, model: DistortionModel, groups: Groups) -> NullSpace:
    """Require that a normal matrix has full rank, and return its `NullSpace`.

    Raises DegenerateError with the parameters of the first null direction and the likely reason.
    """
    space = null_space(matrix, model.names)
    if space.rank == space.n_params:
        return space
    first = space.directions[0]
    listed = ", ".join(first[:-1]) + f" and {first[-1]}" if len(first) > 1 else first[0]
    verb = "are degenerate" if len(first) > 1 else "is not determined by the data"
    reason, do = _reason(first, model, groups, _simpler_frames(matrix, model))
    raise DegenerateError(
        f"{listed} {verb} (rank {space.rank} of {space.n_params}){reason}", where="model", do=do
    )


def _simpler_frames(matrix: Arrow, model: DistortionModel) -> str:
    """Advice to use the most general kind of frames that is not degenerate; empty if none is."""
    dense = matrix.dense()
    for kind in reversed(FRAME_KINDS[: FRAME_KINDS.index(model.frames)]):
        names = frame_names(kind)
        remaining = [
            k
            for k, p in enumerate(model.parameters)
            if p.kind != "frame" or p.name.rpartition(".")[2] in names
        ]
        part = dense[np.ix_(remaining, remaining)]
        scale = np.sqrt(part.diagonal())
        if (scale == 0).any():
            continue
        values = np.linalg.eigvalsh(part / np.outer(scale, scale))
        if values[0] >= RANK_TOLERANCE * max(values[-1], 1.0):
            return f", or set model.frames = '{kind}'"
    return ""


def _reason(
    direction: tuple[str, ...], model: DistortionModel, groups: Groups, simpler: str
) -> tuple[str, str]:
    kinds = {p.name: p for p in model.parameters}
    parts = [kinds[name] for name in direction]
    deviations = any(p.kind == "frame" and p.name.endswith(DEVIATIONS) for p in parts)
    if model.gauge == "held" and deviations:
        return (
            ": the scale or shear that all exposures have in common is also in the polynomials",
            "give scale and shear of every exposure Gaussian priors, or choose gauge 'first'",
        )
    if any(p.kind == "tdd" for p in parts):
        if len(np.unique(groups.epoch)) == 1:
            return (
                ": all exposures share one epoch",
                "drop model.tdd or add exposures at other epochs",
            )
        if any(p.kind == "frame" for p in parts):
            return (
                f": the frame '{model.frames}' of each exposure absorbs the drift",
                f"drop the time-dependent term (model.tdd){simpler}",
            )
        return (
            ": the epochs of a segment do not fix its terms",
            "drop the term or the break, or add exposures in that segment",
        )
    if any(p.kind == "frame" for p in parts):
        return (
            ": too little joins the exposures",
            f"give more stars that exposures have on the same chips{simpler}",
        )
    return (
        f": the stars do not fill the detector well enough for order {model.order}",
        "lower model.order or add stars",
    )


def check_coverage(
    model: DistortionModel, survey: Survey, n_priors: int = 0, *, known: bool = False
) -> None:
    """Raise DegenerateError if the data, summarised by `survey`, cannot determine the model.

    This is the case if there are fewer measurements (including `n_priors` informative priors) than
    parameters, too few stars in an exposure, no stars on a chip, stars outside a chip or on a line,
    or stars that cover too small a part of a chip.  The last two are not checked if the polynomials
    are `known` from an earlier calibration.
    """
    n = survey.n
    if 2 * n + n_priors < model.n_params:
        raise DegenerateError(
            f"{n} {'star gives' if n == 1 else 'stars give'} {2 * n} numbers, fewer than the "
            f"{model.n_params} parameters",
            where=survey.where,
            do="lower model.order or give more stars",
        )
    q = len(frame_names(model.frames))
    if q:
        for name, count in zip(model.exposures, survey.exposures, strict=True):
            if 2 * count < q:
                kinds = [kind for kind in FRAME_KINDS if 2 * count >= len(frame_names(kind))]
                stars = "1 star" if count == 1 else f"{count} stars"
                raise DegenerateError(
                    f"exposure {name!r} has {stars}, too few for frame '{model.frames}'",
                    where=survey.where,
                    do=f"leave the exposure out, or set model.frames = '{kinds[-1]}'",
                )
    for chip, chip_survey in zip(model.chips, survey.chips, strict=True):
        location = f"chip {chip.name}" if len(model.chips) > 1 else survey.where
        if not chip_survey.n:
            raise DegenerateError("no star lies on this chip", where=location, do="drop the chip")
        if chip_survey.outside:
            raise DegenerateError(
                chip_survey.outside,
                where=location,
                do="correct detector.size, the columns or data.pixel_origin, or leave the row out",
            )
        if known:
            continue
        a, b, aa, ab, bb = chip_survey.sums / chip_survey.n
        spread = np.linalg.eigvalsh([[aa - a * a, ab - a * b], [ab - a * b, bb - b * b]])
        # differences of squares: half of the digits are lost
        if chip_survey.n < 3 or spread[0] < 1e-12 * spread[1]:
            raise DegenerateError(
                "all stars lie on a line", where=location, do="check columns x and y"
            )
        try:
            covered = ConvexHull(chip_survey.corners / chip.size).volume
        except QhullError:  # nearly collinear: no area
            covered = 0.0
        if covered < LEAST_COVERAGE:
            x, y = chip_survey.corners.T
            raise DegenerateError(
                f"the stars lie within x {x.min():.0f} to {x.max():.0f}, y {y.min():.0f} to "
                f"{y.max():.0f} and span {100 * covered:.0f} % of the detector, so that the rest "
                "would be extrapolated",
                where=location,
                do="add stars, or describe only the part that is measured as the detector",
            )
