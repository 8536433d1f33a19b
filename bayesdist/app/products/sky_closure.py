"""A SIP header on the sky, as astropy.wcs reads it, against the stars and against the solution."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.app.products.made_files import ProductInput
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data.sky.tangent import sky_of_plane
from bayesdist.diagnose.residuals.sample import StarSample
from bayesdist.limits import SKY_CLOSURE
from bayesdist.products.formats.sip.positions import sky_of_header

__all__ = ["sky_closure"]

FALSE = 0.5  # probability above which a match is taken for a false one


@dataclass(frozen=True)
class SkyClosure:
    """Distances on the sky of the positions that a header gives to the pixels of stars."""

    n: int  # stars, without those that are probably false matches
    rms: float  # from their RA and Dec, arcsec
    # east, north: mean of header minus star, arcsec
    east: float
    north: float
    solution: float  # largest distance from the positions of the solution, arcsec
    pixel: float  # side of a pixel, arcsec

    @property
    def summary(self) -> dict[str, Any]:
        """As it stands in summary.json."""
        return {
            "n": self.n,
            "rms_arcsec": self.rms,
            "mean_east_arcsec": self.east,
            "mean_north_arcsec": self.north,
            "solution_arcsec": self.solution,
        }

    @property
    def sentence(self) -> str:
        """Line for the log."""
        return (
            f"on the sky by astropy.wcs {self.rms:.4g} arcsec rms from RA, Dec of {self.n} stars, "
            f"on average {self.east:+.2g} east and {self.north:+.2g} north; "
            f"{self.solution:.2g} arcsec at most from the solution"
        )

    @property
    def faithful(self) -> bool:
        """Boolean: the header is where the solution is."""
        return SKY_CLOSURE.met_by(self.solution / self.pixel)

    @property
    def level(self) -> int:
        """At which level it is logged."""
        return logging.INFO if self.faithful else logging.WARNING

    @property
    def findings(self) -> list[str]:
        """Faults, as the product's findings have them."""
        if self.faithful:
            return []
        return [
            f"error: sky: astropy.wcs puts pixels up to {self.solution:.3g} arcsec "
            f"({self.solution / self.pixel:.2g} px) from where the solution has them"
        ]


def sky_closure(
    product: ProductInput, stars: StarSample, path: Path, chip: int
) -> SkyClosure | None:
    """Closure of a header as written; None where the stars are not on the sky, or none is left.

    Of several exposures with frames only the first one counts, whose header it is.
    """
    point, solution = product.tangent_point, product.solution
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
    uv = model.predict(
        solution.mean, x, y, chip=chip, **({} if model.time is None else {"epoch": product.epoch})
    )
    u, v = uv.T * arcsec
    own = SkyCoord(*sky_of_plane(u, v, point), unit="deg")
    east, north = true.spherical_offsets_to(at)
    return SkyClosure(
        n=int(mine.sum()),
        rms=float(np.sqrt(np.mean(true.separation(at).arcsec ** 2))),
        east=float(east.to_value(apu.arcsec).mean()),
        north=float(north.to_value(apu.arcsec).mean()),
        solution=float(own.separation(at).arcsec.max()),
        pixel=model.pixel_size(solution.mean) * arcsec,
    )
