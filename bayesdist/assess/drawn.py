"""All errors of a position, drawn once, and statistics of them over parts of the detector.

What is drawn serves every requirement, epoch and part of the detector, and every question of the
kind "what if this term were half as large": so differences between answers are not differences of
draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.domain import EvaluationDomain, WorstPosition
from bayesdist.assess.judged_statistics import ErrorsOf, drawn_statistics
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.field_terms import FieldTerm
from bayesdist.assess.terms.fields import MODEL, ErrorDraws, ErrorFields, draw_errors
from bayesdist.assess.terms.given import LocalTerm, UserTerm
from bayesdist.assess.terms.sizes import drawn_squares, resized
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.model.grid import grid_pixels, mesh

__all__ = ["CENTROID", "DomainFields", "PositionErrors", "position_errors", "sigma_at"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

CENTROID = "centroid"

BLOCK = 200_000  # places times draws whose errors a thread holds at once
SMOOTH_ORDER = 3  # of fields that stand for what may vary over the detector
SMOOTH_DRAWS = 1000
BEYOND = 0.5  # magnitudes by which the outermost bins may be left
MOST_PAIRS = 5000  # pairs of positions that stand for all: percentiles over them to about 1 %


@dataclass(frozen=True, eq=False)
class DomainFields:
    """Error fields at the positions of a domain.

    Parameters
    ----------
    domain : EvaluationDomain
    fields : tuple of ErrorFields
        One for each chip.
    """

    domain: EvaluationDomain
    fields: tuple[ErrorFields, ...]

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts that are fields, without the joint error."""
        return tuple(name for name in self.fields[0].parts if name != MODEL)

    def variance(self, part: str) -> Float:
        """Mean square of a part at each position, (N, 2)."""
        return np.concatenate([np.stack(f.sigma(part), axis=1) ** 2 for f in self.fields])

    def values(self, part: str) -> Float:
        """Errors (n, N, 2) of all draws."""
        return np.concatenate([f.field(part) for f in self.fields], axis=1)

    def joint(self, rows: slice, shrink: Mapping[str, float]) -> Float:
        """The joint error (rows, N, 2) of some draws, parts of it taken off to a factor."""
        return np.concatenate([_shrunk(f, rows, shrink) for f in self.fields], axis=1)

    def factor(self, shrink: Mapping[str, float]) -> Float | float:
        """What multiplies the joint error (N, 2) where parts shrink that cannot be taken off.

        The spread of the solution shrinks at each position as the part's share in its variance
        says.
        """
        held = shrink.keys() & set(self.parts)
        if not held:
            return 1.0
        whole = self.variance(MODEL)
        left = whole - sum(
            (1.0 - shrink[name] ** 2) * np.minimum(self.variance(name), whole) for name in held
        )
        return np.sqrt(np.maximum(left, 0.0) / np.where(whole > 0, whole, 1.0))


def _shrunk(fields: ErrorFields, rows: slice, shrink: Mapping[str, float]) -> Float:
    """The joint error (rows, N, 2) of some draws with some of its parts shrunk."""
    parts = fields.polynomials
    joint = parts[MODEL][rows]
    for name in shrink.keys() & parts.keys():
        joint = joint - (1.0 - shrink[name]) * parts[name][rows]
    return replace(fields, polynomials={MODEL: joint}).field(MODEL)


