"""Linear transformations of RvB pairs: `bayesdist wise rvb`, all pairs or frame by frame.

This corresponds to TRSrvb and RERrvb in WSDC D-T033, section 3: transformations with up to five
parameters (two shifts, a rotation, two scales), fitted or given, and the change from frame
solutions with free scales to those with fixed scales.  The sixth parameter of a solution is the
skew, which is zero in gnDSTR of the report.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from functools import reduce
from math import radians
from operator import add
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data import Matches
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.names import find_columns
from bayesdist.errors import DegenerateError, InputError
from bayesdist.files.tables import read_table
from bayesdist.infer.stars.stars import Sums
from bayesdist.missions.wise.pairs.read import RVB_ALIASES, chosen_band, open_rvb_files, stream_rvb
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs, write_rvb
from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.utils.arrays import Float, Int

PARAMETERS = ("shift_u", "shift_v", "rotation", "scale_u", "scale_v", "skew")

SOLUTION_ALIASES: dict[str, tuple[str, ...]] = {
    "frame": RVB_ALIASES["exposure"],
    **{name: (name,) for name in PARAMETERS},
}

FREE = 5  # number of fitted parameters, the first ones of `PARAMETERS`
_RANK = 1e-12  # smallest ratio of eigenvalues of the normal matrix scaled to unit diagonal


def read_solutions(
    path: str | os.PathLike[str], *, centre: tuple[float, float]
) -> dict[str, RvbTransform]:
    """Read the solutions of the frames of one band, for `rereference`.

    Parameters
    ----------
    path : path-like
        Table with one row per frame and columns for the frame and for one or more of `PARAMETERS`;
        missing parameters are zero.  Scales are given minus 1, and the rotation is in radians
        unless the column has a unit.
    centre : tuple of float
        Centre of rotation and scales, pixels.

    Returns
    -------
    dict of str to RvbTransform
        Solutions by frame.

    Raises
    ------
    InputError
        If the table has no column of frames or of parameters, a frame occurs twice, or the unit of
        the rotation is not an angle.
    """
    file = Path(path)
    table = read_table(file)
    column_of = find_columns(table.colnames, None, SOLUTION_ALIASES, source=str(file))
    parameter_names = [name for name in PARAMETERS if name in column_of]
    if "frame" not in column_of or not parameter_names:
        missing = "frames" if "frame" not in column_of else "parameters"
        raise InputError(
            f"no column of {missing} among {', '.join(table.colnames)}",
            where=str(file),
            do="rename the columns",
        )
    codes, names = SourceColumn(table[column_of["frame"]], str(file), column_of["frame"]).labels()
    first = np.unique(codes, return_index=True)[1]
    if len(first) < len(codes):
        repeated = int(np.setdiff1d(np.arange(len(codes)), first)[0])
        raise InputError(
            f"frame {names[codes[repeated]]!r} occurs twice",
            where=f"{file}, row {repeated + 1}",
            do="give the solutions of one band, with one row per frame",
        )
    values = np.zeros((len(codes), len(PARAMETERS)))
    for name in parameter_names:
        column = SourceColumn(table[column_of[name]], str(file), column_of[name])
        numbers = column.numbers()
        if name in ("rotation", "skew") and column.unit is not None:
            numbers = numbers * _radians(column)
        values[:, PARAMETERS.index(name)] = numbers
    return {
        names[code]: replace(RvbTransform(*row.tolist()), centre=centre)
        for code, row in zip(codes, values, strict=True)
    }


def _radians(column: SourceColumn) -> float:
    """Radians per unit of a column."""
    unit = column.unit
    try:
        return 1.0 if unit is None else float(unit.to("rad"))
    except ValueError:
        raise InputError(
            f"unit {unit} is not an angle", where=column.where, do="give rad or deg"
        ) from None


def transform_files(
    files: Sequence[str | Path],
    output: str | Path,
    *,
    band: str | None,
    columns: Mapping[str, str] | None,
    dx: float,
    dy: float,
    rotation: float,
    scale_x: float,
    scale_y: float,
    fit: bool,
) -> str:
    """Apply one transformation to all reference positions; returns text to print.

    With `fit` the five parameters are fitted such that the reference positions agree with the
    detections.  The pairs are written to a new folder.
    """
    transform = RvbTransform(dx, dy, radians(rotation), scale_x, scale_y)
    if (transform == RvbTransform()) != fit:
        raise InputError(
            "a transformation is given, but --fit is set" if fit else "no transformation is given",
            where="bayesdist wise rvb transform",
            do="give --fit, or --dx, --dy, --rotation, --scale-x or --scale-y",
        )
    columns = columns or {}
    band = _band(files, band, columns)
    fit_text = ""
    if fit:
        pieces = stream_rvb(files, band=band, columns=columns)
        best = fit_transform(
            reduce(
                add, (linear_moments(pairs.matches, WISE_ARRAYS[band].centre) for pairs in pieces)
            )
        )
        transform, fit_text = best.transform, f"\n{best.sentence}"
    else:
        transform = replace(transform, centre=WISE_ARRAYS[band].centre)
    written = _written(
        files, output, band, columns, lambda matches: transformed(matches, transform)
    )
    return written + fit_text


def rereference_files(
    files: Sequence[str | Path],
    output: str | Path,
    *,
    free: str | Path,
    fixed: str | Path,
    band: str | None,
    columns: Mapping[str, str] | None,
) -> str:
    """Transform pairs from the frame solutions `free` to `fixed`; returns text to print."""
    columns = columns or {}
    band = _band(files, band, columns)
    old, new = (read_solutions(path, centre=WISE_ARRAYS[band].centre) for path in (free, fixed))
    return _written(files, output, band, columns, lambda matches: rereference(matches, old, new))


def _band(files: Sequence[str | Path], band: str | None, columns: Mapping[str, str]) -> str:
    return chosen_band(open_rvb_files(files, columns), band)


def _written(
    files: Sequence[str | Path],
    output: str | Path,
    band: str,
    columns: Mapping[str, str],
    move: Callable[[Matches], Matches],
) -> str:
    for path in map(Path, files):
        if path.is_dir() and Path(output).resolve().is_relative_to(path.resolve()):
            raise InputError(
                "is inside the input folder",
                where=str(output),
                do="choose a folder outside of it",
            )

    def moved() -> Iterator[RvbPairs]:
        for pairs in stream_rvb(files, band=band, columns=columns):
            yield replace(pairs, matches=move(pairs.matches))

    n = write_rvb(moved(), output)
    return f"{output}: {n} pairs of {band}; calibrate them with data.format = 'rvb'"


# Errors of u and v are uncorrelated in Matches, so that a transformation that would correlate them


@dataclass(frozen=True)
class RvbTransform:
    """Linear transformation (u, v) -> centre + shift + R K S ((u, v) - centre).

    R rotates by `rotation` from u towards v, S scales by 1 + scale_u and 1 + scale_v, and
    K = [[1, skew], [0, 1]].

    Raises InputError if a value is not finite or a scale is not above -1.
    """

    shift_u: float = 0.0  # in the unit of u and v
    shift_v: float = 0.0
    rotation: float = 0.0  # radians
    scale_u: float = 0.0  # scale minus 1
    scale_v: float = 0.0
    skew: float = 0.0  # radians
    # fixed point of rotation and scales; by default the centre of a W1 array
    centre: tuple[float, float] = (508.5, 508.5)

    def __post_init__(self) -> None:
        for name, value in zip(PARAMETERS, self.values, strict=True):
            if not np.isfinite(value) or (name.startswith("scale") and value <= -1.0):
                raise InputError(
                    f"{name} of a linear transformation is {value:g}",
                    do="give a finite number, and scales above -1",
                )

    @property
    def values(self) -> Float:
        """The six parameters in the order of `PARAMETERS`."""
        return np.array(astuple(self)[:6], float)

    @property
    def matrix(self) -> Float:
        """Matrix R K S, shape (2, 2)."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        upper = np.array([[1.0, self.skew], [0.0, 1.0]])
        return np.array([[c, -s], [s, c]]) @ upper * [1 + self.scale_u, 1 + self.scale_v]

    @property
    def shift(self) -> Float:
        """Shifts along u and v, shape (2,)."""
        return np.array([self.shift_u, self.shift_v])

    def __call__(self, points: ArrayLike) -> Float:
        """Transform points (..., 2)."""
        offset = np.asarray(points, float) - self.centre
        return offset @ self.matrix.T + self.centre + self.shift

    def jacobian(self) -> Float:
        """Derivatives (6, 6) of shift and matrix with respect to the parameters.

        The rows are both shifts, then the matrix by rows; the columns are in the order of
        `PARAMETERS`.
        """
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        rotation, rotation_derivative = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
        scale = np.diag([1 + self.scale_u, 1 + self.scale_v])
        upper = np.array([[1.0, self.skew], [0.0, 1.0]])
        out = np.zeros((6, 6))
        out[:2, :2] = np.eye(2)
        for column, derivative in enumerate(
            (
                rotation_derivative @ upper @ scale,
                rotation @ upper @ np.diag([1.0, 0.0]),
                rotation @ upper @ np.diag([0.0, 1.0]),
                rotation @ np.array([[0.0, 1.0], [0.0, 0.0]]) @ scale,
            ),
            2,
        ):
            out[2:, column] = derivative.ravel()
        return out


