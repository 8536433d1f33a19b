"""Gauge: directions in parameter space that the detections do not determine, with their names.

If the stars move together with the model, all residuals are unchanged.  A linear map of the entire
sky is such a move if the exposures can follow it: always for a shift, a rotation or a change of
scale, and for a skew if all exposures have the same roll angle.  Free directions are found from
the curvature of the log density, and are named by comparing them with such moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import qr

from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.infer.problem import Problem
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

NULL = 1e-10  # relative eigenvalue below which a direction has no information
ROUNDING = 1e-13  # relative eigenvalue that is due to rounding only
FREE_PIX = 10.0  # error in pixels at the detector's edge above which a direction counts as free
WEAK_PIX = 0.1  # error in pixels at the detector's edge above which it counts as nearly free
FAR = 3.0  # other information must be better than the detections by this factor to fix a property
EXPLAINED = 1e-2  # largest fraction of a free direction that named moves may leave unexplained
SAME_ROLL = np.radians(0.1)  # roll angles that differ by less count as equal
TIE = 0.02  # relative preference for the first of nearly equivalent parameters over the last
MIN_PIVOT = 0.02  # smallest pivot for which a parameter is fixed
HIDDEN = 1e-5  # fraction of a property along undetermined directions above which it is free

# generators of linear maps of the sky
GENERATORS = {
    "scale": np.array([[1.0, 0.0], [0.0, 1.0]]),
    "rotation": np.array([[0.0, -1.0], [1.0, 0.0]]),
    "skew_plus": np.array([[1.0, 0.0], [0.0, -1.0]]),
    "skew_cross": np.array([[0.0, 1.0], [1.0, 0.0]]),
}
RATES = ("drift_u", "drift_v", "spin", "expansion")  # motions of the sky with time
PARALLAX = "parallax"  # parallax common to all stars
POINTS = ("zero_point_u", "zero_point_v")


@dataclass(frozen=True, eq=False)
class NamedDirection:
    """A property of the solution, such as its scale or rotation, with its error.

    Parameters
    ----------
    name : str
        A key of `GENERATORS` (relative changes); 'zero_point_u', 'zero_point_v'; or a property of
        another chip relative to the first one, such as 'WFC1.shift_u' or 'WFC1.rotation'.
    unit : str
        Unit of the property; empty for relative changes, and for rotations in radians.
    sigma : float
        Error from the detections alone; infinite if they do not determine it.
    sigma_fixed : float
        Error with information from other sources; infinite if the gauge fixes it by convention.
    edge_pix : float
        Displacement in pixels at the detector's edge for one unit of the property.
    """

    name: str
    unit: str
    sigma: float
    sigma_fixed: float
    edge_pix: float

    @property
    def free(self) -> bool:
        """True if the detections do not determine the property."""
        return not np.isfinite(self.sigma)

    @property
    def weak(self) -> bool:
        """True if the detections hardly determine the property, or not at all."""
        return self.free or self.sigma * self.edge_pix > WEAK_PIX

    @property
    def by_detections(self) -> bool:
        """True if other information does not improve the property by at least a factor of 3."""
        finite = np.isfinite(self.sigma) and np.isfinite(self.sigma_fixed)
        return bool(finite and self.sigma < FAR * self.sigma_fixed)


@dataclass(frozen=True)
class CommonMotion:
    """Move of the entire sky with time that the detections do not determine, or hardly."""

    name: str  # from `RATES`, or `PARALLAX`
    free: bool  # True if the detections do not determine it at all
    determined: bool  # True if information from other sources determines it

    @property
    def held(self) -> bool:
        """True if the motion is fixed by convention."""
        return self.free and not self.determined


@dataclass(frozen=True, eq=False)
class Decision:
    """Number of free directions and the parameters fixed by convention, stored with a solution.

    The error of a direction depends on the parameters at which it is evaluated.  Close to a limit,
    a second evaluation might differ, and parameters would be fixed (and have no error) that do not
    belong to a free direction.
    """

    n_null: int  # number of directions that the detections do not determine
    n_open: int  # number of these that are free even with information from other sources
    held: Int  # indices (n_open,) of the parameters that are fixed


@dataclass(frozen=True, eq=False)
class Gauge:
    """Free directions of a problem, and the constraints that fix them.

    Parameters
    ----------
    null : ndarray, shape (D, d)
        Basis of the directions that the detections do not determine.
    open : ndarray, shape (D, k)
        Basis of the directions that are free even with information from other sources.
    held : ndarray of int, shape (k,)
        Indices of the parameters that are fixed to determine the others.
    directions : tuple of NamedDirection
    unnamed : tuple of str
        Names of the largest parameters in free directions that no `NamedDirection` describes.
    weakest : ndarray, shape (w, 2)
        Error in pixels of each nearly free combination of parameters, and the index of its largest
        parameter.
    spread : float
        Largest difference of two roll angles in radians, modulo half a turn.
    whole : tuple of str
        Linear maps of the entire sky that are free, from `GENERATORS`.
    motions : tuple of CommonMotion
        Moves of the entire sky with time that the detections do not determine, or hardly, if stars
        have proper motions.
    """

    null: Float
    open: Float
    held: Int
    directions: tuple[NamedDirection, ...]
    unnamed: tuple[str, ...]
    weakest: Float
    spread: float
    whole: tuple[str, ...] = ()
    motions: tuple[CommonMotion, ...] = ()

    @property
    def relative(self) -> tuple[str, ...]:
        """Names of the common motions that no information determines."""
        return tuple(motion.name for motion in self.motions if not motion.determined)

    @property
    def decision(self) -> Decision:
        """Number of free directions, and the fixed parameters."""
        return Decision(self.null.shape[1], self.open.shape[1], self.held)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the properties that the detections do not determine."""
        return tuple(direction.name for direction in self.directions if direction.free)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences about each undetermined property, the reason, and its constraint."""
        return tuple(text for text, _ in self._remarks)

    @property
    def settled(self) -> tuple[str, ...]:
        """Subset of `sentences` about properties that detections can never determine.

        Scale, rotation, zero point and common motions on the sky are free without a catalogue.
        They are fixed by convention and do not indicate a problem with the data.
        """
        return tuple(text for text, is_settled in self._remarks if is_settled)

    @property
    def unsettled(self) -> tuple[str, ...]:
        """Subset of `sentences` about properties that other data or priors would determine."""
        return tuple(text for text, is_settled in self._remarks if not is_settled)

    @property
    def _remarks(self) -> list[tuple[str, bool]]:
        """Each of `sentences`, with True if it belongs to `settled`."""
        out, free = list[tuple[str, bool]](), set(self.free_names)
        # the degeneracy with a skew of the sky is reported in one sentence
        skew = {"skew_plus", "skew_cross"}
        named = set(POINTS) | (skew if skew & set(self.whole) else set())
        if skew <= named and skew <= free and self.spread < SAME_ROLL:
            text = (
                f"one roll angle (they differ by {np.degrees(self.spread):.2g} deg at most, half "
                "turns apart): a linear skew of the distortion cannot be told from one of the sky"
            )
            out.append((text, False))
        elif skew <= named:
            text = "a linear skew of the distortion cannot be told from one of the sky"
            out.append((text, False))
        for direction in self.directions:
            if direction.free and direction.name == "scale":
                out.append((f"scale: not determined by the detections; {_fixed(direction)}", True))
            elif direction.free and direction.name == "rotation":
                out.append((f"rotation on the sky: free; {_fixed(direction)}", True))
            elif direction.free and direction.name not in named:
                out.append(
                    (
                        f"{direction.name}: not determined by the detections; {_fixed(direction)}",
                        False,
                    )
                )
            elif direction.weak and not direction.free:
                text = (
                    f"{direction.name}: nearly free, {direction.sigma:.2g} {direction.unit} from "
                    f"the detections alone ({direction.sigma * direction.edge_pix:.2g} pix at the "
                    f"edge); {_fixed(direction)}"
                )
                out.append((text, False))
        if set(POINTS) <= free:
            points = [direction for direction in self.directions if direction.name in POINTS]
            worst = max(points, key=lambda direction: direction.sigma_fixed)
            text = (
                f"zero point on the sky: free; {_fixed(worst)}"
                if np.isfinite(worst.sigma_fixed)
                else "the zero point on the sky is free: only relative positions are known"
            )
            out.append((text, True))
        if self.relative:
            text = (
                f"motions are relative: {', '.join(self.relative)} of the whole sky cannot be told "
                "from what the exposures did"
            )
            out.append((text, True))
        if others := [motion.name for motion in self.motions if motion.determined]:
            text = (
                f"{', '.join(others)} of the whole sky: not determined by the detections; the "
                f"constraints that are given determine {'it' if len(others) == 1 else 'them'}"
            )
            out.append((text, True))
        if self.unnamed:
            text = (
                "also free: combinations in which " + ", ".join(self.unnamed) + " stand out; "
                "dither more, or give priors"
            )
            out.append((text, False))
        return out


def _fixed(one: NamedDirection) -> str:
    if one.by_detections:
        return "nothing that is given fixes it better"
    if np.isfinite(one.sigma_fixed):
        size = f"{one.sigma_fixed:.2g} {one.unit}".strip()
        return f"the constraints that are given determine it to {size} (1 sigma)"
    return "held by convention"


def find_gauge(
    problem: Problem,
    theta: Float,
    curvature: Float,
    prior: Prior,
    *,
    known: Float | None = None,
    decision: Decision | None = None,
) -> Gauge:
    """Find the free directions of a problem at a solution theta (D,).

    `curvature` (D, D) is minus the Hessian for the detections alone, with EM weights, so that it is
    indefinite only by rounding.  `known` (D, D) includes the priors of the stars; it equals
    `curvature` by default.  The number of free directions is taken from `decision` or, if it is
    None, determined here.
    """
    model = problem.model
    years = float(np.ptp(problem.groups.epoch)) or 1.0
    scale = parameter_scale(model, theta, years)
    informed = (curvature if known is None else known) + prior.precision
    alone, fixed = (
        _Spectrum.of(H * np.outer(scale, scale), n)
        for H, n in (
            (curvature, None if decision is None else decision.n_null),
            (informed, None if decision is None else decision.n_open),
        )
    )
    null, open_ = alone.free, fixed.free
    held = _pivots(model, open_) if decision is None else decision.held
    directions = _directions(model, theta, scale, alone, fixed)
    named = moves(model, theta)
    moving = _rates_of(problem, theta)
    known_moves = np.stack(  # in pixels at the detector's edge
        [row / scale for row in (named | moving).values()], axis=1
    )
    # compare with nearly free directions too, since a spin slightly bends the paths of moving stars
    loose, still_loose = (s.vectors[:, s.values < WEAK_PIX**-2] for s in (alone, fixed))
    whole = tuple(name for name in GENERATORS if _within(named[name] / scale, null))
    # the epoch at which the sky has not moved yet is arbitrary, which adds moves without time
    at_rest = [named[name] / scale for name in (*POINTS, *whole)]
    motions = []
    for name, row in moving.items():
        free = _within(row / scale, null)
        if free or _within(row / scale, loose):
            undetermined = np.column_stack([open_ if free else still_loose, *at_rest])
            space, _ = np.linalg.qr(undetermined)
            motions.append(CommonMotion(name, free, not _within(row / scale, space)))
    nearly_free = np.flatnonzero(alone.values[alone.n :] < WEAK_PIX**-2) + alone.n
    weakest = np.array(
        [[alone.values[k] ** -0.5, np.argmax(np.abs(alone.vectors[:, k]))] for k in nearly_free]
    ).reshape(-1, 2)
    return Gauge(
        null=null * scale[:, None],
        open=open_ * scale[:, None],
        held=held,
        directions=directions,
        unnamed=_unnamed(model, null, known_moves),
        weakest=weakest,
        spread=largest_roll_difference(model, theta),
        whole=whole,
        motions=tuple(motions),
    )


def _rates_of(problem: Problem, theta: Float) -> dict[str, Float]:
    """Moves (D,) of the entire sky with time, by name; empty if stars have no proper motion."""
    if problem.n_star < 4:
        return {}
    exposure, E = problem.groups.exposure[problem.groups.index], len(problem.model.exposures)
    n_detections = np.maximum(np.bincount(exposure, minlength=E), 1)
    when = np.bincount(exposure, problem.time, E) / n_detections
    out = rates(problem.model, theta, when - when[0])
    if problem.n_star == 5:  # a common parallax shifts the exposures
        out[PARALLAX] = np.zeros(len(theta))
        of_each = [np.bincount(exposure, f, E) / n_detections for f in problem.factor.T]
        for e in range(1, E):
            block = problem.model.frame_slice(e)
            if block.stop - block.start >= 2:
                out[PARALLAX][block.start : block.start + 2] = [f[e] - f[0] for f in of_each]
    return out


def _within(row: Float, null: Float) -> bool:
    """True if a move (D,) is within the space of the free directions (D, d)."""
    remainder = row - null @ (null.T @ row)
    return bool(np.linalg.norm(remainder) < EXPLAINED * np.linalg.norm(row))


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Eigenvalues and eigenvectors of the information, in pixels at the detector's edge.

    The first `n` directions count as free.
    """

    values: Float
    vectors: Float
    n: int

    @classmethod
    def of(cls, scaled: Float, n: int | None) -> _Spectrum:
        """Spectrum of an information matrix (D, D); if `n` is None, eigenvalues determine it."""
        values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
        smallest = max(NULL * float(values[-1]), FREE_PIX**-2)
        return cls(values, vectors, int((values < smallest).sum()) if n is None else n)

    @property
    def free(self) -> Float:
        """Basis (D, n) of the free directions."""
        return self.vectors[:, : self.n]

    def sigma(self, row: Float, edge_pix: float) -> float:
        """Error of the property `row` (D,) @ parameters; infinite if it is free.

        A free direction about which there is some information is not exactly a move of the sky.
        Properties to which it contributes very little are determined in spite of it.
        """
        along = self.vectors.T @ row
        unknown = self.values < ROUNDING * self.values[-1]
        unknown[self.n :] = False
        if np.linalg.norm(along[unknown]) > HIDDEN * np.linalg.norm(row):
            return np.inf
        square = along[~unknown] ** 2 / self.values[~unknown]
        by_free = float(square[: self.n - int(unknown.sum())].sum())
        if np.sqrt(by_free) * edge_pix > WEAK_PIX:
            return np.inf
        return float(np.sqrt(square.sum()))


