"""Sky positions of reference stars at the epoch of the exposures, and the Earth's motion.

**Epochs.** Reference positions of a catalogue are moved to the epoch of the exposures: space motion
by astropy, and the parallax as seen from the Earth. Their errors include those of motion and
parallax.

**Aberration.** Stars are displaced towards the apex of the Earth's motion. A true offset on the sky
is a factor times the offset computed with an aberration-free pixel scale (Cox & Gilliland 2002, HST
Calibration Workshop):

    factor = sqrt(1 - b^2) / (1 - n . b),    b = velocity / c

with the direction n of the target. Aberration is conformal, so the factor is the same in all
directions.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.covariances import LARGEST_RHO
from bayesdist.data.tables.checks import zero_motions
from bayesdist.data.tangent import mean_direction
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import LARGEST_RA

if TYPE_CHECKING:
    from astropy.time import Time

    from bayesdist.data.tables.column import Quantities, SourceColumn

MOTIONS = ("pm_ra", "pm_dec", "sigma_pm_ra", "sigma_pm_dec")
# pairs of the five astrometric parameters, in the order of the rows of their covariance
PARAMETERS = ("ra", "dec", "parallax", "pm_ra", "pm_dec")
CORRELATIONS = frozenset(f"corr_{first}_{second}" for first, second in combinations(PARAMETERS, 2))
# quantities that may be missing for a star, which then count as zero
SPARED = ("parallax", "sigma_parallax", *sorted(CORRELATIONS))
SKY_QUANTITIES = ("sigma_ra", "sigma_dec", *MOTIONS, *SPARED, "catalogue_epoch")
# parsecs; without a radial velocity, the path on the sky does not depend on the distance
_NO_MATTER = 100
STARS_AT_ONCE = 65_536  # whose correlations are examined
ROUNDED = 1e-5  # of correlations with few digits: the smallest eigenvalue may be below zero
_STANDS = 1e-3  # years; over a shorter time motions are negligible
_LIGHT = 299_792.458  # km/s


@dataclass(frozen=True, eq=False)
class ReferenceSky:
    """Reference positions at the epoch at which they are compared with the detections."""

    ra: Float  # (N,), degrees
    dec: Float  # (N,), degrees
    sigma: Float | None  # (2, N), along east and north, arcsec
    rho: Float | None  # (N,) correlation of both errors; None if no correlations are known
    motion: Float | None  # (2, N), to east (with cos(dec)) and north, arcsec/yr
    sigma_motion: Float | None  # (2, N), errors of the motions
    notes: tuple[str, ...]  # clauses on how the positions were treated


def sky_columns(quantities: Quantities) -> tuple[Float, Float]:
    """Right ascension and declination (N,) of the rows of a table, converted to degrees.

    Raises InputError if a declination is beyond 90 degrees, or a right ascension beyond
    `LARGEST_RA`.
    """
    ra, dec = (_degrees(quantities[key], key) for key in ("ra", "dec"))
    outside = np.abs(ra) > LARGEST_RA
    if outside.any():
        bad = int(np.argmax(outside))
        raise quantities["ra"].fail(bad, f"right ascension is {ra[bad]:g} degrees")
    beyond = np.abs(dec) > 90.0
    if beyond.any():
        bad = int(np.argmax(beyond))
        raise quantities["dec"].fail(bad, f"declination is {dec[bad]:g} degrees")
    return ra, dec


def _degrees(column: SourceColumn, key: str) -> Float:
    values = np.asarray(column.values) if hasattr(column.values, "dtype") else np.zeros(0)
    if values.dtype.kind in "SU" and any(mark in str(values.flat[0]) for mark in ": hd"):
        return _sexagesimal(column, values.astype(str), key)
    return column.numbers() * column.factor("deg")


def _sexagesimal(column: SourceColumn, texts: NDArray[np.str_], key: str) -> Float:
    """Degrees from strings such as 10:00:24.1 (hours, for ra) and +02:12:00 (degrees)."""
    import astropy.units as apu
    from astropy.coordinates import Angle

    unit = apu.hourangle if key == "ra" else apu.deg
    try:
        return np.asarray(Angle(texts, unit=unit).deg, float)
    except (ValueError, TypeError, apu.UnitsError):
        for index, text in enumerate(texts):
            try:
                Angle(text, unit=unit)
            except (ValueError, TypeError, apu.UnitsError):
                raise column.fail(index, f"{text[:40]!r} is not an angle") from None
        raise


def reference_sky(
    quantities: Quantities,
    *,
    epoch: Float | None = None,
    catalogue_epoch: float | None = None,
) -> ReferenceSky:
    """Reference positions at `epoch`, with errors and motions if the table has them.

    `epoch` (N,) is the epoch of the exposures, and `catalogue_epoch` that of the reference
    positions, used if the table has no such column; both are decimal years. Besides ra and dec,
    these columns are used if they exist: sigma_ra, sigma_dec, pm_ra, pm_dec and their errors,
    parallax and its error, and the correlations of all these (`CORRELATIONS`).
    Raises InputError for half a pair, and for missing or invalid units.
    """
    ra, dec = sky_columns(quantities)
    if "catalogue_epoch" in quantities:
        start: Float | None = quantities["catalogue_epoch"].years()
    else:
        start = None if catalogue_epoch is None else np.full(len(ra), float(catalogue_epoch))
    moves = epoch is not None and start is not None
    motion = _pair(quantities, ("pm_ra", "pm_dec"), "arcsec / yr", missing=not moves)
    if motion is None:
        return ReferenceSky(ra, dec, *_errors_at(quantities), None, None, ())
    sigma_motion = _pair(
        quantities, ("sigma_pm_ra", "sigma_pm_dec"), "arcsec / yr", missing=not moves
    )
    if epoch is None or start is None:
        lacks = "the epoch of the exposures" if epoch is None else "the epoch of the catalogue"
        key = "data.epoch" if epoch is None else "data.catalogue_epoch"
        note = f"proper motions are not used: {lacks} is not given ({key})"
        return ReferenceSky(ra, dec, *_errors_at(quantities), motion, sigma_motion, (note,))
    zero = zero_motions(quantities["pm_ra"].values, quantities["pm_dec"].values)
    if zero.any():  # tables on disk: rows are not left out in reading
        raise quantities["pm_ra"].fail(
            int(np.argmax(zero)),
            f"proper motion is exactly 0 on both axes in {np.count_nonzero(zero)} rows, as where "
            "missing values were filled",
            do="write the table without these rows, or read it with read_matches",
        )
    dt = epoch - start
    new_ra, new_dec = _moved(ra, dec, motion, start, epoch)
    factors, parallax = np.zeros((2, len(ra))), _optional(quantities, "parallax", "arcsec")
    if parallax is not None:
        factors = _factors(epoch, mean_direction(ra, dec))
        new_ra = new_ra + parallax * factors[0] / 3600 / np.cos(np.radians(new_dec))
        new_dec = new_dec + parallax * factors[1] / 3600
    sigma, rho = _errors_at(quantities, dt, factors)
    step = np.hypot(*motion) * np.abs(dt)
    first, last = float(epoch.min()), float(epoch.max())
    to = f"{first:.2f}" + (f" to {last:.2f}" if last - first > 0.005 else "")
    if not np.any(step) and parallax is None:
        note = "positions are of the exposures' epoch"
        return ReferenceSky(ra, dec, sigma, rho, motion, sigma_motion, (note,))
    note = (
        f"positions of {np.median(start):.2f} were moved to {to} by proper motions"
        f"{'' if parallax is None else ' and parallaxes'} (median {np.median(step):.2g}, "
        f"at most {step.max():.2g} arcsec)"
    )
    return ReferenceSky(new_ra, new_dec, sigma, rho, motion, sigma_motion, (note,))


def _pair(
    quantities: Quantities, keys: tuple[str, str], unit: str, *, missing: bool = False
) -> Float | None:
    """Columns of a pair (2, N) in a unit; None if neither exists."""
    have = [key for key in keys if key in quantities]
    if len(have) == 1:
        partner = keys[1 - keys.index(have[0])]
        raise InputError(
            f"column {partner!r} is missing beside {quantities[have[0]].name!r}",
            where=quantities.source,
            do="name it in the option 'columns', or leave the other out by an empty name",
        )
    if not have:
        return None
    return np.stack([_in_unit(quantities[key], key, unit, missing=missing) for key in keys])


def _optional(quantities: Quantities, key: str, unit: str) -> Float | None:
    """Column in a unit, with 0 for missing values; None if it does not exist."""
    if key not in quantities:
        return None
    return _in_unit(quantities[key], key, unit, missing=True)


def _in_unit(column: SourceColumn, key: str, unit: str, *, missing: bool) -> Float:
    if column.unit is None and unit:
        # catalogues use degrees for positions and mas for other columns, so no default is safe
        raise InputError(
            "has no unit, and its name is not that of a known catalogue",
            where=column.where,
            do="write it into the file (mas, or mas / yr), or leave the column out: "
            f'columns = {{{key} = ""}}',
        )
    factor = column.factor(unit) if unit else 1.0
    return factor * (column.numbers_or(0.0) if missing else column.numbers())


def _moved(ra: Float, dec: Float, motion: Float, start: Float, end: Float) -> tuple[Float, Float]:
    """Positions at the end of a space motion without radial velocity."""
    if np.max(np.abs(end - start), initial=0.0) < _STANDS:
        return ra, dec
    import astropy.units as apu
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

    before, after = (Time(years, format="jyear", scale="tdb") for years in (start, end))
    sky = SkyCoord(
        ra=ra * apu.deg,
        dec=dec * apu.deg,
        distance=np.full(ra.shape, _NO_MATTER) * apu.pc,
        pm_ra_cosdec=motion[0] * apu.arcsec / apu.yr,
        pm_dec=motion[1] * apu.arcsec / apu.yr,
        radial_velocity=np.zeros(len(ra)) * apu.km / apu.s,
        obstime=before,
    ).apply_space_motion(new_obstime=after)
    return np.asarray(sky.ra.deg), np.asarray(sky.dec.deg)


def _factors(epoch: Float, direction: tuple[float, float]) -> Float:
    """Parallax factors (2, N), computed for the middle of the field."""
    dates, of = np.unique(epoch, return_inverse=True)
    return np.asarray(parallax_factors(dates, *direction)[of].T, float)


def _errors_at(
    quantities: Quantities, dt: Float | float = 0.0, factors: Float | None = None
) -> tuple[Float | None, Float | None]:
    """Errors (2, N) of positions after dt years, and their correlation (N,); None if unknown.

    `factors` (2, N) are the parallax factors; without them nothing moves, and the errors are those
    of the catalogue.  Missing errors of parallaxes and motions, and missing correlations, count as
    zero.  InputError for correlations that no covariance has.
    """
    positions = _pair(quantities, ("sigma_ra", "sigma_dec"), "arcsec")
    if positions is None:
        return None, None
    n = len(quantities)
    names = ("ra", "dec") if factors is None else PARAMETERS
    sigma, rho = dict(zip(("ra", "dec"), positions, strict=True)), {}
    for name in names[2:]:
        unit = "arcsec / yr" if name.startswith("pm_") else "arcsec"
        values = _optional(quantities, f"sigma_{name}", unit)
        if values is not None:
            if (values < 0).any():
                bad = int(np.argmax(values < 0))
                raise quantities[f"sigma_{name}"].fail(bad, f"an error is {values[bad]:g}")
            sigma[name] = values
    for first, second in combinations(names, 2):
        values = _optional(quantities, f"corr_{first}_{second}", "")
        if values is not None and first in sigma and second in sigma:
            rho[first, second] = _checked(quantities[f"corr_{first}_{second}"], values)
    shrinkage = _shrinkage(quantities, rho, n)
    # changes of the position to the east and north by a unit of each parameter
    along: dict[str, tuple[Float | float, Float | float]] = {"ra": (1.0, 0.0), "dec": (0.0, 1.0)}
    if factors is not None:
        along |= {"parallax": (factors[0], factors[1]), "pm_ra": (dt, 0.0), "pm_dec": (0.0, dt)}
    C = np.zeros((3, n))  # uu, uv, vv
    for name, error in sigma.items():
        a, b = along[name]
        for k, weight in enumerate((a * a, a * b, b * b)):
            C[k] += weight * error**2
    for (first, second), values in rho.items():
        (a, b), (c, d) = along[first], along[second]
        product = shrinkage * values * sigma[first] * sigma[second]
        for k, weight in enumerate((2 * a * c, a * d + b * c, 2 * b * d)):
            C[k] += weight * product
    out = np.sqrt(np.maximum(C[[0, 2]], np.finfo(float).tiny))
    if not states_correlations(quantities.found):
        return out, None
    return out, np.clip(C[1] / (out[0] * out[1]), -LARGEST_RHO, LARGEST_RHO)


def correlation_matrices(quantities: Quantities, names: Iterable[str]) -> Float | None:
    """Correlation matrices (N, 5, 5) of the errors of `PARAMETERS`; None if there are no columns.

    `names` are the parameters that have errors.  Missing correlations count as zero.  InputError
    for correlations that no covariance has.
    """
    parameters = frozenset(names)
    given = {
        pair: _checked(column, column.numbers_or(0.0))
        for pair in combinations(PARAMETERS, 2)
        if (key := "corr_{}_{}".format(*pair)) in quantities and parameters.issuperset(pair)
        for column in [quantities[key]]
    }
    if not given:
        return None
    n = len(quantities)
    shrinkage = _shrinkage(quantities, given, n)
    out = np.tile(np.eye(len(PARAMETERS)), (n, 1, 1))
    for pair, values in given.items():
        i, j = (PARAMETERS.index(name) for name in pair)
        out[:, i, j] = out[:, j, i] = shrinkage * values
    return out


def states_correlations(found: Container[str]) -> bool:
    """True if errors of positions by these columns are correlated between both axes."""
    return any(key in found for key in (*CORRELATIONS, "sigma_parallax"))


def _checked(column: SourceColumn, rho: Float) -> Float:
    """Correlations; InputError for one that is larger than 1."""
    beyond = np.abs(rho) > 1.0
    if beyond.any():
        bad = int(np.argmax(beyond))
        raise column.fail(bad, f"a correlation is {rho[bad]:g}, but must be at most 1")
    return rho


def _shrinkage(
    quantities: Quantities, rho: Mapping[tuple[str, str], Float], n: int
) -> Float | float:
    """Factor (n,) on all correlations of a star that makes them possible; mostly 1.

    Correlations of a part of the pairs may be impossible if the others are zero, as they count.
    InputError if all are given and contradict each other.
    """
    names = sorted({name for pair in rho for name in pair}, key=PARAMETERS.index)
    if len(rho) < 2:
        return 1.0
    out = np.ones(n)
    for start in range(0, n, STARS_AT_ONCE):
        rows = slice(start, start + STARS_AT_ONCE)
        matrices = np.tile(np.eye(len(names)), (len(out[rows]), 1, 1))
        for (first, second), values in rho.items():
            i, j = names.index(first), names.index(second)
            matrices[:, i, j] = matrices[:, j, i] = values[rows]
        least = np.linalg.eigvalsh(matrices)[:, 0]
        if len(rho) == len(names) * (len(names) - 1) // 2 and (least < -ROUNDED).any():
            bad = start + int(np.argmin(least))
            key = "corr_{}_{}".format(*list(rho)[-1])
            raise quantities[key].fail(bad, "the correlations of this star contradict each other")
        out[rows] = 1.0 / np.maximum(1.0 - np.minimum(least, 0.0), 1.0)
    return out


def velocity_aberration(
    epoch: float | Time,
    ra: float,
    dec: float,
    *,
    velocity_km_s: ArrayLike = (0.0, 0.0, 0.0),
) -> float:
    """Scale factor of velocity aberration for a target at an epoch.

    The barycentric velocity of the Earth is taken from astropy's built-in ephemeris, without
    network access. Over a year the factor varies by up to 1e-4; the orbit of HST (7.5 km/s) adds
    2.5e-5.

    Parameters
    ----------
    epoch : float or astropy Time
        Decimal year, or a time.
    ra, dec : float
        Position of the target in degrees. Strictly, the formula requires the apparent direction;
        the true direction changes the factor by b^2, 1e-8.
    velocity_km_s : array_like, shape (3,), optional
        Velocity of the telescope relative to the Earth, along the axes of the ICRS.

    Returns
    -------
    float
        Factor of velocity aberration; larger than 1 if the telescope moves towards the target.

    Raises
    ------
    InputError
        If the epoch, direction or velocity is invalid.
    """
    import astropy.units as apu
    from astropy.coordinates import get_body_barycentric_posvel
    from astropy.time import Time

    relative = np.asarray(velocity_km_s, float)
    numbers = (0.0 if isinstance(epoch, Time) else float(epoch), float(ra), float(dec))
    if (
        relative.shape != (3,)
        or not np.isfinite([*relative, *numbers]).all()
        or abs(numbers[2]) > 90.0
    ):
        raise InputError(
            f"no aberration for epoch {epoch}, direction ({ra}, {dec}) and velocity {relative}",
            do="give a decimal year, ra and dec in degrees, and three components in km/s",
        )
    # TT needs no table of leap seconds, and an error of a minute changes the factor by only 1e-9
    time = epoch if isinstance(epoch, Time) else Time(epoch, format="decimalyear", scale="tt")
    _, earth = get_body_barycentric_posvel("earth", time, ephemeris="builtin")
    b = (earth.xyz.to_value(apu.km / apu.s) + relative) / _LIGHT
    speed2 = float(b @ b)
    if not speed2 < 1.0:
        raise InputError("the telescope is faster than light", do="give the velocity in km/s")
    a, d = np.radians([ra, dec])
    n = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    return float(np.sqrt(1.0 - speed2) / (1.0 - n @ b))


def parallax_factors(epoch: ArrayLike, ra: float, dec: float) -> Float:
    """Displacements (E, 2) to east and north per unit of parallax, at Julian years (E,).

    `ra` and `dec` are ICRS degrees. The observer is at the centre of the Earth; a satellite in low
    orbit is within 5e-5 au of it. See Green, Spherical Astronomy (1985), section 8. The position of
    the Earth is from astropy's built-in ephemeris (ERFA's epv00), which needs no file.
    """
    from astropy.coordinates import get_body_barycentric
    from astropy.time import Time

    time = Time(np.atleast_1d(np.asarray(epoch, float)), format="jyear", scale="tdb")
    earth = get_body_barycentric("earth", time, ephemeris="builtin").xyz.to_value("au")
    a, d = np.radians([ra, dec])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    return -np.stack([east @ earth, north @ earth], axis=1)