def transformed(matches: Matches, transform: RvbTransform) -> Matches:
    """Transform the reference positions of pairs and the covariances of their errors."""
    everywhere = np.zeros(len(matches), np.int64)
    return _moved(matches, everywhere, transform.matrix[None], transform.shift[None],
                  np.array([transform.centre]))  # fmt: skip


def rereference(
    matches: Matches,
    free: Mapping[str, RvbTransform],
    fixed: Mapping[str, RvbTransform],
) -> Matches:
    """Transform pairs from one set of frame solutions to another.

    The reference positions of a frame are the nominal pixels of its stars, transformed to the band
    frame with the solution of the frame.  A solution with free scales absorbs a part of the
    distortion that differs from frame to frame, so that the linear terms of a calibration are
    meaningless.  With fixed scales they are meaningful, as are shifts and rotations between bands.
    The pairs alone do not show what a free solution absorbed, so that both solutions must be given.

    Parameters
    ----------
    matches : Matches
        Pairs that were made with the free solutions.
    free, fixed : mapping of str to RvbTransform
        Solutions of each frame, from the common nominal pixels to the band frame.  If the frame was
        solved in another band, the solution must include the translation and rotation between the
        bands.

    Returns
    -------
    Matches

    Raises
    ------
    InputError
        If a frame has no solution, or errors would become correlated (see `transformed`).
    """
    moves = []
    used, code = np.unique(matches.exposure, return_inverse=True)
    for name in (matches.exposure_names[k] for k in used):
        for kind, solutions in (("free", free), ("fixed", fixed)):
            if name not in solutions:
                raise InputError(
                    f"frame {name!r} has no solution with {kind} scales",
                    where=", ".join(matches.sources),
                    do="give the solutions of all frames, or remove its pairs",
                )
        old, new = free[name], fixed[name]
        # inverse of the old solution followed by the new one, as one map about the old centre
        matrix = new.matrix @ np.linalg.inv(old.matrix)
        away = np.subtract(old.centre, new.centre)
        moves.append(
            (matrix, new.shift + new.matrix @ away - away - matrix @ old.shift, old.centre)
        )
    return _moved(matches, code, *map(np.array, zip(*moves, strict=True)))


