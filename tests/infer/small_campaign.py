"""Small campaigns of known truth: two chips in the reference gauge, exposures at any roll."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.infer import LinearFit
from bayesdist.infer.catalogue.star_covariance import StarCovariance, star_covariance
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.equations.scaled import recolouring
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import lines, without_frames
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.model.frames import CHIP_DEVIATIONS
from bayesdist.simulate import simulate_matches

CHIPS = (
    Chip(1, "WFC1", (4096.0, 2048.0), (2048.0, 1024.0)),
    Chip(2, "WFC2", (4096.0, 2048.0), (2048.0, 1024.0)),
)
DRIFT = (("u", 1, 0), ("v", 1, 0), ("v", 0, 1))
# as ACS ISR 2015-06: A_2, B_3 and B_2, their drift per year, and where WFC1 lies
LINEAR = {
    1: {"A_2": (0.98206, -9.2e-6), "B_3": (0.97263, 2.4e-6), "B_2": (0.08095, 3.6e-5)},
    2: {"A_2": (0.99468, -9.2e-6), "B_3": (1.00622, 3.3e-6), "B_2": (0.06860, 3.5e-5)},
}
PLACE = {
    "A_2": ("u", 1, 0),
    "A_3": ("u", 0, 1),
    "B_2": ("v", 1, 0),
    "B_3": ("v", 0, 1),
}


def campaign_model(
    n_exposures: int,
    *,
    order: int = 3,
    time: bool = True,
    frames: str = "affine",
    rolls=None,
    apart: bool = False,
) -> DistortionModel:
    """The model in the gauge of WFC2, held at the first exposure's pointing."""
    return DistortionModel(
        order,
        CHIPS[::-1] if apart else CHIPS,
        time=TimeDependence(DRIFT, (2004.5,)) if time else None,
        frames=frames,
        exposures=tuple(f"j{k + 1:03d}" for k in range(n_exposures)),
        gauge="held",
        held=(5000.0, 5100.0, 0.4 if rolls is None else float(rolls[0])),
        chip_deviations=apart,
    )


def campaign_truth(
    model: DistortionModel,
    rng: np.random.Generator,
    *,
    tau=(7e-6, 5e-6, 3e-6),
    rolls=None,
    own=None,
) -> np.ndarray:
    """Parameters in the reference gauge; exposures point and roll as they like.

    `own` is the scatter of WFC1 by itself: of shifts (pixels), rotation, scale, shears.
    """
    theta = np.zeros(model.n_params)
    for chip in model.chips:
        basis, linear = model.basis(chip.number), LINEAR[chip.number]
        both = np.zeros((2, model.n_terms))
        for k, (i, j) in enumerate(basis.terms):
            if i + j > 1:
                both[:, k] = 20 * rng.standard_normal(2) / 2048.0 ** (i + j)
        for name, (value, _) in linear.items():
            axis, i, j = PLACE[name]
            both["uv".index(axis), basis.terms.index((i, j))] = value
        if chip.number == 1:
            both[:, 0], both[0, basis.terms.index((0, 1))] = (-0.4, 2079.58), 1.3e-3
        for axis in (0, 1):
            theta[model.coefficient_slice(chip.number, axis)] = basis.from_monomials(both[axis])
        if model.time is not None:
            rates = {PLACE[name]: rate for name, (_, rate) in linear.items()}
            theta[model.tdd_slice(chip.number)] = [
                rates[term] * (2048.0 if term[1] else 1024.0) for term in model.time.terms
            ]
    for code in range(len(model.exposures)):
        names = model.free_frame_names(code)
        value = {
            "shift_u": 5000 + 300 * rng.standard_normal(),
            "shift_v": 5000 + 300 * rng.standard_normal(),
            "rotation": rng.uniform(-np.pi, np.pi) if rolls is None else float(rolls[code]),
            "scale": tau[0] * rng.standard_normal(),
            "shear_plus": tau[1] * rng.standard_normal(),
            "shear_cross": tau[2] * rng.standard_normal(),
        }
        if own is not None:
            value |= {
                f"WFC1.{name}": scatter * rng.standard_normal()
                for name, scatter in zip(CHIP_DEVIATIONS, own, strict=True)
            }
        theta[model.frame_slice(code)] = [value[name] for name in names]
    return theta


