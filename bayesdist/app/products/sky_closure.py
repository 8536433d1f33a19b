"""A SIP header on the sky, as astropy.wcs reads it, against the stars and against the solution."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.app.products.made_files import ProductInput
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data.sky.tangent import sky_of_plane
from bayesdist.diagnose.residuals.sample import StarSample
from bayesdist.products.formats.sip.positions import sky_of_header
from bayesdist.utils.limits import SKY_CLOSURE

log = logging.getLogger("bayesdist")

FALSE = 0.5  # probability above which a match is taken for a false one


def sky_closure(
    product: ProductInput, stars: StarSample, path: Path, chip: int
) -> tuple[dict[str, Any], list[str]] | None:
    """How far a header as written is from stars and solution, for summary.json, and its faults.

    None where the stars are not on the sky, or none is left: of several exposures with frames only
    the first one counts, whose header it is.
    """
    point, solution = product.calibration.plane.point, product.solution
    if point is None:
        return None
    from astropy import units as apu
    from astropy.coordinates import SkyCoord
    from astropy.io import fits

    table, model = stars.table, solution.model
    mine = stars.used & (np.array(table.chip_numbers)[table.chip] == chip)
    if model.n_frame:
        first = [name == model.exposures[0] for name in table.exposure_names]
        mine &= np.array(first)[table.exposure]
    if stars.outlier_probability is not None:
        mine &= stars.outlier_probability < FALSE
    if not mine.any():
        return None
    arcsec, (x, y) = ARCSEC[model.unit], (table.x[mine], table.y[mine])
    at = SkyCoord(*sky_of_header(fits.Header.fromtextfile(path), x, y), unit="deg")
    true = SkyCoord(
        *sky_of_plane(table.u[mine] * arcsec, table.v[mine] * arcsec, point), unit="deg"
    )
    when = {} if model.time is None else {"epoch": product.options.epoch}
    uv = model.predict(solution.mean, x, y, chip=chip, **when)
    u, v = uv.T * arcsec
    own = SkyCoord(*sky_of_plane(u, v, point), unit="deg")
    east, north = (float(a.to_value(apu.arcsec).mean()) for a in true.spherical_offsets_to(at))
    found = {
        "n": int(mine.sum()),  # without those that are probably false matches
        "rms_arcsec": float(np.sqrt(np.mean(true.separation(at).arcsec ** 2))),
        # of header minus star
        "mean_east_arcsec": east,
        "mean_north_arcsec": north,
        "solution_arcsec": float(own.separation(at).arcsec.max()),  # the largest
    }
    far = found["solution_arcsec"]
    off = far / (model.pixel_size(solution.mean) * arcsec)
    faithful = SKY_CLOSURE.met_by(off)
    log.log(
        logging.INFO if faithful else logging.WARNING,
        f"export: {path.name}: on the sky by astropy.wcs {found['rms_arcsec']:.4g} arcsec rms from "
        f"RA, Dec of {found['n']} stars, on average {east:+.2g} east and {north:+.2g} north; "
        f"{far:.2g} arcsec at most from the solution",
    )
    if faithful:
        return found, []
    return found, [
        f"error: sky: astropy.wcs puts pixels up to {far:.3g} arcsec ({off:.2g} px) from where the "
        "solution has them"
    ]