@dataclass(frozen=True, eq=False)
class PositionErrors:
    """Draws of everything that moves a position.

    Parameters
    ----------
    fields : ErrorDraws
        Of the errors that are fields over the detector.
    terms : tuple of UserTerm
    sigmas : tuple of (float, float)
        Of these terms, in the unit of the solution.
    local : tuple of LocalTerm
    centroid : MagnitudeErrors or None
        Errors of a star's centroid, in the unit of the solution.
    grid : tuple of int
        Points on x and y of a chip.
    n_draws : int
    unit : str
    offsets : ndarray, shape (n_draws, 2)
        Standard normal: of the systematic terms, one for the whole field.
    seed : int
        Of the errors that are independent from place to place.
    squares : ndarray, shape (n_draws, terms, chips, 2)
        By which the squares of the local terms are multiplied: they are not known better than
        their errors say.
    """

    fields: ErrorDraws
    terms: tuple[UserTerm, ...]
    sigmas: tuple[tuple[float, float], ...]
    local: tuple[LocalTerm, ...]
    centroid: MagnitudeErrors | None
    grid: tuple[int, int]
    n_draws: int
    unit: str
    offsets: Float
    seed: int
    squares: Float
    _kept: dict[EvaluationDomain, DomainFields] = field(default_factory=dict, repr=False)

    def varied(self) -> tuple[PositionErrors, ...]:
        """The same draws with what may vary over the field varying: smoothly, and everywhere.

        Nothing where no term may vary.
        """
        moving = [t.varies and t.kind == "systematic" and any(s) for t, s in self._sized]
        if not any(moving):
            return ()
        everywhere = [
            replace(t, kind="random") if moves else t
            for t, moves in zip(self.terms, moving, strict=True)
        ]
        still = [pair for pair, moves in zip(self._sized, moving, strict=True) if not moves]
        smooth = [
            self._smooth(*pair, np.random.default_rng([self.seed, k]))
            for k, (pair, moves) in enumerate(zip(self._sized, moving, strict=True))
            if moves
        ]
        shape = (self.n_draws, len(smooth), *self.squares.shape[2:])
        return (
            replace(
                self,
                terms=tuple(t for t, _ in still),
                sigmas=tuple(s for _, s in still),
                local=(*self.local, *smooth),
                squares=np.concatenate([self.squares, np.ones(shape)], axis=1),
            ),
            replace(self, terms=tuple(everywhere)),
        )

    def _smooth(
        self, term: UserTerm, sigma: tuple[float, float], rng: np.random.Generator
    ) -> LocalTerm:
        """A term as a smooth field of its size over each chip, larger at the edges than inside.

        As the distortion of a catalogue, or of another camera, would be.
        """
        n, drawn = min(self.n_draws, SMOOTH_DRAWS), {}
        for chip in self.fields.whole.solution.model.chips:
            basis = PolynomialBasis(SMOOTH_ORDER, chip.size, chip.reference_pixel)
            phi = basis.evaluate(*mesh(*grid_pixels(chip.size, self.grid)))
            phi = phi * np.sqrt(len(phi) / np.square(phi).sum())
            field = rng.standard_normal((n, 2, phi.shape[1])) @ phi.T
            field = np.swapaxes(field, 1, 2) * sigma
            drawn[chip.number] = field.reshape(n, *self.grid[::-1], 2)
        one = {c: np.sqrt(np.mean(np.square(d), axis=0)) for c, d in drawn.items()}
        return LocalTerm(term.name, one, term.source, drawn=drawn)

    @property
    def _sized(self) -> list[tuple[UserTerm, tuple[float, float]]]:
        return list(zip(self.terms, self.sigmas, strict=True))

    def at(self, domain: EvaluationDomain) -> DomainFields:
        """Error fields at the positions of a domain."""
        key = domain.positions
        if key not in self._kept:
            points = {chip: (key.x[rows], key.y[rows]) for chip, rows in key.by_chip()}
            self._kept[key] = DomainFields(key, self.fields.at(points, epoch=key.epoch))
        return self._kept[key]

    def names(self, domain: EvaluationDomain) -> tuple[str, ...]:
        """All terms that an error is made of there."""
        parts = self.at(domain).parts
        own = [CENTROID] if domain.magnitude is not None else []
        return (*parts, *(t.name for t in self.local), *(t.name for t in self.terms), *own)

    def statistics(
        self,
        domain: EvaluationDomain,
        names: Sequence[str],
        *,
        shrink: Mapping[str, float] | None = None,
        n_draws: int | None = None,
    ) -> dict[str, Float]:
        """Statistics of each draw's error over the positions.

        Parameters
        ----------
        domain : EvaluationDomain
        names : sequence of str
            Of `STATISTICS`.
        shrink : mapping of str to float, optional
            Factors by which terms are multiplied.
        n_draws : int, optional
            The first so many of the draws; all by default.

        Returns
        -------
        dict of str to ndarray, shape (n_draws,)

        Raises
        ------
        InputError
            For no pair of positions that near, a magnitude where no errors by magnitude are known,
            and a missing epoch.
        """
        (found,) = self.course((domain,), names, shrink=shrink, n_draws=n_draws)
        return found

    def course(
        self,
        cases: Sequence[EvaluationDomain],
        names: Sequence[str],
        *,
        shrink: Mapping[str, float] | None = None,
        n_draws: int | None = None,
    ) -> tuple[dict[str, Float], ...]:
        """The same at several epochs, sooner than one by one.

        Parameters
        ----------
        cases : sequence of EvaluationDomain
            That differ in their epochs only.
        names, shrink, n_draws
            As `statistics`.

        Returns
        -------
        tuple of dict of str to ndarray, shape (n_draws,)
            One for each case.
        """
        domain = cases[0]
        pairs = domain.pairs()
        if pairs is not None and pairs.shape[1] > MOST_PAIRS:
            rng = np.random.default_rng(self.seed)
            pairs = pairs[:, rng.choice(pairs.shape[1], MOST_PAIRS, replace=False)]
        return drawn_statistics(
            [self._errors(case, shrink or {}) for case in cases],
            names,
            n_draws=n_draws or self.n_draws,
            n_places=domain.size,
            block=BLOCK,
            seed=self.seed,
            pairs=pairs,
            over_all=domain.relative == "pairs" and domain.separation is None,
        )

    def worst(self, domain: EvaluationDomain, axis: str = "") -> WorstPosition:
        """The place at which the error is largest; of two positions, the one farther off.

        Parameters
        ----------
        domain : EvaluationDomain
        axis : {'', 'u', 'v'}
            Of which axis; of both by default.
        """
        drawn = self.at(domain)
        variance = drawn.variance(MODEL)
        for shared, sigma in self._added(domain, {}):
            if not (shared and domain.relative):
                variance = variance + sigma**2
        total = variance.sum(axis=1) if not axis else variance[:, "uv".index(axis)]
        k = int(np.argmax(total))
        at = int(domain.chip[k]), float(domain.x[k]), float(domain.y[k])
        return WorstPosition(*at, float(np.sqrt(total[k])))

    def size(self, domain: EvaluationDomain, name: str) -> float:
        """Radial root mean square of one term over the positions."""
        drawn = self.at(domain)
        if name in (*drawn.parts, MODEL):
            variance = drawn.variance(name)
        else:
            others = {other: 0.0 for other in self.names(domain) if other != name}
            variance = sum(s**2 for _, s in self._added(domain, others))
        return float(np.sqrt(np.mean(variance.sum(axis=1))))

    def centroid_at(self, magnitude: float) -> Float:
        """Errors (2,) of the centroid of a star.

        Raises
        ------
        InputError
            Where no errors by magnitude are known, or none near this one.
        """
        if self.centroid is None:
            raise InputError(
                f"the error of a star of magnitude {magnitude:g} is not known",
                where="magnitude",
                do="give the matches magnitudes, or leave it out",
            )
        low, high = self.centroid.mag[0] - BEYOND, self.centroid.mag[-1] + BEYOND
        if not low <= magnitude <= high:
            raise InputError(
                f"centroids of magnitude {magnitude:g} were not measured, but those of "
                f"{low:.1f} to {high:.1f}",
                where="magnitude",
                do="name one of these",
            )
        return np.ravel(self.centroid.at([magnitude]))

    # -- the draws --------------------------------------------------------------------------------

    def _errors(self, domain: EvaluationDomain, shrink: Mapping[str, float]) -> ErrorsOf:
        """All terms together; noise is the same at every epoch and for every what-if."""
        fields, added = self.at(domain), self._added(domain, shrink, spread=False)
        shared, single = (
            np.sqrt(sum(s**2 for is_shared, s in added if is_shared == which))
            for which in (True, False)
        )
        exact = {name: s for name, s in shrink.items() if self._beside(name)}
        factor = fields.factor({k: s for k, s in shrink.items() if k not in exact})
        own = [s for _, s in added[2 + len(self.terms) :][: len(self.local)]]
        chip = domain.chip_code
        common = [
            (_drawn_at(term, domain), shrink.get(term.name, 1.0))
            for term in self.local
            if term.drawn
        ]

        def error_of(rows: slice, noise: Float) -> Float:
            error = fields.joint(rows, exact)
            error *= factor
            error += self.offsets[rows, None, :] * shared
            if np.any(single):
                error += noise * resized(single, own, self.squares[rows], chip)
            for drawn, size in common:
                which = np.arange(rows.start, rows.stop) % len(drawn)
                error += size * drawn[which]
            return error

        return error_of

    def _beside(self, name: str) -> bool:
        """Whether a part is drawn together with the joint error, so that it can be taken off it."""
        if name in self.fields.terms:
            return name in self.fields.added
        return self.fields.whole is self.fields.shown

    def _added(
        self, domain: EvaluationDomain, shrink: Mapping[str, float], *, spread: bool = True
    ) -> list[tuple[bool, Float]]:
        """Whether all places share an error, and its sigmas (N, 2), of terms that are no fields.

        Without `spread` those of terms that have draws of their own are zero.
        """
        N = domain.size
        out = [(True, np.zeros((N, 2))), (False, np.zeros((N, 2)))]
        for term, sigma in zip(self.terms, self.sigmas, strict=True):
            value = np.tile(sigma, (N, 1)) * shrink.get(term.name, 1.0)
            out.append((term.kind == "systematic", value))
        for one in self.local:
            if one.drawn and not spread:
                out.append((False, np.zeros((N, 2))))
                continue
            out.append((False, sigma_at(one, domain) * shrink.get(one.name, 1.0)))
        if domain.magnitude is not None:
            at = self.centroid_at(domain.magnitude)
            out.append((False, np.tile(at, (N, 1)) * shrink.get(CENTROID, 1.0)))
        return out


