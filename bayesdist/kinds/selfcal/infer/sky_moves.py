"""Moves of the entire sky as changes of the parameters."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

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