def _pivots(model: DistortionModel, null: Float) -> Int:
    """Indices of parameters to fix so that no direction is free, of lowest degree if possible."""
    d = null.shape[1]
    if not d:
        return np.zeros(0, np.int64)
    first = model.chips[0].number
    degree = np.array(
        [
            (p.i or 0) + (p.j or 0)
            if p.kind == "polynomial" and p.chip == first
            else 100 + (p.kind != "polynomial")
            for p in model.parameters
        ]
    )
    held: list[int] = []
    remaining = null.copy()
    for level in np.unique(degree):
        rows = np.flatnonzero(degree == level)
        if remaining.shape[1] == 0:
            break
        # u and v contribute equally to a rotation: prefer the first, independent of rounding
        tilt = 1.0 - TIE * np.arange(len(rows)) / len(rows)
        _, R, order = qr(remaining[rows].T * tilt, pivoting=True, mode="economic")
        size = np.abs(np.diag(R))
        take = rows[order[: int((size > MIN_PIVOT).sum())]]
        held += list(take)
        # directions that are still free with these parameters fixed
        _, s, Vt = np.linalg.svd(null[held])
        remaining = null @ Vt[int((s > 1e-9).sum()) :].T
    return np.array(sorted(held), np.int64)


def _directions(
    model: DistortionModel, theta: Float, scale: Float, alone: _Spectrum, fixed: _Spectrum
) -> tuple[NamedDirection, ...]:
    half = max(max(c.size) for c in model.chips) / 2
    pixel = model.pixel_size(theta)
    out = []
    for name, row in functionals(model, theta).items():
        length = "shift" in name or "zero_point" in name
        edge = 1.0 / pixel if length else half
        sigma, sigma_fixed = (spectrum.sigma(row * scale, edge) for spectrum in (alone, fixed))
        unit = model.unit if length else ""
        out.append(NamedDirection(name, unit, sigma, sigma_fixed, edge))
    return tuple(out)


