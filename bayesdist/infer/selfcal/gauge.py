"""What detections alone cannot tell: directions in which the solution is free, and their names.

Stars that move as the model moves leave every residual as it is.  A linear map of the whole sky is
such a move as far as the exposures can follow it: shift, rotation and scale always, skew where all
exposures have one roll angle.  Which directions are free is found from the curvature at hand, and
they are named by the moves that can be written down.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from bayesdist.infer.selfcal.information import Information, linear_part
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.model import DistortionModel

__all__ = [
    "FAR",
    "GENERATORS",
    "SAME_ROLL",
    "Gauge",
    "NamedDirection",
    "find_gauge",
    "functionals",
    "moves",
    "parameter_scale",
    "roll_spread",
]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# of the linear maps of the sky
GENERATORS = {
    "scale": np.array([[1.0, 0.0], [0.0, 1.0]]),
    "rotation": np.array([[0.0, -1.0], [1.0, 0.0]]),
    "skew_plus": np.array([[1.0, 0.0], [0.0, -1.0]]),
    "skew_cross": np.array([[0.0, 1.0], [1.0, 0.0]]),
}
RATES = ("drift_u", "drift_v", "spin", "expansion")  # of the sky, where stars move
PARALLAX = "parallax"  # of the whole sky, where stars have one
POINTS = ("zero_point_u", "zero_point_v")
NULL = 1e-10  # of the largest eigenvalue: no information but rounding
FREE_PIX = 10.0  # error at the detector's edge above which a direction counts as free
WEAK_PIX = 0.1  # error at the detector's edge above which a direction counts as nearly free
FAR = 3.0  # times the final error: what knows a direction no better than this does not fix it
EXPLAINED = 1e-2  # share of a free direction that its names may leave out
SAME_ROLL = np.radians(0.1)
LEAST_PIVOT = 0.02


@dataclass(frozen=True, eq=False)
class NamedDirection:
    """A property of the solution, and how far it is known.

    Parameters
    ----------
    name : str
        Of `GENERATORS`, relative; 'zero_point_u', 'zero_point_v'; of another chip against the first
        with its name before: 'WFC1.shift_u', 'WFC1.rotation', ...
    unit : str
    sigma : float
        From the detections alone; infinite where these say nothing.
    sigma_fixed : float
        With what is known beside them; infinite where the gauge holds it by convention.
    edge_pix : float
        What one unit of it is at the edge of the detector, pixels.
    """

    name: str
    unit: str
    sigma: float
    sigma_fixed: float
    edge_pix: float

    @property
    def free(self) -> bool:
        """Whether the detections say nothing about it."""
        return not np.isfinite(self.sigma)

    @property
    def weak(self) -> bool:
        """Whether they say next to nothing."""
        return self.free or self.sigma * self.edge_pix > WEAK_PIX

    @property
    def by_detections(self) -> bool:
        """Whether nothing that is known beside the detections makes it much better."""
        known = np.isfinite(self.sigma) and np.isfinite(self.sigma_fixed)
        return bool(known and self.sigma < FAR * self.sigma_fixed)


@dataclass(frozen=True, eq=False)
class Gauge:
    """The free directions of a problem, and what fixes them.

    Parameters
    ----------
    null : ndarray, shape (D, d)
        Basis of the directions that detections leave free.
    open : ndarray, shape (D, k)
        Of those, what is free even with what is known beside the detections.
    held : ndarray of int, shape (k,)
        Parameters that are held, so that the others are determined.
    directions : tuple of NamedDirection
    unnamed : tuple of str
        Parameters that stand out in free directions which the names do not describe.
    weakest : ndarray, shape (w, 2)
        Of each nearly free combination of parameters: its error in pixels, and index of the
        parameter that stands out in it.
    spread : float
        Largest difference of two roll angles, radians, a half turn counted as none.
    whole : tuple of str
        Moves of the whole sky that are free, of `GENERATORS`.
    rates : tuple of str
        Where stars move: moves of the whole sky with time that are free, of `RATES`, and
        `PARALLAX`.
    """

    null: Float
    open: Float
    held: Int
    directions: tuple[NamedDirection, ...]
    unnamed: tuple[str, ...]
    weakest: Float
    spread: float
    whole: tuple[str, ...] = ()
    rates: tuple[str, ...] = ()

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the properties that detections leave free."""
        return tuple(one.name for one in self.directions if one.free)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What cannot be known, why, and what fixes it."""
        out, free = list[str](), set(self.free_names)
        # what cannot be told from a skew of the sky is said at once
        skew = {"skew_plus", "skew_cross"}
        told = set(POINTS) | (skew if skew & set(self.whole) else set())
        if skew <= told and skew <= free and self.spread < SAME_ROLL:
            out.append(
                f"one roll angle (they differ by {np.degrees(self.spread):.2g} deg at most, half "
                "turns apart): a linear skew of the distortion cannot be told from one of the sky"
            )
        elif skew <= told:
            out.append("a linear skew of the distortion cannot be told from one of the sky")
        for one in self.directions:
            if one.free and one.name == "scale":
                out.append(f"scale: the detections say nothing of it; {_fixed(one)}")
            elif one.free and one.name == "rotation":
                out.append(f"rotation on the sky: free; {_fixed(one)}")
            elif one.free and one.name not in told:
                out.append(f"{one.name}: the detections say nothing of it; {_fixed(one)}")
            elif one.weak and not one.free:
                out.append(
                    f"{one.name}: nearly free, {one.sigma:.2g} {one.unit} from the detections alone"
                    f" ({one.sigma * one.edge_pix:.2g} pix at the edge); {_fixed(one)}"
                )
        if set(POINTS) <= free:
            points = [one for one in self.directions if one.name in POINTS]
            worst = max(points, key=lambda one: one.sigma_fixed)
            out.append(
                f"zero point on the sky: free; {_fixed(worst)}"
                if np.isfinite(worst.sigma_fixed)
                else "the zero point on the sky is free: only relative positions are known"
            )
        if self.rates:
            out.append(
                f"motions are relative: {', '.join(self.rates)} of the whole sky cannot be told "
                "from what the exposures did"
            )
        if self.unnamed:
            out.append(
                "also free: combinations in which " + ", ".join(self.unnamed) + " stand out; "
                "dither more, or give priors"
            )
        return tuple(out)


def _fixed(one: NamedDirection) -> str:
    if one.by_detections:
        return "nothing that is given fixes it better"
    if np.isfinite(one.sigma_fixed):
        return f"fixed by what is given beside them, sigma {one.sigma_fixed:.2g} {one.unit}".strip()
    return "held by convention"


def parameter_scale(model: DistortionModel, theta: Float, years: float = 1.0) -> Float:
    """What a pixel at the edge of the detector is in each parameter, (D,)."""
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
    """Moves of the whole sky as changes of the parameters, each (D,).

    For shift t and linear map 1 + L about the frames' origin: those changes of polynomials and
    frames by which every detection moves as the sky does, exactly where L commutes with the
    exposures' rotations, and nearly where it does not.
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
    """Moves of the whole sky that grow with time, as changes (D,) of the exposures' frames.

    Stars follow them where they have motions.

    Parameters
    ----------
    model : DistortionModel
    theta : ndarray, shape (D,)
    years : ndarray, shape (E,)
        Since the first exposure.
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
    """Properties of a solution as rows (D,): their change is row @ change of theta."""
    out: dict[str, Float] = {}
    first = model.chips[0]
    maps = {c.number: _sky_map(model, theta, c.number) for c in model.chips}
    places = {c.number: _place(model, c.number) for c in model.chips}
    for axis, name in enumerate(POINTS):
        out[name] = places[first.number][axis]
    out |= _parts(maps[first.number])
    for chip in model.chips[1:]:
        # where the other chip lies when the first one has been brought back
        G = maps[first.number]
        gap = np.array([places[chip.number][a] - places[first.number][a] for a in (0, 1)])
        between = gap @ theta
        moved = gap - np.einsum("abd,b->ad", G, between)
        for axis, name in enumerate(("shift_u", "shift_v")):
            out[f"{chip.name}.{name}"] = moved[axis]
        parts = _parts(maps[chip.number] - G)
        out |= {f"{chip.name}.{name}": row for name, row in parts.items()}
    return out


def _sky_map(model: DistortionModel, theta: Float, chip: int) -> Float:
    """Rows (2, 2, D) of the linear map of the sky that a change of the chip's linear part is."""
    G = linear_part(model, chip)
    now = G @ theta
    return np.asarray(np.einsum("abd,bc->acd", G, np.linalg.inv(now)))


