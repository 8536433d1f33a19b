"""Simulated campaign and its truth: stars, catalogue, pointings, frames, and their transformations.

The stars and the catalogue are like those of ACS ISR 2015-06, Section 2: 53917 stars west of
47 Tucanae, on a tangent plane in ACS/WFC pixels at epoch 2004.5. (5000, 5000) is the centre of the
field, 6.7' west of the cluster; u increases to the west and v to the north.

As in Section 3 of the report there are 110 exposures over twelve years at all roll angles, dithered
over the catalogue.  The roll angle follows the Sun, as required for HST, so that velocity
aberration depends on PA_V3 as in Figures 14 and 16.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import astropy.units as apu
import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from bayesdist.calibration.chip_map import ChipMap
from bayesdist.data import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import Exposure, ExposureLog
from bayesdist.data.sky import velocity_aberration
from bayesdist.missions.hst.simulate.distortion import SM4
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Bool, Float, Int

LINEAR_TERMS = ("A_1", "A_2", "A_3", "B_1", "B_2", "B_3")
MARGIN = 0.15  # margin around a chip in which the inverse is computed, in units of its half size

# direction of the catalogue's pixel (5000, 5000), degrees: 00h 22m 35.0s, -72d 04' 00"
RA, DEC = 5.645833333333333, -72.06666666666666
PIXEL = 0.05 / 3600.0  # degrees

SPANS = ((2002.3, 2007.1), (SM4 + 0.02, 2014.6))  # decimal years in which ACS operated
DITHER = 1500.0  # largest dither along each axis, pixels: the detector stays inside the catalogue
MIDDLE = (0.0, 1040.0)  # centre of the two chips relative to the reference pixel of WFC2, pixels
OFF_NOMINAL = 20.0  # largest deviation of the roll angle from the nominal one, degrees
POINTING = 10.0  # pixels (0.5"): pointing error due to the guide stars, not in the log
ROLL = np.radians(0.003)  # error of the roll angle, radians
ORBIT = 7.5  # orbital velocity of HST, km/s
INCLINATION = np.radians(28.5)  # of the orbit
# angle from V2 to the U axis of the gauge (along X of WFC2), degrees
TO_V2 = -2.234
MUCH = 10.0  # factor on the deviations of outlying exposures
OWN = 0.25  # ratio of the deviations of WFC1 alone to those common to both chips
ZERO_POINT = {"F435W": 0.9, "F475W": 0.3, "F606W": 0.0, "F814W": 0.5}  # mag

HALF_SIZE = 4500.0  # pixels from the centre to each side
CENTRE = (5000.0, 5000.0)
CLUSTER = (CENTRE[0] - 6.7 * 60 / 0.05, CENTRE[1])  # centre of the cluster, to the east
SLOPE = -1.5  # of the surface density of detected stars, shallower than that of the light
CLOSEST = 4.0  # pixels: closer pairs are removed, since neither star is well measured
BRIGHT, FAINT = -15.0, -7.0  # range of instrumental magnitudes
COUNTS = 0.15  # star counts increase as 10^(0.15 m)
CATALOG_EPOCH = 2004.5
DISPERSION = 0.01  # px/yr per axis, Section 2.2
EARLY, LATE = 2004.7, 2011.9  # mean epochs of the observations before and after SM4
EPOCH_SPREAD = 0.3  # standard deviation of the stars' mean epochs, years
POOR = 0.08  # fraction of poorly measured stars: 4270 of 53917 are above the line in Figure 3


@dataclass(frozen=True, eq=False)
class DetectionTruth:
    """Truth of the detections of one exposure, in the order of its list.

    Parameters
    ----------
    star : ndarray of int64, shape (N,)
        Row of the star in the catalogue; -1 for a false detection.
    blended : ndarray of bool, shape (N,)
        True for stars that are displaced towards a close neighbour.
    """

    star: Int
    blended: Bool


@dataclass(frozen=True, eq=False)
class AcsTruth:
    """Truth of a simulated campaign.

    Parameters
    ----------
    model : DistortionModel
        Model in the gauge of the report, without frames.
    theta : mapping of str to ndarray, shape (D,)
        True parameters for each filter.
    tables : tuple of LookupTable
        Detector and filter tables; empty without fine-scale distortion.
    stars : TrueStars
        True stars in the order of the catalogue.
    log : ExposureLog
    frames : AcsFrames
        True frames of the exposures.
    detections : tuple of DetectionTruth
        Truth of the detections of each exposure.
    settings : mapping of str to object
        Arguments of the simulation.
    """

    model: DistortionModel
    theta: Mapping[str, Float]
    tables: tuple[LookupTable, ...]
    stars: TrueStars
    log: ExposureLog
    frames: AcsFrames
    detections: tuple[DetectionTruth, ...]
    settings: Mapping[str, object]

    def to_catalog(self, exposure: str, x: ArrayLike, y: ArrayLike, chip: ArrayLike) -> Float:
        """Transform pixels of an exposure to catalogue positions.

        Parameters
        ----------
        exposure : str
            Name of the exposure.
        x, y : array_like, shape (N,)
            Raw FITS 1-based pixels.
        chip : int or array_like, shape (N,)
            Chip numbers.

        Returns
        -------
        ndarray, shape (N, 2)
            Positions (u, v) at the epoch of the exposure, pixels of the catalogue.
        """
        e = self.frames.names.index(exposure)
        x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
        chips = np.broadcast_to(np.asarray(chip), x.shape)
        out = np.empty((x.size, 2))
        for number in np.unique(chips):
            rows = chips == number
            out[rows] = self._map(e, int(number)).at(x[rows], y[rows]).T
        return out

    def to_pixels(
        self, exposure: str, u: ArrayLike, v: ArrayLike, chip: int
    ) -> tuple[Float, Float]:
        """Transform catalogue positions to raw pixels of a chip: the inverse of `to_catalog`.

        Parameters
        ----------
        exposure : str
            Name of the exposure.
        u, v : array_like, shape (N,)
            Positions, pixels of the catalogue.
        chip : int
            Chip number.

        Returns
        -------
        x, y : ndarray, shape (N,)
            FITS 1-based pixels, accurate to 1e-9; NaN if the position is far outside of the chip.
        """
        chip_map = self._map(self.frames.names.index(exposure), chip)
        sky = np.stack([np.atleast_1d(np.asarray(w, float)) for w in (u, v)])
        centre = (np.array(chip_map.basis.size)[:, None] + 1.0) / 2.0
        off = np.linalg.solve(chip_map.linear, sky - chip_map.at(*centre))
        reach = (1.0 + MARGIN) * np.array(chip_map.basis.half_size)[:, None]
        near = (np.abs(off) < reach).all(axis=0)
        x, y = np.full(sky.shape, np.nan)
        (x[near], y[near]), _ = chip_map.pixels(sky[:, near])
        return x, y

    def linear_terms(self, exposure: str, chip: int) -> Float:
        """True linear terms of an exposure, including its deviations.

        Parameters
        ----------
        exposure : str
            Name of the exposure.
        chip : int
            Chip number.

        Returns
        -------
        ndarray, shape (6,)
            A_1, A_2, A_3, B_1, B_2, B_3 without velocity aberration, in the gauge of the report for
            this exposure: A_1 = B_1 = A_3 = 0 on WFC2.
        """
        e = self.frames.names.index(exposure)
        terms = self._linear(e, chip)
        skew = self._linear(e, 2)[:, 2]
        length = np.hypot(*skew)
        turn = np.array([[skew[1], -skew[0]], [skew[0], skew[1]]]) / length
        out: Float = (turn @ terms).ravel()
        return out

    def _linear(self, e: int, chip: int) -> Float:
        basis = self.model.basis(chip)
        return np.asarray(basis.to_monomials(self._in_gauge(e, chip)))[:, :3]

    def _in_gauge(self, e: int, chip: int) -> Float:
        """Legendre coefficients (2, K) of w, including the deviations of the exposure."""
        exposure = self.log.exposures[e]
        codes = np.array([self.model.chip_code(chip)])
        theta = self.theta[exposure.filter]
        P = self.model.polynomials(theta, codes, np.array([exposure.epoch]))[0]
        if chip == 1:
            monomial = np.zeros((2, self.model.n_terms))
            monomial[:, 1:3] = self.frames.own[e]  # the terms x and y follow the constant
            P = P + self.model.basis(chip).from_monomials(monomial)
        return (np.eye(2) + self.frames.shared[e]) @ P

    def _map(self, e: int, chip: int) -> ChipMap:
        """Map of a chip in an exposure to catalogue positions (u, v)."""
        c, s = np.cos(self.frames.angle[e]), np.sin(self.frames.angle[e])
        P = self.frames.vafactor[e] * np.array([[c, -s], [s, c]]) @ self._in_gauge(e, chip)
        P[:, 0] += self.frames.centre[e]
        filters = ("", self.log.exposures[e].filter)  # detector table first
        tables = [t for name in filters for t in self.tables if (t.chip, t.filter) == (chip, name)]
        name = self.frames.names[e]
        return ChipMap(name, self.model.basis(chip), "pix", P, chip=chip, before=tuple(tables))


@dataclass(frozen=True, eq=False)
class AcsCampaign:
    """Simulated campaign.

    Parameters
    ----------
    catalog : ReferenceCatalog
        Standard catalogue at epoch 2004.5, with proper motions.
    early, late : ReferenceCatalog
        Mean positions of the same stars, in the same order, before and after SM4.
    log : ExposureLog
    lists : tuple of Detections
        Raw detections of each exposure, in the order of the log.
    truth : AcsTruth
    """

    catalog: ReferenceCatalog
    early: ReferenceCatalog
    late: ReferenceCatalog
    log: ExposureLog
    lists: tuple[Detections, ...]
    truth: AcsTruth


@dataclass(frozen=True, eq=False)
class AcsFrames:
    """Transformations from each of E exposures to the catalogue.

        (u, v) = centre + vafactor R(angle) (I + shared) w,   w = P(x', y') + own (x', y')

    where P is the polynomial of the chip in the gauge of the report, and `own` applies only to
    WFC1.
    """

    names: tuple[str, ...]
    centre: Float  # (E, 2), reference pixel of WFC2 in the catalogue, pixels
    angle: Float  # (E,), radians
    vafactor: Float  # (E,), scale by velocity aberration
    shared: Float  # (E, 2, 2), deviation of the linear terms of both chips (breathing)
    own: Float  # (E, 2, 2), additional deviation of WFC1
    outlying: Bool  # (E,), True for deviations that are ten times larger
    zero_point: Float  # (E,), measured minus catalogue magnitude

    def __len__(self) -> int:
        return len(self.names)


def exposures_of(
    filter: str, n: int, rng: np.random.Generator, *, pa_v3: float | None = None
) -> tuple[Exposure, ...]:
    """Exposures in a filter by ascending epoch, uniformly over the years in which ACS worked.

    `pa_v3` is a common roll angle in degrees; by default the roll angles follow the Sun.
    """
    lengths = np.array([end - start for start, end in SPANS])
    # one exposure in each of n equal intervals of the observing time
    when = (np.arange(n) + rng.uniform(size=n)) / n * lengths.sum()
    late = when >= lengths[0]
    epochs = np.where(late, SPANS[1][0] + when - lengths[0], SPANS[0][0] + when)
    sun = _direction_to_sun(epochs)
    rolls = (sun + rng.uniform(-OFF_NOMINAL, OFF_NOMINAL, n)) % 360.0
    velocities = _orbital_velocities(n, rng)
    times = np.round(rng.uniform(300.0, 450.0, n))
    dithers = rng.uniform(-DITHER, DITHER, (n, 2))
    out = []
    for k in range(n):
        # u increases to the west
        ra = RA - dithers[k, 0] * PIXEL / np.cos(np.radians(DEC))
        dec = DEC + dithers[k, 1] * PIXEL
        epoch = float(epochs[k])
        out.append(
            Exposure(
                name=f"{filter.lower()}-{k + 1:03d}",
                epoch=epoch,
                filter=filter,
                exptime=float(times[k]),
                vafactor=velocity_aberration(epoch, ra, dec, velocity_km_s=velocities[k]),
                pa_v3=float(rolls[k]) if pa_v3 is None else float(pa_v3) % 360.0,
                ra=float(ra),
                dec=float(dec),
            )
        )
    return tuple(out)


def catalog_rotation(pa_v3: float) -> float:
    """Rotation from the gauge of the report to the catalogue, radians.

    V2 is 90 degrees east of V3, and u of the catalogue increases to the west.  The axes U and V of
    the gauge are close to V2 and -V3.  The transformation is therefore a rotation by 180 degrees
    plus PA_V3, without reflection.
    """
    return float(np.radians((180.0 + pa_v3 + TO_V2) % 360.0))


def frames_of(
    log: ExposureLog, rngs: Sequence[np.random.Generator], *, scatter: float, outlying: float
) -> AcsFrames:
    """True frames of the exposures of a log, with errors of pointing and roll angle.

    Parameters
    ----------
    log : ExposureLog
        Log with vafactor, pa_v3, ra and dec.
    rngs : sequence of numpy.random.Generator
        One random generator per exposure.
    scatter : float
        Exposure-to-exposure standard deviation of A_2, B_2 and B_3.
    outlying : float
        Probability of an outlying exposure.

    Returns
    -------
    AcsFrames
    """
    log.require("vafactor", "pa_v3", "ra", "dec")
    n = len(log)
    pa_v3, ra, dec = (log.values(key) for key in ("pa_v3", "ra", "dec"))
    centre, angle, zero = np.empty((n, 2)), np.empty(n), np.empty(n)
    shared, own_deviation = np.empty((n, 2, 2)), np.empty((n, 2, 2))
    outlier = np.zeros(n, bool)
    for e, (exposure, rng) in enumerate(zip(log, rngs, strict=True)):
        outlier[e] = rng.uniform() < outlying
        size = scatter * (MUCH if outlier[e] else 1.0)
        # scale and the two shears; the rotation is absorbed by the frame.  In the gauge of the
        # report A_2 and B_3 deviate by scale +- shear, and B_2 by twice the cross shear.
        scale, plus, cross = size * rng.standard_normal(3) * [0.5**0.5, 0.5**0.5, 0.5]
        shared[e] = [[scale + plus, cross], [cross, scale - plus]]
        own_deviation[e] = OWN * size * rng.standard_normal((2, 2))
        zero[e] = ZERO_POINT[exposure.filter] + 0.03 * rng.standard_normal()
        angle[e] = catalog_rotation(pa_v3[e]) + ROLL * rng.standard_normal()
        c, s = np.cos(angle[e]), np.sin(angle[e])
        west = -(ra[e] - RA) * np.cos(np.radians(DEC)) / PIXEL
        north = (dec[e] - DEC) / PIXEL
        middle = np.array([[c, -s], [s, c]]) @ MIDDLE
        centre[e] = (
            np.array(CENTRE) + np.array([west, north]) - middle + POINTING * rng.standard_normal(2)
        )
    return AcsFrames(
        names=log.names,
        centre=centre,
        angle=angle,
        vafactor=log.values("vafactor"),
        shared=shared,
        own=own_deviation,
        outlying=outlier,
        zero_point=zero,
    )


def _direction_to_sun(epochs: Float) -> Float:
    """Position angle of the Sun as seen from the target, degrees from north to east."""
    time = Time(epochs, format="decimalyear", scale="tt")
    to_sun = get_body_barycentric("sun", time) - get_body_barycentric("earth", time)
    s = to_sun.xyz.to_value(apu.au)
    a, d = np.radians([RA, DEC])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    out: Float = np.degrees(np.arctan2(east @ s, north @ s)) % 360.0
    return out


def _orbital_velocities(n: int, rng: np.random.Generator) -> Float:
    """Velocities (n, 3) of HST around the Earth in km/s, for random nodes and orbital phases."""
    node, phase = rng.uniform(0.0, 2.0 * np.pi, (2, n))
    along = np.array([np.cos(phase), np.sin(phase) * np.cos(INCLINATION)])
    return ORBIT * np.column_stack(
        [
            along[0] * np.cos(node) - along[1] * np.sin(node),
            along[0] * np.sin(node) + along[1] * np.cos(node),
            np.sin(phase) * np.sin(INCLINATION),
        ]
    )


@dataclass(frozen=True, eq=False)
class TrueStars:
    """True positions, motions and magnitudes of the stars (N,)."""

    u: Float  # at 2004.5, pixels of the catalogue
    v: Float
    pm_u: Float  # pixels per year
    pm_v: Float
    mag: Float  # instrumental, -2.5 log10(flux / exposure time)

    def __len__(self) -> int:
        return len(self.u)

    def at(self, epoch: float | Float) -> tuple[Float, Float]:
        """Positions at an epoch in decimal years, one for all or one for each star."""
        dt = epoch - CATALOG_EPOCH
        return self.u + self.pm_u * dt, self.v + self.pm_v * dt


def centroid_error(mag: Float) -> Float:
    """Centroid error per axis in pixels at instrumental magnitudes.

    It is 0.01 px at -14 and 0.02 px at -10 (Section 2.2 and Figure 3).  Towards fainter magnitudes
    it follows the photon noise and then the sky noise.  For stars brighter than the saturation at
    -14 it increases with the excess.
    """
    flux = 10 ** (-0.4 * (np.asarray(mag, float) + 10.0))
    noise = 0.015**2 / flux * (1.0 + 0.3 / flux)
    saturated = 0.1 * np.maximum(-14.0 - mag, 0.0)
    out: Float = np.sqrt(0.01**2 + noise + saturated**2)
    return out


def true_stars(n: int, rng: np.random.Generator) -> TrueStars:
    """True stars of the field, with a density that increases towards the cluster in the east."""
    u, v = np.zeros(0), np.zeros(0)
    nearest = (
        CENTRE[0] - HALF_SIZE - CLUSTER[0]
    )  # distance from the edge of the field to the cluster
    while len(u) < n:
        offsets = rng.uniform(-HALF_SIZE, HALF_SIZE, (2, 4 * n))
        new_u, new_v = CENTRE[0] + offsets[0], CENTRE[1] + offsets[1]
        density = (np.hypot(new_u - CLUSTER[0], new_v - CLUSTER[1]) / nearest) ** SLOPE
        accepted = rng.uniform(size=4 * n) < density
        u, v = np.append(u, new_u[accepted]), np.append(v, new_v[accepted])
        pairs = cKDTree(np.column_stack([u, v])).query_pairs(CLOSEST, output_type="ndarray")
        single = np.ones(len(u), bool)
        single[pairs.ravel()] = False
        u, v = u[single], v[single]
    p = rng.uniform(size=n)
    low, high = 10 ** (COUNTS * BRIGHT), 10 ** (COUNTS * FAINT)
    mag = np.log10(low + p * (high - low)) / COUNTS
    pm_u, pm_v = DISPERSION * rng.standard_normal((2, n))
    return TrueStars(u[:n].copy(), v[:n].copy(), pm_u, pm_v, mag)


def measured_catalogs(
    stars: TrueStars, rng: np.random.Generator
) -> tuple[ReferenceCatalog, ReferenceCatalog, ReferenceCatalog]:
    """Standard catalogue (2004.5, with proper motions), and mean positions before and after SM4.

    All errors are normal with the quoted sizes, and independent between stars, axes, positions and
    motions, and catalogues.  Proper motions are as accurate as the difference of two mean
    positions, and poor for one star in twelve.  The catalogues of mean positions have no proper
    motions; each star is at the mean epoch of its observations.
    """
    n = len(stars)
    mag = stars.mag + 0.01 * rng.standard_normal(n)
    single = centroid_error(stars.mag)
    # poorly measured stars were observed in few exposures
    worse = np.where(rng.uniform(size=n) < POOR, rng.uniform(4.0, 12.0, n), 1.0)
    often = np.exp(0.15 * rng.standard_normal(n))  # variation in the number of exposures
    sigma = 0.5 * single * often
    sigma_mean = 0.35 * single * often * worse

    def mean_positions(epoch: float, name: str) -> ReferenceCatalog:
        dates = epoch + EPOCH_SPREAD * rng.standard_normal(n)
        u, v = stars.at(dates)
        return ReferenceCatalog(
            u=u + sigma_mean * rng.standard_normal(n),
            v=v + sigma_mean * rng.standard_normal(n),
            sigma_u=sigma_mean,
            sigma_v=sigma_mean,
            mag=mag,
            epoch=dates,
            source=name,
        )

    sigma_pm = np.sqrt(2.0) * sigma_mean / (LATE - EARLY)
    catalog = ReferenceCatalog(
        u=stars.u + sigma * rng.standard_normal(n),
        v=stars.v + sigma * rng.standard_normal(n),
        sigma_u=sigma,
        sigma_v=sigma,
        mag=mag,
        pm_u=stars.pm_u + sigma_pm * rng.standard_normal(n),
        pm_v=stars.pm_v + sigma_pm * rng.standard_normal(n),
        sigma_pm_u=sigma_pm,
        sigma_pm_v=sigma_pm,
        epoch=CATALOG_EPOCH,
        source="catalog",
    )
    return (
        catalog,
        mean_positions(EARLY, "catalog_early"),
        mean_positions(LATE, "catalog_late"),
    )
