"""Pointings in time and on the sky: the log of the exposures and their true frames.

ACS ISR 2015-06, Section 3: 110 exposures over twelve years, all roll angles, dithered over the
catalogue.  The roll follows the Sun, as that of HST must, so that velocity aberration goes with
PA_V3 as in Figures 14 and 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import astropy.units as apu
import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time

from bayesdist.data.exposures import Exposure, ExposureLog
from bayesdist.data.sky.earth import velocity_aberration
from bayesdist.missions.acs.simulate.distortion import SM4
from bayesdist.missions.acs.simulate.stars import CENTRE
from bayesdist.utils.arrays import Bool, Float

# Of the catalogue's pixel (5000, 5000): 00h 22m 35.0s, -72d 04' 00"
RA, DEC = 5.645833333333333, -72.06666666666666
PIXEL = 0.05 / 3600.0  # degrees

SPANS = ((2002.3, 2007.1), (SM4 + 0.02, 2014.6))  # ACS was off between them
DITHER = 1500.0  # pixels to each side: the frame stays inside the catalogue
MIDDLE = (0.0, 1040.0)  # of the two chips, from the reference pixel of WFC2
OFF_NOMINAL = 20.0  # degrees that the roll may differ from that towards the Sun
POINTING = 10.0  # pixels (0.5"): error of the guide stars, which the log does not include
ROLL = np.radians(0.003)

ORBIT = 7.5  # km/s
INCLINATION = np.radians(28.5)

# Angle from V2 to the U axis of the reference gauge (along X of WFC2)
TO_V2 = -2.234
MUCH = 10.0  # times the usual deviation: an outlying exposure
OWN = 0.25  # of the deviations common to the chips: those of WFC1 by itself
ZERO_POINT = {"F435W": 0.9, "F475W": 0.3, "F606W": 0.0, "F814W": 0.5}


@dataclass(frozen=True, eq=False)
class AcsFrames:
    """Maps from each of E exposures to the catalogue.

        (u, v) = centre + vafactor R(angle) (I + shared) w,   w = P(x', y') + own (x', y')

    with P the polynomial of the chip in the reference gauge, and `own` only on WFC1.
    """

    names: tuple[str, ...]
    centre: Float  # (E, 2), reference pixel of WFC2 in the catalogue, pixels
    angle: Float  # (E,), radians
    vafactor: Float  # (E,), scale by velocity aberration
    shared: Float  # (E, 2, 2), deviation of the linear terms (breathing), both chips
    own: Float  # (E, 2, 2), of WFC1 beyond that
    outlying: Bool  # (E,), deviations drawn ten times larger
    zero_point: Float  # (E,), measured less catalogue magnitude

    def __len__(self) -> int:
        return len(self.names)


def exposures_of(
    filter: str, n: int, rng: np.random.Generator, *, pa_v3: float | None = None
) -> tuple[Exposure, ...]:
    """Exposures in a filter by rising epoch, evenly spread over the years in which ACS worked.

    `pa_v3` is one roll angle for all, degrees, in place of those that follow the Sun.
    """
    lengths = np.array([end - start for start, end in SPANS])
    # one in each of n equal stretches of the observing time
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
        # u grows to the west
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
    """Rotation from the reference gauge to the catalogue, radians.

    V2 is 90 degrees east of V3; u of the catalogue grows to the west.  The axes U and V of the
    gauge are near V2 and -V3, so that a rotation by 180 degrees and PA_V3 is left, and no
    reflection.
    """
    return float(np.radians((180.0 + pa_v3 + TO_V2) % 360.0))


def frames_of(
    log: ExposureLog, rngs: Sequence[np.random.Generator], *, scatter: float, outlying: float
) -> AcsFrames:
    """True frames of the exposures of a log, off its pointing by some 10 pixels and 0.003 degrees.

    The log has vafactor, pa_v3, ra and dec; each exposure has random numbers of its own.  `scatter`
    is the standard deviation of A_2, B_2 and B_3 from exposure to exposure, `outlying` the
    probability of an outlying exposure.
    """
    log.require("vafactor", "pa_v3", "ra", "dec")
    n = len(log)
    pa_v3, ra, dec = (log.values(key) for key in ("pa_v3", "ra", "dec"))
    centre, angle, zero = np.empty((n, 2)), np.empty(n), np.empty(n)
    shared, own = np.empty((n, 2, 2)), np.empty((n, 2, 2))
    outlier = np.zeros(n, bool)
    for e, (one, rng) in enumerate(zip(log, rngs, strict=True)):
        outlier[e] = rng.uniform() < outlying
        size = scatter * (MUCH if outlier[e] else 1.0)
        # scale, and shears along the axes and across; the rotation is the frame's.  In the gauge
        # A_2 and B_3 deviate by scale +- shear, and B_2 by twice the cross shear.
        scale, plus, cross = size * rng.standard_normal(3) * [0.5**0.5, 0.5**0.5, 0.5]
        shared[e] = [[scale + plus, cross], [cross, scale - plus]]
        own[e] = OWN * size * rng.standard_normal((2, 2))
        zero[e] = ZERO_POINT[one.filter] + 0.03 * rng.standard_normal()
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
        own=own,
        outlying=outlier,
        zero_point=zero,
    )


def _direction_to_sun(epochs: Float) -> Float:
    """Position angle of the Sun seen from the target, degrees from north through east."""
    time = Time(epochs, format="decimalyear", scale="tt")
    to_sun = get_body_barycentric("sun", time) - get_body_barycentric("earth", time)
    s = to_sun.xyz.to_value(apu.au)
    a, d = np.radians([RA, DEC])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    out: Float = np.degrees(np.arctan2(east @ s, north @ s)) % 360.0
    return out


def _orbital_velocities(n: int, rng: np.random.Generator) -> Float:
    """Velocities around the Earth, (n, 3), at any phase of orbits with any node."""
    node, phase = rng.uniform(0.0, 2.0 * np.pi, (2, n))
    along = np.array([np.cos(phase), np.sin(phase) * np.cos(INCLINATION)])
    return ORBIT * np.column_stack(
        [
            along[0] * np.cos(node) - along[1] * np.sin(node),
            along[0] * np.sin(node) + along[1] * np.cos(node),
            np.sin(phase) * np.sin(INCLINATION),
        ]
    )
