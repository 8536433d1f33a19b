"""Simulated pointings: the log of the exposures and their true frames.

As in ACS ISR 2015-06, Section 3, there are 110 exposures over twelve years at all roll angles,
dithered over the catalogue.  The roll angle follows the Sun, as required for HST, so that velocity
aberration depends on PA_V3 as in Figures 14 and 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import astropy.units as apu
import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time

from bayesdist.data.exposures import Exposure, ExposureLog
from bayesdist.data.sky import velocity_aberration
from bayesdist.missions.hst.simulate.distortion import SM4
from bayesdist.missions.hst.simulate.stars import CENTRE
from bayesdist.utils.arrays import Bool, Float

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