def _unnamed(model: DistortionModel, null: Float, known: Float) -> tuple[str, ...]:
    """Names of the largest parameters in free directions that no move of the sky describes."""
    if not null.shape[1]:
        return ()
    Q, _ = np.linalg.qr(np.concatenate([known, _chip_moves(model)], axis=1))
    remainder = null - Q @ (Q.T @ null)
    U, s, _ = np.linalg.svd(remainder, full_matrices=False)
    out = []
    for k in np.flatnonzero(s > EXPLAINED):
        out += [model.names[at] for at in np.argsort(-np.abs(U[:, k]))[:2]]
    return tuple(dict.fromkeys(out))


def _chip_moves(model: DistortionModel) -> Float:
    """Shifts and linear maps (D, n) of all chips but the first; free without common stars."""
    starts = [
        model.coefficient_slice(c.number, axis).start for c in model.chips[1:] for axis in (0, 1)
    ]
    return np.eye(model.n_params)[:, [at + k for at in starts for k in range(3)]]


def parameter_scale(model: DistortionModel, theta: Float, years: float = 1.0) -> Float:
    """Change (D,) of each parameter that moves positions at the detector's edge by one pixel.

    `years` is the time after which a time-dependent parameter has this effect.
    """
    pixel = model.pixel_size(theta)
    half = max(max(c.size) for c in model.chips) / 2
    out = np.empty(model.n_params)
    for k, p in enumerate(model.parameters):
        if p.kind == "polynomial" or "shift" in p.name.split(".")[-1]:
            out[k] = pixel
        elif p.kind == "tdd":
            out[k] = pixel / years
        else:
            out[k] = 1.0 / half
    return out


