"""Stand-ins for solutions, and the real ACS/WFC coefficients as one."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning
from numpy.typing import NDArray

from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.orientation import lay_on, oriented
from bayesdist.calibration.plane import Orientation, Plane
from bayesdist.formats.idctab.format import idctab_calibration
from bayesdist.formats.idctab.table import IdcTab
from bayesdist.infer import Solution
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.products import registry
from bayesdist.products.common.document import BuildOptions

Float = NDArray[np.float64]

F606W = ("F606W", "CLEAR2L")
POINT, PIXEL = (150.1, 2.2), 0.26  # of `on_sky`: degrees, arcsec
WFC_SIZE, WFC_REF = (4096.0, 2048.0), (2048.0, 1024.0)


@dataclass(frozen=True, eq=False)
class StandIn(Solution):
    """A solution: a model, values and their covariance."""

    model: DistortionModel
    mean: Float
    cov: Float

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        return rng.multivariate_normal(self.mean, self.cov, size=n, method="eigh")


def some_covariance(n: int, scale: float, rng: np.random.Generator) -> Float:
    """A full covariance whose standard deviations are about `scale`."""
    root = rng.normal(size=(n, n)) * scale / np.sqrt(n)
    return root @ root.T


def some_solution(
    order: int = 4,
    *,
    unit: str = "pix",
    size: tuple[float, float] = (1200.0, 900.0),
    reference_pixel: tuple[float, float] = (610.3, 444.7),
    pixel: float = 1.0,
    angle: float = 0.0,
    flip: bool = False,
    offset: tuple[float, float] = (0.0, 0.0),
    strength: float = 3.0,
    seed: int = 1,
) -> StandIn:
    """A distortion of some pixels, rotated, scaled and shifted as told.

    `strength` is the size of the distortion in pixels; `pixel` one pixel in the unit of u, v.
    """
    rng = np.random.default_rng(seed)
    model = DistortionModel(order, (Chip(1, "A", size, reference_pixel),), unit)
    basis = model.basis()
    theta = np.empty(model.n_params)
    identity = np.zeros((2, basis.n_terms))
    identity[0, 1] = identity[1, 2] = 1.0
    plain = basis.from_monomials(identity)
    bumps = rng.normal(size=plain.shape) * strength / 4
    bumps[:, 0] = 0.0
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if flip else 1.0, 1.0])
    coefficients = pixel * turn @ (plain + bumps)
    coefficients[:, 0] += offset
    for axis in (0, 1):
        theta[model.coefficient_slice(None, axis)] = coefficients[axis]
    return StandIn(model, theta, some_covariance(theta.size, 1e-3 * pixel, rng))


def on_sky(order: int, scale: tuple[float, str] | None = None, **what: float) -> Calibration:
    """A turned and mirrored distortion of some pixels, on the sky about POINT."""
    solution = some_solution(
        order, unit="arcsec", pixel=PIXEL, angle=0.4, flip=True, offset=(12.0, -30.0), **what
    )
    return calibration_of(solution, "made up", plane=Plane("sky", point=POINT), scale=scale)


def build_into(
    key: str,
    folder: Path,
    calibration: Calibration,
    options: BuildOptions = BuildOptions(),  # noqa: B008
    **settings: object,
) -> Path:
    """The file of a format in a folder, after those that stand beside it."""
    chosen = registry.product_settings()[key](**settings)
    for one in registry.build(key, calibration, chosen, options):
        path = folder / one.file_name
        path.write_bytes(one.content)
    return path


def wfc_model(order: int, *, drift: bool) -> DistortionModel:
    """ACS/WFC: both chips, in arcseconds; chip 2 first, to which both are referred."""
    chips = tuple(Chip(n, f"WFC{n}", WFC_SIZE, WFC_REF) for n in (2, 1))
    time = TimeDependence((("u", 1, 0), ("v", 1, 0)), (2004.5,)) if drift else None
    return DistortionModel(order, chips, "arcsec", time)


def wfc_solution(
    tab: IdcTab, *, drift: bool = True, vafactor: float = 1.0, sigma: float = 1e-4
) -> StandIn:
    """A real table as a solution: (u, v) from the reference point of chip 2, along Xc and Yc.

    Positions are those of an exposure with this velocity-aberration factor.
    """
    model = wfc_model(tab.norder, drift=drift)
    theta = np.zeros(model.n_params)
    parity = (1.0, -1.0)
    base = tab.rows[tab.row(2, F606W)]
    for chip in (1, 2):
        record = tab.rows[tab.row(chip, F606W)]
        basis = model.basis(chip)
        for axis, values in enumerate(tab.coefficients(chip, F606W)):
            name = ("V2REF", "V3REF")[axis]
            moved = values.copy()
            moved[0] = parity[axis] * (float(record[name]) - float(base[name]))
            theta[model.coefficient_slice(chip, axis)] = basis.from_monomials(moved)
        if drift:
            half = basis.half_size[0]
            rates = [tab.tdd[f"TDD_CXB{chip}"], tab.tdd[f"TDD_CTB{chip}"]]
            theta[model.tdd_slice(chip)] = np.array(rates) * half
    theta *= vafactor
    cov = some_covariance(theta.size, sigma, np.random.default_rng(5))
    return StandIn(model, theta, cov)


def random_pixels(size: tuple[float, float], n: int = 10_000, seed: int = 7) -> tuple[Float, Float]:
    """Pixels anywhere on the detector."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.5, size[0] + 0.5, n), rng.uniform(0.5, size[1] + 0.5, n)


def astropy_wcs(header: fits.Header) -> WCS:
    """astropy's WCS, which remarks that a header without data has no image axes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        return WCS(header)


def laid_on(
    solution, tab: IdcTab, *, filter: tuple[str, ...] | None = None, **options
) -> Orientation:
    """How a solution lies on an IDCTAB."""
    reference = idctab_calibration(tab, None if filter is None else ",".join(filter))
    return lay_on(calibration_of(solution), reference, **options)


def turned_by(solution, orientation: Orientation) -> Calibration:
    """A solution in the plane of the orientation."""
    return oriented(calibration_of(solution), orientation)