def _moved(matches: Matches, code: Int, matrix: Float, shift: Float, centre: Float) -> Matches:
    """Transform each pair with the linear map given by its code."""

    def moved(u: Float, v: Float) -> Float:
        points = np.stack([u, v])
        offset = points.T - centre[code]
        # the change is added, so that the identity is exact
        change = np.einsum("nij,nj->ni", (matrix - np.eye(2))[code], offset) + shift[code]
        return points + change.T

    columns = dict(zip(("u", "v"), moved(matches.u, matches.v), strict=True))
    if matches.u_nominal is not None and matches.v_nominal is not None:
        nominal = moved(matches.u_nominal, matches.v_nominal)
        columns |= dict(zip(("u_nominal", "v_nominal"), nominal, strict=True))
    if matches.sigma_u is not None:
        M = matrix[code]
        matches = matches.with_covariances(M @ matches.covariances() @ np.swapaxes(M, 1, 2))
    return matches.with_columns(**columns)


@dataclass(frozen=True, eq=False)
class LinearMoments(Sums):
    """Sums over pairs for the normal equations; those of parts of the data can be added."""

    SAME = ("centre",)

    # (2, 3, 3), for x and y: sum of w p p^T with p = (1, u - centre_u, v - centre_v)
    weight: Float
    right: Float  # (2, 3), sum of w p times the offset of the detection, x - u or y - v
    chi2: float  # sum of w times the squared offsets
    n: int  # number of pairs
    centre: tuple[float, float]