def moves(model: DistortionModel, theta: Float) -> dict[str, Float]:
    """Changes (D,) of the parameters that correspond to moves of the entire sky, by name.

    The moves are shifts and linear maps 1 + L about the origin of the frames.  With these changes
    of polynomials and frames, the detections follow the sky: exactly if L commutes with the
    rotations of the exposures, otherwise approximately.
    """
    o = np.asarray(model.origin)
    E = len(model.exposures)
    linear = {name: np.zeros(model.n_params) for name in (*POINTS, *GENERATORS)}
    for chip in model.chips:
        u, v = (model.coefficient_slice(chip.number, axis) for axis in (0, 1))
        poly = np.stack([theta[u], theta[v]])
        poly[:, 0] -= o
        for name, L in GENERATORS.items():
            change = L @ poly
            linear[name][u], linear[name][v] = change
        for axis, name in enumerate(POINTS):
            linear[name][(u, v)[axis].start] = 1.0
    for e in range(1, E):
        block = model.frame_slice(e)
        if block.stop - block.start < 2:
            continue
        M, d = model.frame(theta, e)
        shift = slice(block.start, block.start + 2)
        for name, L in GENERATORS.items():
            linear[name][shift] = L @ d
        for axis, name in enumerate(POINTS):
            linear[name][shift] = np.eye(2)[axis] - M[:, axis]
    return linear


