"""Matched stars as columns for the passes, sorted by group, with pixels scaled to [-1, 1]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer import kernel
from bayesdist.infer.kernel import Constants
from bayesdist.model import DistortionModel, Groups, merge_groups
from bayesdist.utils.arrays import Float, Int

NOBODY = np.zeros(0, np.int64)
NONE = np.zeros(0)

Rows = tuple[Int, ...]


@dataclass(frozen=True, eq=False)
class Stars:
    """Matched stars, sorted by group.

    Stars of a group have the same effective polynomial coefficients (chip, exposure and date).  If
    the errors of some stars are correlated between u and v, the data of all stars are along the
    principal axes of their errors.  The jitter and the scatter of false matches are isotropic, so
    that the covariance of each star is diagonal there.
    """

    model: DistortionModel
    groups: Groups  # the G groups that have stars, without members, which follow from `starts`
    starts: Int  # index (G + 1,) of the first star of each group, and the number of stars
    X: Float  # scaled pixel coordinates (N,), from -1 to 1
    Y: Float
    u: Float  # reference positions (N,), in the unit of the model
    v: Float
    var_u: Float  # squared errors (N,); the same array for both axes if they are equal
    var_v: Float
    # nominal position about which a star was matched, minus its reference position (N,); None if
    # unknown
    off_u: Float | None = None
    off_v: Float | None = None
    # cosine and sine (N,) of the angle from u to the first principal axis; empty if no errors are
    # correlated
    cos: Float = field(default_factory=lambda: NONE)
    sin: Float = field(default_factory=lambda: NONE)

    def __len__(self) -> int:
        return len(self.X)

    @property
    def columns(self) -> tuple[Float, ...]:
        """Columns X, Y, u, v, var_u, var_v, cos and sin, each (N,) or, for the last two, empty."""
        data = self.X, self.Y, self.u, self.v, self.var_u, self.var_v
        return *data, self.cos, self.sin

    @property
    def is_correlated(self) -> bool:
        """True if the errors of some stars are correlated between u and v."""
        return len(self.cos) > 0

    @property
    def offsets(self) -> tuple[Float, ...]:
        """Columns off_u and off_v, each (N,); empty if nominal positions are unknown."""
        return () if self.off_u is None or self.off_v is None else (self.off_u, self.off_v)

    def circle(self, constants: Constants) -> tuple[Float, ...]:
        """Columns `offsets`, each (N,), if the constants have a match circle; otherwise empty."""
        return self.offsets if constants.radius else ()

    @property
    def nbytes(self) -> int:
        """Size of all columns in bytes."""
        shared = self.var_u is self.var_v
        turns = len(self.cos) + len(self.sin)
        return 8 * (len(self) * ((5 if shared else 6) + len(self.offsets)) + turns)

    def __sizeof__(self) -> int:
        """Size of all columns in bytes, which Dask uses to estimate the cost of moving a shard."""
        return self.nbytes

    @cached_property
    def blocks(self) -> Int:
        """Pieces (n, 3) from `pieces_of` that fit into the cache."""
        return kernel.pieces_of(self.starts, kernel.BLOCK)

    @cached_property
    def pieces(self) -> Int:
        """Pieces (n, 3) from `pieces_of` that are summed separately."""
        return kernel.pieces_of(self.starts, kernel.PIECE)

    def powers(self, theta: Float | None) -> Float:
        """Effective coefficients (..., G, 2, K) of the powers of X and Y; zero if theta is None."""
        if theta is None:
            return np.zeros((len(self.groups), 2, self.model.n_terms))
        # all chips have the same order and hence the same map to powers
        basis = self.model.basis(self.model.chips[0].number)
        return basis.to_scaled_powers(self.model.effective(theta, self.groups))

    def residuals(self, theta: Float) -> Float:
        """Residuals (N, 2), data minus model, in the order of this object."""
        return self.off_axes(self.residuals_along_axes(theta).T).T

    def residuals_along_axes(self, theta: Float) -> Float:
        """Residuals (N, 2) along the principal axes of the errors."""
        return kernel.residuals(self.blocks, self.columns, self.powers(theta), self.model.order)

    def chi2(self, along_axes: Float) -> Float:
        """Chi-square (N,) of residuals (N, 2) along the principal axes, with the quoted errors."""
        return np.asarray(along_axes[:, 0] ** 2 / self.var_u + along_axes[:, 1] ** 2 / self.var_v)

    def off_axes(self, vectors: Float) -> Float:
        """Turn vectors (2, N) from the principal axes of the errors to u and v."""
        if not self.is_correlated:
            return vectors
        a, b = vectors
        return np.stack([self.cos * a - self.sin * b, self.sin * a + self.cos * b])

    def matrices_off_axes(self, first: Float, mixed: Float | float, second: Float) -> Float:
        """Turn symmetric matrices with elements (N,) to u and v; returns uu, uv, vv (3, N)."""
        mixed = np.broadcast_to(mixed, np.shape(first))
        if not self.is_correlated:
            return np.stack([first, mixed, second])
        cc, cs, ss = self.cos**2, self.cos * self.sin, self.sin**2
        return np.stack(
            [
                cc * first - 2 * cs * mixed + ss * second,
                cs * (first - second) + (cc - ss) * mixed,
                ss * first + 2 * cs * mixed + cc * second,
            ]
        )

    def without_correlations(self) -> Stars:
        """Stars with the same errors in u and in v, taken as independent."""
        if not self.is_correlated:
            return self
        var_u, var_v = self.variances()
        u, v = self.off_axes(np.stack([self.u, self.v]))
        off: dict[str, Any] = {}
        if self.off_u is not None and self.off_v is not None:
            off = dict(zip(("off_u", "off_v"), self.off_axes(np.stack(self.offsets)), strict=True))
        return replace(self, u=u, v=v, var_u=var_u, var_v=var_v, cos=NONE, sin=NONE, **off)

    def variances(self) -> tuple[Float, Float]:
        """Squared quoted errors (N,) in u and in v."""
        if not self.is_correlated:
            return self.var_u, self.var_v
        var_u, _, var_v = self.covariances()
        return var_u, var_v

    def covariances(self, added: float = 0.0) -> Float:
        """Covariances uu, uv, vv (3, N) of the quoted errors, plus a variance `added` per axis."""
        return self.matrices_off_axes(self.var_u + added, 0.0, self.var_v + added)

    def pixels(self) -> tuple[Float, Float]:
        """Pixel coordinates x, y (N,), FITS 1-based."""
        x, y = np.empty(len(self)), np.empty(len(self))
        for g, chip in enumerate(self.groups.chip):
            rows = slice(self.starts[g], self.starts[g + 1])
            size = self.model.chips[chip].size
            x[rows] = (self.X[rows] * size[0] + size[0] + 1) / 2
            y[rows] = (self.Y[rows] * size[1] + size[1] + 1) / 2
        return x, y


def prepare(model: DistortionModel, matches: Matches) -> tuple[Stars, Int]:
    """Prepare matches for the passes; return the sorted stars and the table row (N,) of each.

    The exposures of the model must be the `exposure_names` of the matches, and its chips must
    include those of the matches.  Raises InputError if the matches have no errors, another unit
    than the model, or lack required epochs.
    """
    sigma_u, sigma_v = errors_of(matches)
    groups = groups_of(model, matches)
    order: Int | slice = slice(None)  # no copies in the common case of a single group
    if len(groups) > 1:
        order = np.argsort(groups.index, kind="stable")
    counts = np.bincount(groups.index, minlength=len(groups))
    starts = np.concatenate([[0], np.cumsum(counts)])
    x, y = matches.x[order], matches.y[order]
    X, Y = np.empty(len(x)), np.empty(len(x))
    for g in range(len(groups)):
        rows = slice(starts[g], starts[g + 1])
        basis = model.basis(model.chips[groups.chip[g]].number)
        X[rows], Y[rows] = basis.scaled(x[rows], y[rows])
    var_u = sigma_u[order] ** 2
    equal = np.array_equal(sigma_u, sigma_v)
    stars = Stars(
        model=model,
        groups=replace(groups, index=NOBODY),
        starts=starts,
        X=X,
        Y=Y,
        u=matches.u[order],
        v=matches.v[order],
        var_u=var_u,
        var_v=var_u if equal else sigma_v[order] ** 2,
        off_u=None if matches.u_nominal is None else (matches.u_nominal - matches.u)[order],
        off_v=None if matches.v_nominal is None else (matches.v_nominal - matches.v)[order],
    )
    if matches.rho_uv is not None and matches.rho_uv.any():
        stars = _along_axes(stars, sigma_v[order] ** 2, matches.rho_uv[order])
    return stars, np.arange(len(x))[order]


def _along_axes(stars: Stars, var_v: Float, rho: Float) -> Stars:
    """Stars with their data turned to the principal axes of errors with correlations rho (N,)."""
    mean, half = (stars.var_u + var_v) / 2, (stars.var_u - var_v) / 2
    mixed = rho * np.sqrt(stars.var_u * var_v)
    radius = np.hypot(half, mixed)
    angle = 0.5 * np.arctan2(mixed, half)
    c, s = np.cos(angle), np.sin(angle)

    def turned(u: Float, v: Float) -> tuple[Float, Float]:
        return c * u + s * v, c * v - s * u

    (u, v), first = turned(stars.u, stars.v), mean + radius
    # the product of both variances, without the cancellation in mean - radius
    second = stars.var_u * var_v * (1.0 - rho) * (1.0 + rho) / first
    off: dict[str, Any] = {}
    if stars.off_u is not None and stars.off_v is not None:
        off = dict(zip(("off_u", "off_v"), turned(stars.off_u, stars.off_v), strict=True))
    return replace(stars, u=u, v=v, var_u=first, var_v=second, cos=c, sin=s, **off)


def errors_of(matches: Matches) -> tuple[Float, Float]:
    """Errors (N,) of the matches in u and v; raises InputError if the table has none."""
    if matches.sigma_u is None or matches.sigma_v is None:
        do = "give sigma columns, a number, or sigma = 'by_magnitude'"
        if matches.has_mag:  # the matches may have been read with sigma = 'by_magnitude'
            do = (
                "estimate them from the residuals by magnitude with bayesdist.fit_by_magnitude or "
                "bayesdist.calibrate, or give sigma columns or a number"
            )
        raise InputError("the matches have no errors", do=do)
    return matches.sigma_u, matches.sigma_v


def groups_of(model: DistortionModel, matches: Matches) -> Groups:
    """Group the matches by chip, exposure and date, so that each group has the same coefficients.

    Raises InputError if the matches have another unit than the model or an unknown chip or
    exposure, or lack required epochs.
    """
    if matches.unit != model.unit:
        raise InputError(
            f"the matches are in {matches.unit}, but the model is in {model.unit}",
            do=f"convert the matches to {model.unit}",
        )
    return model.groups(
        len(matches), epoch=matches.epoch, exposure=matches.exposure, chip=matches.chip_number
    )


def in_table_order(values: NDArray[Any], order: Int) -> NDArray[Any]:
    """Reorder values per star (first axis) to table rows; `order` is that of `prepare`."""
    out = np.empty_like(values)
    out[order] = values
    return out


# -- sums over stars, by group or in total; sums over different chunks of the data can be added ----


class Sums:
    """Base class of dataclasses with sums over stars, the results of tasks for `Shards.sum`.

    Fields are numbers, arrays, other `Sums`, None, or tuples and mappings of these.  If a subclass
    has a field `groups`, the fields named in `BY_GROUP` and `OF_GROUP` have one row per group, and
    adding two objects merges their groups.
    """

    BY_GROUP: ClassVar[tuple[str, ...]] = ()  # fields that are summed by group
    OF_GROUP: ClassVar[tuple[str, ...]] = ()  # properties of a group, which must agree
    SAME: ClassVar[tuple[str, ...]] = ()  # properties of all sums, which must agree

    def __add__(self, other: Self) -> Self:
        """Sum over the stars of both; raises ValueError if `SAME` or `OF_GROUP` fields differ."""
        out: dict[str, Any] = {}
        rows: Rows = ()
        mine: Any = self  # dataclasses that may have groups
        theirs: Any = other
        if getattr(mine, "groups", None) is not None:
            out["groups"], rows = _merged(mine.groups, theirs.groups)
        for name in (item.name for item in fields(mine) if item.name not in out):
            a, b = getattr(self, name), getattr(other, name)
            if name in self.SAME:
                if np.any(a != b):
                    raise ValueError(f"sums with different {name} do not add")
                out[name] = a
            elif name in self.BY_GROUP:
                out[name] = _scattered(a, b, rows, len(out["groups"]))
            elif name in self.OF_GROUP:
                out[name] = _placed(a, b, rows, len(out["groups"]), name)
            else:
                out[name] = _added(a, b)
        return type(self)(**out)


def _merged(a: Groups, b: Groups) -> tuple[Groups, Rows]:
    """Merged groups, and the rows in them of the groups of `a` and of `b`."""
    if a.same(b):
        return a, (np.arange(len(a)), np.arange(len(a)))
    groups, *rows = merge_groups(a, b)
    return groups, tuple(rows)


def _scattered(a: NDArray[Any], b: NDArray[Any], rows: Rows, n: int) -> NDArray[Any]:
    """Sum (n, ...) of arrays, with the rows of `a` and `b` added at the indices `rows`."""
    out = np.zeros((n, *a.shape[1:]), a.dtype)
    out[rows[0]] += a
    out[rows[1]] += b
    return out


def _placed(a: NDArray[Any], b: NDArray[Any], rows: Rows, n: int, name: str) -> NDArray[Any]:
    """Array (n, ...) with the rows of both at the indices `rows`; common rows must be equal."""
    out = np.empty((n, *a.shape[1:]), a.dtype)
    out[rows[0]] = a
    out[rows[1]] = b
    if not np.array_equal(out[rows[0]], a):
        raise ValueError(f"sums with different {name} do not add")
    return out


def _added(a: Any, b: Any) -> Any:
    if a is None:
        return b
    if isinstance(a, tuple):
        return tuple(_added(first, second) for first, second in zip(a, b, strict=True))
    if isinstance(a, Mapping):
        return {key: _added(first, b[key]) for key, first in a.items()}
    return a + b