def linear_moments(matches: Matches, centre: tuple[float, float]) -> LinearMoments:
    """Sums over pairs for the fit of a linear transformation.

    Parameters
    ----------
    matches : Matches
        Pairs with errors, and with u and v in pixels of the array.
    centre : tuple of float
        Centre of the transformation, usually that of the array.

    Returns
    -------
    LinearMoments

    Raises
    ------
    InputError
        If the pairs have no errors, or u and v are not in pixels.
    """
    sources = ", ".join(matches.sources)
    if matches.sigma_u is None or matches.sigma_v is None:
        raise InputError("the matches have no errors", where=sources, do="give sigma columns")
    if matches.unit != "pix":
        raise InputError(
            f"u, v are in {matches.unit}, but the detections in pixels",
            where=sources,
            do="convert u, v to pixels of the array",
        )
    design = np.stack([np.ones(len(matches)), matches.u - centre[0], matches.v - centre[1]])
    offsets = (matches.x - matches.u, matches.y - matches.v)
    weight, right, chi2 = np.empty((2, 3, 3)), np.empty((2, 3)), 0.0
    for axis, (offset, sigma) in enumerate(
        zip(offsets, (matches.sigma_u, matches.sigma_v), strict=True)
    ):
        weighted = design / sigma**2
        weight[axis] = weighted @ design.T
        right[axis] = weighted @ offset
        chi2 += float(((offset / sigma) ** 2).sum())
    return LinearMoments(weight, right, chi2, len(matches), centre)


@dataclass(frozen=True, eq=False)
class TransformFit:
    """Fitted linear transformation from reference stars to detections."""

    transform: RvbTransform
    # (6, 6), formal covariance in the order of `PARAMETERS`; zero for the skew.  It excludes the
    # effect of uncorrected distortion, which increases chi2 / dof
    cov: Float
    chi2: float
    dof: int

    @property
    def sigma(self) -> Float:
        """Formal errors of the six parameters."""
        return np.sqrt(np.diag(self.cov))

    @property
    def sentence(self) -> str:
        """Parameters with their errors as a sentence."""
        values = zip(PARAMETERS, self.transform.values, self.sigma, strict=True)
        found = ", ".join(f"{name} {value:.6g} +- {sigma:.2g}" for name, value, sigma in values)
        return f"fitted: {found} (pixels, radians, relative); chi-square {self.chi2:.4g}/{self.dof}"


def fit_transform(moments: LinearMoments) -> TransformFit:
    """Fit the five parameters, without skew, of the map from (u, v) to (x, y) by least squares.

    Use `transformed` with the result to remove constant and linear offsets from the pairs.  Raises
    DegenerateError if the pairs do not determine the parameters, for example if they are on a line.
    """
    now = RvbTransform(centre=moments.centre)
    # indices of the affine coefficients of x and y in `jacobian`: shift, then matrix by rows
    order = np.array([[0, 2, 3], [1, 4, 5]])
    weight, right = np.zeros((6, 6)), np.zeros(6)
    for axis in (0, 1):
        weight[np.ix_(order[axis], order[axis])] = moments.weight[axis]
        right[order[axis]] = moments.right[axis]
    for _ in range(30):
        jacobian = now.jacobian()[:, :FREE]
        normal = jacobian.T @ weight @ jacobian
        _require_rank(normal)
        step = np.linalg.solve(normal, jacobian.T @ (right - weight @ _offset(now)))
        values = now.values
        values[:FREE] += step
        now = replace(now, **dict(zip(PARAMETERS, values.tolist(), strict=True)))
        # converged if the step is far below the errors, or at the level of rounding
        if step @ normal @ step < max(1e-16, 1e-28 * moments.chi2):
            break
    else:
        raise DegenerateError(
            "the linear transformation does not converge",
            where="linear transformation",
            do="check that x, y and u, v are positions on the same array",
        )
    cov = np.zeros((6, 6))
    cov[:FREE, :FREE] = np.linalg.inv(normal)
    offset = _offset(now)
    chi2 = moments.chi2 - 2 * right @ offset + offset @ weight @ offset
    return TransformFit(now, cov, float(chi2), 2 * moments.n - FREE)


def _offset(transform: RvbTransform) -> Float:
    """Shift, and matrix minus identity by rows; small values keep their precision."""
    return np.concatenate([transform.shift, (transform.matrix - np.eye(2)).ravel()])


def _require_rank(normal: Float) -> None:
    scale = np.sqrt(np.diag(normal))
    dead = scale == 0
    values, vectors = np.linalg.eigh(normal / np.outer(*[np.where(dead, 1.0, scale)] * 2))
    if values[0] < _RANK * values[-1]:
        parts = np.abs(vectors[:, 0])
        undetermined = [
            n for n, part in zip(PARAMETERS, parts, strict=False) if part > 0.1 * parts.max()
        ]
        raise DegenerateError(
            f"the pairs do not determine {', '.join(undetermined)}",
            where="linear transformation",
            do="give pairs that cover the whole array",
        )