def campaign(
    seed: int,
    n_exposures: int,
    per_exposure: int,
    *,
    order: int = 3,
    time: bool = True,
    frames: str = "affine",
    tau=(7e-6, 5e-6, 3e-6),
    sigma: float = 0.02,
    fraction: float = 0.0,
    rolls=None,
    own=None,
    wrong=None,
) -> tuple[DistortionModel, Matches, np.ndarray]:
    """Model, matches and true parameters; `wrong` adds to parameters, by name."""
    rng = np.random.default_rng(seed)
    apart = own is not None
    model = campaign_model(
        n_exposures, order=order, time=time, frames=frames, rolls=rolls, apart=apart
    )
    theta = campaign_truth(model, rng, tau=tau, rolls=rolls, own=own)
    for name, value in (wrong or {}).items():
        theta[model.names.index(name)] += value
    epochs = np.sort(rng.uniform(2002.3, 2007.1, n_exposures))
    matches, _ = simulate_matches(
        model,
        theta,
        n_exposures * per_exposure,
        rng=rng,
        sigma=sigma,
        fraction=fraction,
        outlier_scale=1.0,
        epochs=epochs,
    )
    return model, matches, theta


@dataclass(frozen=True, eq=False)
class SharedStars:
    """A campaign in which every star of a catalogue is in every exposure.

    Parameters
    ----------
    model : DistortionModel
    theta : ndarray, shape (D,)
        The truth.
    matches : Matches
        Where they would be without errors, with the quoted errors.
    position, motion : float
        Errors of the catalogue, pixels and pixels per year from 2004.0.
    """

    model: DistortionModel
    theta: np.ndarray
    matches: Matches
    position: float
    motion: float

    def catalogue_errors(self, rng: np.random.Generator) -> np.ndarray:
        """What one catalogue adds to all matches (N, 2)."""
        code = self.matches.star
        position, motion = rng.standard_normal((2, code.max() + 1, 2))
        years = self.matches.epoch[:, None] - 2004.0
        return self.position * position[code] + years * self.motion * motion[code]

    def with_errors(self, error: np.ndarray) -> Matches:
        """The matches with errors (N, 2)."""
        m = self.matches
        return m.with_columns(u=m.u + error[:, 0], v=m.v + error[:, 1])

    def covariance(self, fit: LinearFit) -> StarCovariance:
        """What the catalogue's errors make of a fit to the matches."""
        n = int(self.matches.star.max()) + 1
        position, motion = np.full((n, 2), self.position), np.full((n, 2), self.motion)
        return star_covariance(fit, self.matches, StarErrors(position, motion, np.full(n, 2004.0)))


def shared_stars(
    rng: np.random.Generator,
    n_stars: int,
    epochs: Sequence[float],
    *,
    order: int,
    centroid: float,
    position: float,
    motion: float,
) -> SharedStars:
    """Stars within 100 pixels of one place in all exposures, so that their errors add up."""
    n_exposures = len(epochs)
    model, matches, theta = campaign(
        6, n_exposures, n_stars, order=order, time=False, frames="shift_rotation"
    )
    model = replace(model, gauge="first", held=(0.0, 0.0, 0.0))
    theta = np.concatenate([theta[: model.n_distortion], theta[-3 * (n_exposures - 1) :]])
    star = np.tile(np.arange(n_stars), n_exposures)
    place = rng.uniform(150, 1900, (n_stars, 2))
    chip = rng.integers(2, size=n_stars)[star]
    x, y = (place[star] + rng.uniform(-100, 100, (len(star), 2))).T * [[2], [1]]
    exposure = np.repeat(np.arange(n_exposures), n_stars)
    epoch = np.asarray(epochs)[exposure]
    quoted = np.sqrt(centroid**2 + position**2 + (motion * (epoch - 2004.0)) ** 2)
    u, v = model.predict(theta, x, y, exposure=exposure, chip=np.array([1, 2])[chip]).T
    measured = {"x": x, "y": y, "u": u, "v": v, "sigma_u": quoted, "sigma_v": quoted}
    matches = matches.with_columns(**measured, exposure=exposure, chip=chip, epoch=epoch, star=star)
    return SharedStars(model, theta, matches, position, motion)


class Truth(Solution):
    """True parameters as a solution without errors."""

    def __init__(self, model: DistortionModel, theta: np.ndarray) -> None:
        self.model, self.mean = model, theta
        self.cov = np.zeros((len(theta), len(theta)))

    def draws(self, n, rng):
        return np.tile(self.mean, (n, 1))


def with_star_errors(solution: Solution, stars: StarCovariance) -> Solution:
    """A solution whose covariance and draws know that a star has one error."""
    return solution.mapped(recolouring(solution.cov, solution.cov + stars.extra))


def seen_by(exposure: str, epoch: float | None, model: DistortionModel, theta: np.ndarray) -> Truth:
    """The polynomials of all chips as one exposure sees them: without frames and without time."""
    chips = [chip.number for chip in model.chips]
    groups = model.groups(len(chips), epoch=epoch, exposure=exposure, chip=chips)
    bare = replace(without_frames(Truth(model, theta)).model, time=None)
    return Truth(bare, model.effective(theta, groups)[groups.index].ravel())


def true_lines(model: DistortionModel, theta: np.ndarray):
    """alpha and beta of the linear terms."""
    return lines(Truth(model, theta))