def _place(model: DistortionModel, chip: int) -> Float:
    """Rows (2, D) of where a chip's reference pixel lies."""
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


def roll_spread(model: DistortionModel, theta: Float) -> float:
    """Largest difference of two roll angles, radians; a half turn counts as none."""
    angles = []
    for e in range(len(model.exposures)):
        M, _ = model.frame(theta, e)
        angles.append(np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1]))
    worst = 0.0
    for a, b in combinations(np.unique(np.round(angles, 6)), 2):
        off = (a - b) % np.pi
        worst = max(worst, min(off, np.pi - off))
    return float(worst)


def find_gauge(
    problem: Problem,
    theta: Float,
    curvature: Float,
    information: Information,
    *,
    known: Float | None = None,
) -> Gauge:
    """Free directions of a problem at a solution.

    Parameters
    ----------
    problem : Problem
    theta : ndarray, shape (D,)
    curvature : ndarray, shape (D, D)
        Of the detections, with EM weights: never indefinite but by rounding.
    information : Information
    known : ndarray, shape (D, D), optional
        Curvature with what is known of the stars beforehand; the same by default.
    """
    model = problem.model
    years = float(np.ptp(problem.groups.epoch)) or 1.0
    scale = parameter_scale(model, theta, years)
    null, values, vectors = _null(curvature * np.outer(scale, scale))
    both = (curvature if known is None else known) + information.precision
    open_, *_ = _null(both * np.outer(scale, scale))
    held = _pivots(model, open_)
    directions = _directions(model, theta, scale, null, curvature, open_, both)
    named = moves(model, theta)
    moving = _rates_of(problem, theta)
    known_moves = np.stack(  # in pixels at the edge
        [row / scale for row in (named | moving).values()], axis=1
    )
    # a spin bends the paths of stars that move, by next to nothing
    loose = vectors[:, values < WEAK_PIX**-2]
    weak = (values > _least(values)) & (values < WEAK_PIX**-2)
    weakest = np.array(
        [[values[k] ** -0.5, np.argmax(np.abs(vectors[:, k]))] for k in np.flatnonzero(weak)]
    ).reshape(-1, 2)
    return Gauge(
        null=null * scale[:, None],
        open=open_ * scale[:, None],
        held=held,
        directions=directions,
        unnamed=_unnamed(model, null, known_moves),
        weakest=weakest,
        spread=roll_spread(model, theta),
        whole=tuple(name for name in GENERATORS if _within(named[name] / scale, null)),
        rates=tuple(name for name, row in moving.items() if _within(row / scale, loose)),
    )


