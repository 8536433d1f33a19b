"""Reference positions on the sky, with the errors and motions of a catalogue.

Positions are moved to the epoch of the exposures: space motion by astropy, and the parallax as seen
from the Earth. Their errors include those of motion and parallax.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.sky.earth import parallax_factors
from bayesdist.data.sky.tangent import mean_direction
from bayesdist.data.tables.checks import zero_motions
from bayesdist.data.tables.column import Quantities, SourceColumn
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

MOTIONS = ("pm_ra", "pm_dec", "sigma_pm_ra", "sigma_pm_dec")
# quantities that may be missing for a star, which then count as zero
SPARED = ("parallax", "sigma_parallax", "corr_ra", "corr_dec")
SKY_QUANTITIES = ("sigma_ra", "sigma_dec", *MOTIONS, *SPARED, "catalogue_epoch")

# parsecs; without a radial velocity, the path on the sky does not depend on the distance
_NO_MATTER = 100
_STANDS = 1e-3  # years; over a shorter time motions are negligible


@dataclass(frozen=True, eq=False)
class ReferenceSky:
    """Reference positions at the epoch at which they are compared with the detections."""

    ra: Float  # (N,), degrees
    dec: Float  # (N,), degrees
    sigma: Float | None  # (2, N), along east and north, arcsec
    motion: Float | None  # (2, N), to east (with cos(dec)) and north, arcsec/yr
    sigma_motion: Float | None  # (2, N), errors of the motions
    notes: tuple[str, ...]  # clauses on how the positions were treated


def sky_columns(quantities: Quantities) -> tuple[Float, Float]:
    """Right ascension and declination (N,) of the rows of a table, converted to degrees."""
    ra, dec = (_degrees(quantities[key], key) for key in ("ra", "dec"))
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
                raise column.fail(index, f"{text[:40]!r} stands where an angle must be") from None
        raise


def reference_sky(
    quantities: Quantities,
    *,
    epoch: Float | None = None,
    catalogue_epoch: float | None = None,
) -> ReferenceSky:
    """Reference positions at `epoch`, with errors and motions if the table has them.

    `epoch` (N,) is that of the exposures, `catalogue_epoch` that of the positions if there is no
    such column. Besides ra and dec, these columns are used if they exist: sigma_ra, sigma_dec,
    pm_ra, pm_dec and their errors, corr_ra and corr_dec (correlation of position and motion on one
    axis), parallax and its error. InputError for half a pair, and for missing or invalid units.
    """
    ra, dec = sky_columns(quantities)
    sigma = _pair(quantities, ("sigma_ra", "sigma_dec"), "arcsec")
    if "catalogue_epoch" in quantities:
        start: Float | None = quantities["catalogue_epoch"].years()
    else:
        start = None if catalogue_epoch is None else np.full(len(ra), float(catalogue_epoch))
    moves = epoch is not None and start is not None
    motion = _pair(quantities, ("pm_ra", "pm_dec"), "arcsec / yr", missing=not moves)
    if motion is None:
        return ReferenceSky(ra, dec, sigma, None, None, ())
    sigma_motion = _pair(
        quantities, ("sigma_pm_ra", "sigma_pm_dec"), "arcsec / yr", missing=not moves
    )
    if epoch is None or start is None:
        lacks = "the epoch of the exposures" if epoch is None else "the epoch of the catalogue"
        key = "data.epoch" if epoch is None else "data.catalogue_epoch"
        note = f"proper motions are not used: {lacks} is not given ({key})"
        return ReferenceSky(ra, dec, sigma, motion, sigma_motion, (note,))
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
    if sigma is not None:
        sigma = _sigma_at(quantities, sigma, sigma_motion, dt, factors)
    step = np.hypot(*motion) * np.abs(dt)
    first, last = float(epoch.min()), float(epoch.max())
    to = f"{first:.2f}" + (f" to {last:.2f}" if last - first > 0.005 else "")
    if not np.any(step) and parallax is None:
        note = "positions are of the exposures' epoch"
        return ReferenceSky(ra, dec, sigma, motion, sigma_motion, (note,))
    note = (
        f"positions of {np.median(start):.2f} were moved to {to} by proper motions"
        f"{'' if parallax is None else ' and parallaxes'} (median {np.median(step):.2g}, "
        f"at most {step.max():.2g} arcsec)"
    )
    return ReferenceSky(new_ra, new_dec, sigma, motion, sigma_motion, (note,))


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
            "has no unit, and its name is that of no known catalogue",
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


def _sigma_at(
    quantities: Quantities, sigma: Float, sigma_pm: Float | None, dt: Float, factors: Float
) -> Float:
    """Errors (2, N) at the new epoch, including those of motion and parallax."""
    variance = sigma**2
    if sigma_pm is not None:
        for axis, key in enumerate(("corr_ra", "corr_dec")):
            rho = _optional(quantities, key, "")
            if rho is not None:
                variance[axis] += 2 * np.clip(rho, -1, 1) * sigma[axis] * sigma_pm[axis] * dt
        variance = variance + (sigma_pm * dt) ** 2
    sigma_parallax = _optional(quantities, "sigma_parallax", "arcsec")
    if sigma_parallax is not None:
        variance = variance + (factors * sigma_parallax) ** 2
    return np.sqrt(np.maximum(variance, np.finfo(float).tiny))