def sigma_at(term: LocalTerm, domain: EvaluationDomain) -> Float:
    """Standard deviations (N, 2) of a local term."""
    chips = {chip.number: chip for chip in domain.model.chips}
    parts = [
        term.at(number, chips[number].size, domain.x[rows], domain.y[rows])
        for number, rows in domain.by_chip()
    ]
    return np.concatenate(parts)


def _drawn_at(term: LocalTerm, domain: EvaluationDomain) -> NDArray[np.floating]:
    """Draws (n, N, 2) of a local term at points of its grid."""
    chips, parts = {chip.number: chip for chip in domain.model.chips}, []
    for number, rows in domain.by_chip():
        drawn = term.drawn[number]
        ix, iy = (
            np.rint((at[rows] - 1.0) / (size - 1.0) * (n - 1)).astype(np.int64)
            for at, size, n in zip(
                (domain.x, domain.y), chips[number].size, drawn.shape[2:0:-1], strict=True
            )
        )
        parts.append(drawn[:, iy, ix])
    return np.concatenate(parts, axis=1)


def position_errors(
    solution: Solution,
    *,
    terms: Sequence[UserTerm] = (),
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
    local: Sequence[LocalTerm] = (),
    centroid: MagnitudeErrors | None = None,
    grid: tuple[int, int],
    n_draws: int,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
) -> PositionErrors:
    """Draw all errors of a position.

    Parameters
    ----------
    solution, terms, fields, aligned, local, grid, n_draws, rng, pixel_scale
        As `check_requirements`.
    centroid : MagnitudeErrors, optional
        Errors of centroids by magnitude, in the unit of the solution.

    Returns
    -------
    PositionErrors

    Raises
    ------
    InputError
        For fewer than two draws, and units that need a pixel scale that is not known.
    """
    unit = solution.model.unit
    sigmas = tuple(t.sigma(unit, pixel_scale) for t in terms)
    return PositionErrors(
        fields=draw_errors(solution, n_draws, rng, fields=fields, aligned=aligned),
        terms=tuple(terms),
        sigmas=sigmas,
        local=tuple(local),
        centroid=centroid,
        grid=grid,
        n_draws=n_draws,
        unit=unit,
        offsets=rng.standard_normal((n_draws, 2)),
        seed=int(rng.integers(2**63)),
        squares=drawn_squares(local, [chip.number for chip in solution.model.chips], n_draws, rng),
    )