def _rates_of(problem: Problem, theta: Float) -> dict[str, Float]:
    """Moves with time of the stars' sky; none where stars do not move."""
    if problem.n_star < 4:
        return {}
    exposure, E = problem.groups.exposure[problem.groups.index], len(problem.model.exposures)
    seen = np.maximum(np.bincount(exposure, minlength=E), 1)
    when = np.bincount(exposure, problem.time, E) / seen
    out = rates(problem.model, theta, when - when[0])
    if problem.n_star == 5:  # exposures are shifted as all stars are
        out[PARALLAX] = np.zeros(len(theta))
        of_each = [np.bincount(exposure, f, E) / seen for f in problem.factor.T]
        for e in range(1, E):
            block = problem.model.frame_slice(e)
            if block.stop - block.start >= 2:
                out[PARALLAX][block.start : block.start + 2] = [f[e] - f[0] for f in of_each]
    return out


def _within(row: Float, null: Float) -> bool:
    """Whether a move is one of the free directions."""
    left = row - null @ (null.T @ row)
    return bool(np.linalg.norm(left) < EXPLAINED * np.linalg.norm(row))


def _null(scaled: Float) -> tuple[Float, Float, Float]:
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    return vectors[:, values < _least(values)], values, vectors


def _least(values: Float) -> float:
    """Eigenvalue, in pixels^-2 at the edge, below which a direction is free."""
    return max(NULL * float(values[-1]), FREE_PIX**-2)