def rates(model: DistortionModel, theta: Float, years: Float) -> dict[str, Float]:
    """Changes (D,) of the frames that correspond to moves of the sky that grow with time, by name.

    Stars with proper motions can follow such moves.  `years` (E,) are the dates of the exposures
    relative to the first one.
    """
    out = {name: np.zeros(model.n_params) for name in RATES}
    for e in range(1, len(model.exposures)):
        names, block = model.free_frame_names(e), model.frame_slice(e)
        if len(names) < 2:
            continue
        M, d = model.frame(theta, e)
        shift = slice(block.start, block.start + 2)
        for axis, name in enumerate(("drift_u", "drift_v")):
            out[name][shift] = years[e] * np.eye(2)[axis]
        if "rotation" in names:
            out["spin"][shift] = years[e] * GENERATORS["rotation"] @ d
            out["spin"][block.start + names.index("rotation")] = years[e]
        if "scale" in names:
            out["expansion"][shift] = years[e] * d
            out["expansion"][block.start + names.index("scale")] = years[e] * np.sqrt(
                np.linalg.det(M)
            )
    return {name: row for name, row in out.items() if row.any()}


def functionals(model: DistortionModel, theta: Float) -> dict[str, Float]:
    """Derivatives (D,) of the properties of a solution with respect to its parameters, by name.

    The properties are those of `NamedDirection`.
    """
    out: dict[str, Float] = {}
    first = model.chips[0]
    maps = {c.number: _sky_map(model, theta, c.number) for c in model.chips}
    places = {c.number: _place(model, c.number) for c in model.chips}
    for axis, name in enumerate(POINTS):
        out[name] = places[first.number][axis]
    out |= _parts(maps[first.number])
    for chip in model.chips[1:]:
        # position of the other chip after undoing the linear map of the first one
        G = maps[first.number]
        gap = np.array([places[chip.number][a] - places[first.number][a] for a in (0, 1)])
        between = gap @ theta
        moved = gap - np.einsum("abd,b->ad", G, between)
        for axis, name in enumerate(("shift_u", "shift_v")):
            out[f"{chip.name}.{name}"] = moved[axis]
        parts = _parts(maps[chip.number] - G)
        out |= {f"{chip.name}.{name}": row for name, row in parts.items()}
    return out


