"""Simulated field west of 47 Tucanae: true stars, and their standard catalogue.

As in ACS ISR 2015-06, Section 2: 53917 stars on a tangent plane in ACS/WFC pixels at epoch 2004.5.
(5000, 5000) is the centre of the field, 6.7' west of the cluster; u increases to the west and v to
the north.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bayesdist.data import ReferenceCatalog
from bayesdist.utils.arrays import Float

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