def _pivots(model: DistortionModel, null: Float) -> Int:
    """Parameters whose holding leaves nothing free: of the lowest degrees, where these serve."""
    d = null.shape[1]
    if not d:
        return np.zeros(0, np.int64)
    first = model.chips[0].number
    degree = np.array(
        [
            p.i + p.j  # type: ignore[operator]
            if p.kind == "polynomial" and p.chip == first
            else 100 + (p.kind != "polynomial")
            for p in model.parameters
        ]
    )
    held: list[int] = []
    left = null.copy()
    for level in np.unique(degree):
        rows = np.flatnonzero(degree == level)
        if left.shape[1] == 0:
            break
        _, R, order = qr(left[rows].T, pivoting=True, mode="economic")
        size = np.abs(np.diag(R))
        take = rows[order[: int((size > LEAST_PIVOT).sum())]]
        held += list(take)
        # what is still free once these are held
        _, s, Vt = np.linalg.svd(null[held])
        left = null @ Vt[int((s > 1e-9).sum()) :].T
    return np.array(sorted(held), np.int64)


def _directions(
    model: DistortionModel,
    theta: Float,
    scale: Float,
    null: Float,
    curvature: Float,
    open_: Float,
    both: Float,
) -> tuple[NamedDirection, ...]:
    alone, fixed = (_inverse(H, scale) for H in (curvature, both))
    half = max(max(c.size) for c in model.chips) / 2
    pixel = model.pixel_size(theta)
    out = []
    for name, row in functionals(model, theta).items():
        length = "shift" in name or "zero_point" in name
        sigmas = []
        for cov, free in ((alone, null), (fixed, open_)):
            scaled = row * scale
            hidden = np.linalg.norm(free.T @ scaled) > 1e-5 * np.linalg.norm(scaled)
            sigmas.append(np.inf if hidden else float(np.sqrt(row @ cov @ row)))
        out.append(
            NamedDirection(
                name,
                model.unit if length else "",
                sigmas[0],
                sigmas[1],
                edge_pix=1.0 / pixel if length else half,
            )
        )
    return tuple(out)


def _inverse(H: Float, scale: Float) -> Float:
    """Pseudo-inverse (D, D), without the free directions."""
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    good = values >= _least(values)
    root = (vectors[:, good] / np.sqrt(values[good])) * scale[:, None]
    return np.asarray(root @ root.T)


def _unnamed(model: DistortionModel, null: Float, known: Float) -> tuple[str, ...]:
    """Parameters that stand out in what of the free directions no move of the sky describes."""
    if not null.shape[1]:
        return ()
    Q, _ = np.linalg.qr(np.concatenate([known, _chip_moves(model)], axis=1))
    left = null - Q @ (Q.T @ null)
    U, s, _ = np.linalg.svd(left, full_matrices=False)
    out = []
    for k in np.flatnonzero(s > EXPLAINED):
        for at in np.argsort(-np.abs(U[:, k]))[:2]:
            out.append(model.names[at])
    return tuple(dict.fromkeys(out))


def _chip_moves(model: DistortionModel) -> Float:
    """Shifts and linear maps (D, n) of each further chip, which no star may tie to the first."""
    starts = [
        model.coefficient_slice(c.number, axis).start for c in model.chips[1:] for axis in (0, 1)
    ]
    return np.eye(model.n_params)[:, [at + k for at in starts for k in range(3)]]