def _linear_part(model: DistortionModel, chip: int | None = None) -> Float:
    """Rows (2, 2, D) that give the derivatives of u and v with respect to x and y.

    They are evaluated at the reference pixel of the chip.
    """
    basis = model.basis(chip)
    by = basis.monomial_matrix[1:3]
    out = np.zeros((2, 2, model.n_params))
    for axis in range(2):
        out[axis, :, model.coefficient_slice(chip, axis)] = by
    return out


def _sky_map(model: DistortionModel, theta: Float, chip: int) -> Float:
    """Rows (2, 2, D) that give the linear map of the sky for a change of a chip's linear part."""
    G = _linear_part(model, chip)
    now = G @ theta
    return np.asarray(np.einsum("abd,bc->acd", G, np.linalg.inv(now)))


def _place(model: DistortionModel, chip: int) -> Float:
    """Rows (2, D) that give the position of a chip's reference pixel."""
    at = model.basis(chip).monomial_matrix[0]
    out = np.zeros((2, model.n_params))
    for axis in range(2):
        out[axis, model.coefficient_slice(chip, axis)] = at
    return out


def _parts(L: Float) -> dict[str, Float]:
    return {
        "scale": (L[0, 0] + L[1, 1]) / 2,
        "rotation": (L[1, 0] - L[0, 1]) / 2,
        "skew_plus": (L[0, 0] - L[1, 1]) / 2,
        "skew_cross": (L[0, 1] + L[1, 0]) / 2,
    }


def largest_roll_difference(model: DistortionModel, theta: Float) -> float:
    """Largest difference of two roll angles in radians, modulo half a turn."""
    angles = []
    for e in range(len(model.exposures)):
        M, _ = model.frame(theta, e)
        angles.append(np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1]))
    worst = 0.0
    for a, b in combinations(np.unique(np.round(angles, 6)), 2):
        off = (a - b) % np.pi
        worst = max(worst, min(off, np.pi - off))
    return float(worst)
