"""Directions in which detections alone leave the solution free, and their names.

Stars that move as the model moves leave every residual unchanged.  A linear map of the whole sky is
such a move as far as the exposures can follow it: shift, rotation and scale always, skew where all
exposures have one roll angle.  Free directions are found from the current curvature, and they are
named by the moves that can be written down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.selfcal.problem import Problem
from bayesdist.infer.selfcal.sky_moves import (
    GENERATORS,
    PARALLAX,
    POINTS,
    functionals,
    largest_roll_difference,
    moves,
    parameter_scale,
    rates,
)
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

NULL = 1e-10  # of the largest eigenvalue: no information
ROUNDING = 1e-13  # of the largest eigenvalue: less is only rounding
FREE_PIX = 10.0  # error at the detector's edge above which a direction counts as free
WEAK_PIX = 0.1  # error at the detector's edge above which a direction counts as nearly free
FAR = 3.0  # times the final error: information no better than this does not fix a direction
EXPLAINED = 1e-2  # fraction of a free direction that its names may leave out
SAME_ROLL = np.radians(0.1)
TIE = 0.02  # relative preference for the first of nearly equal parameters over the last
MIN_PIVOT = 0.02
HIDDEN = 1e-5  # of a property that lies along undetermined directions: it is free


@dataclass(frozen=True, eq=False)
class NamedDirection:
    """A property of the solution, and its error."""

    # of `GENERATORS`, relative; 'zero_point_u', 'zero_point_v'; of another chip against the first
    # with its name before: 'WFC1.shift_u', 'WFC1.rotation',
    name: str
    unit: str
    sigma: float  # from the detections alone; infinite where these do not determine it
    # with information from other sources; infinite where the gauge fixes it by convention
    sigma_fixed: float
    edge_pix: float  # displacement by one unit of it at the edge of the detector, pixels

    @property
    def free(self) -> bool:
        """True if the detections do not determine it."""
        return not np.isfinite(self.sigma)

    @property
    def weak(self) -> bool:
        """True if the detections hardly determine it."""
        return self.free or self.sigma * self.edge_pix > WEAK_PIX

    @property
    def by_detections(self) -> bool:
        """True if no other information makes it much better known than the detections."""
        known = np.isfinite(self.sigma) and np.isfinite(self.sigma_fixed)
        return bool(known and self.sigma < FAR * self.sigma_fixed)


@dataclass(frozen=True, eq=False)
class Decision:
    """Directions taken as free and parameters fixed by convention, stored with a solution.

    The error of a direction depends on where it is evaluated, and near a limit two answers would
    differ: then parameters would be fixed, and so have no error, that belong to no free direction.
    """

    n_null: int  # directions that the detections leave free
    n_open: int  # of those, directions that are free even with information from other sources
    held: Int  # parameters (n_open,) that are fixed


@dataclass(frozen=True, eq=False)
class Gauge:
    """The free directions of a problem, and what fixes them."""

    null: Float  # (D, d), basis of the directions that detections leave free
    # (D, k), of those, directions that are free even with information from other sources
    open: Float
    held: Int  # (k,), parameters that are fixed, so that the others are determined
    directions: tuple[NamedDirection, ...]
    # largest parameters in free directions which the names do not describe
    unnamed: tuple[str, ...]
    # (w, 2), of each nearly free combination of parameters: its error in pixels, and index of the
    # largest parameter in it
    weakest: Float
    spread: float  # largest difference of two roll angles, radians, a half turn counted as none
    whole: tuple[str, ...] = ()  # moves of the whole sky that are free, of `GENERATORS`
    # where stars move: moves of the whole sky with time that are free, of `RATES`, and `PARALLAX`
    rates: tuple[str, ...] = ()

    @property
    def decision(self) -> Decision:
        """Number of free directions, and the fixed parameters."""
        return Decision(self.null.shape[1], self.open.shape[1], self.held)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the properties that detections leave free."""
        return tuple(one.name for one in self.directions if one.free)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on each undetermined property, its reason and its constraint."""
        return tuple(text for text, _ in self._remarks)

    @property
    def settled(self) -> tuple[str, ...]:
        """Those of `sentences` on what no detection can determine and the gauge fixes.

        Scale, rotation and zero point on the sky are free without a catalogue, and common motions
        with them: the gauge is a choice, and nothing is wrong with the data.
        """
        return tuple(text for text, is_settled in self._remarks if is_settled)

    @property
    def unsettled(self) -> tuple[str, ...]:
        """Those of `sentences` on what other data or priors would determine."""
        return tuple(text for text, is_settled in self._remarks if not is_settled)

    @property
    def _remarks(self) -> list[tuple[str, bool]]:
        """Each of `sentences`, and True if it is `settled`."""
        out, free = list[tuple[str, bool]](), set(self.free_names)
        # the degeneracy with a skew of the sky is reported at once
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
        for one in self.directions:
            if one.free and one.name == "scale":
                out.append((f"scale: not determined by the detections; {_fixed(one)}", True))
            elif one.free and one.name == "rotation":
                out.append((f"rotation on the sky: free; {_fixed(one)}", True))
            elif one.free and one.name not in named:
                out.append((f"{one.name}: not determined by the detections; {_fixed(one)}", False))
            elif one.weak and not one.free:
                text = (
                    f"{one.name}: nearly free, {one.sigma:.2g} {one.unit} from the detections alone"
                    f" ({one.sigma * one.edge_pix:.2g} pix at the edge); {_fixed(one)}"
                )
                out.append((text, False))
        if set(POINTS) <= free:
            points = [one for one in self.directions if one.name in POINTS]
            worst = max(points, key=lambda one: one.sigma_fixed)
            text = (
                f"zero point on the sky: free; {_fixed(worst)}"
                if np.isfinite(worst.sigma_fixed)
                else "the zero point on the sky is free: only relative positions are known"
            )
            out.append((text, True))
        if self.rates:
            text = (
                f"motions are relative: {', '.join(self.rates)} of the whole sky cannot be told "
                "from what the exposures did"
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
    """Free directions of a problem at a solution.

    `curvature` (D, D) is that of the detections, with EM weights: indefinite only by rounding.
    `known` (D, D) includes the priors of the stars; it equals `curvature` by default.  Without a
    `decision` on the free directions it is made here.
    """
    model = problem.model
    years = float(np.ptp(problem.groups.epoch)) or 1.0
    scale = parameter_scale(model, theta, years)
    both = (curvature if known is None else known) + prior.precision
    alone, fixed = (
        _Spectrum.of(H * np.outer(scale, scale), n)
        for H, n in (
            (curvature, None if decision is None else decision.n_null),
            (both, None if decision is None else decision.n_open),
        )
    )
    null, open_ = alone.free, fixed.free
    held = _pivots(model, open_) if decision is None else decision.held
    directions = _directions(model, theta, scale, alone, fixed)
    named = moves(model, theta)
    moving = _rates_of(problem, theta)
    known_moves = np.stack(  # in pixels at the edge
        [row / scale for row in (named | moving).values()], axis=1
    )
    # a spin bends the paths of stars that move, negligibly
    loose = alone.vectors[:, alone.values < WEAK_PIX**-2]
    weak = np.flatnonzero(alone.values[alone.n :] < WEAK_PIX**-2) + alone.n
    weakest = np.array(
        [[alone.values[k] ** -0.5, np.argmax(np.abs(alone.vectors[:, k]))] for k in weak]
    ).reshape(-1, 2)
    return Gauge(
        null=null * scale[:, None],
        open=open_ * scale[:, None],
        held=held,
        directions=directions,
        unnamed=_unnamed(model, null, known_moves),
        weakest=weakest,
        spread=largest_roll_difference(model, theta),
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
    """True if a move is one of the free directions."""
    left = row - null @ (null.T @ row)
    return bool(np.linalg.norm(left) < EXPLAINED * np.linalg.norm(row))


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Information by its directions, in pixels at the edge; the first `n` of them count as free."""

    values: Float
    vectors: Float
    n: int

    @classmethod
    def of(cls, scaled: Float, n: int | None) -> _Spectrum:
        """Spectrum of an information (D, D); by default it decides how many directions are free."""
        values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
        least = max(NULL * float(values[-1]), FREE_PIX**-2)
        return cls(values, vectors, int((values < least).sum()) if n is None else n)

    @property
    def free(self) -> Float:
        """Basis (D, n) of the free directions."""
        return self.vectors[:, : self.n]

    def sigma(self, row: Float, edge_pix: float) -> float:
        """Error of a property, `row` (D,) times the parameters; infinite where it is free.

        A direction that is free though some information on it exists is not exactly one move of the
        sky: properties in which it has next to no part are determined in spite of it.
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
    """Parameters that leave nothing free once fixed: of the lowest degrees, where possible."""
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
    left = null.copy()
    for level in np.unique(degree):
        rows = np.flatnonzero(degree == level)
        if left.shape[1] == 0:
            break
        # u and v have equal shares in a rotation: the first is taken, and rounding does not choose
        tilt = 1.0 - TIE * np.arange(len(rows)) / len(rows)
        _, R, order = qr(left[rows].T * tilt, pivoting=True, mode="economic")
        size = np.abs(np.diag(R))
        take = rows[order[: int((size > MIN_PIVOT).sum())]]
        held += list(take)
        # still free once these are fixed
        _, s, Vt = np.linalg.svd(null[held])
        left = null @ Vt[int((s > 1e-9).sum()) :].T
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
        sigma, sigma_fixed = (one.sigma(row * scale, edge) for one in (alone, fixed))
        unit = model.unit if length else ""
        out.append(NamedDirection(name, unit, sigma, sigma_fixed, edge))
    return tuple(out)


def _unnamed(model: DistortionModel, null: Float, known: Float) -> tuple[str, ...]:
    """Largest parameters in the part of the free directions that no move of the sky describes."""
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
    """Shifts and linear maps (D, n) of each further chip, free if no star ties it to the first."""
    starts = [
        model.coefficient_slice(c.number, axis).start for c in model.chips[1:] for axis in (0, 1)
    ]
    return np.eye(model.n_params)[:, [at + k for at in starts for k in range(3)]]
