"""Simulation of the 47 Tucanae campaign of ACS/WFC from a single seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesdist.data.exposures import Exposure, ExposureLog
from bayesdist.errors import InputError
from bayesdist.missions.hst.simulate.detections import Detector, star_list
from bayesdist.missions.hst.simulate.distortion import ACS_FILTERS, acs_solution
from bayesdist.missions.hst.simulate.pointings import exposures_of, frames_of
from bayesdist.missions.hst.simulate.stars import measured_catalogs, true_stars
from bayesdist.missions.hst.simulate.tables import detector_tables, filter_tables
from bayesdist.missions.hst.simulate.truth import AcsCampaign, AcsTruth

BASE = "F606W"
FEWEST = 100  # minimum number of stars
SCATTER = (
    7e-6  # exposure-to-exposure sd of linear terms: sigma(alpha) of Table 1 is 7e-6 / sqrt(60)
)


def simulate_acs(
    *,
    seed: int = 1,
    n_exposures: int = 110,
    n_stars: int = 53_900,
    filters: Sequence[str] = (BASE,),
    n_other: int = 15,
    fine_scale: bool = True,
    cte: bool = False,
    scatter: float = SCATTER,
    outlying: float = 0.0,
    centroid: float = 1.0,
    false: float = 0.05,
    blended: float = 0.01,
    pa_v3: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> AcsCampaign:
    """Simulate the campaign of ACS ISR 2015-06: star lists of 47 Tuc, and their truth.

    The parts of the simulation have independent random streams, so that an option that changes one
    part does not affect the others.

    Parameters
    ----------
    seed : int, optional
    n_exposures : int, optional
        Number of exposures in F606W.
    n_stars : int, optional
        Number of stars in the catalogue.
    filters : sequence of str, optional
        One or more of F435W, F475W, F606W, F814W.
    n_other : int, optional
        Number of exposures in each filter other than F606W.
    fine_scale : bool, optional
        True to include look-up tables of the detector and of the filters.
    cte : bool, optional
        True to displace the positions by charge-transfer inefficiency.
    scatter : float, optional
        Exposure-to-exposure standard deviation of A_2, B_2 and B_3, mostly common to both chips.
    outlying : float, optional
        Probability that the deviation of an exposure is ten times larger.
    centroid : float, optional
        Factor on the centroid errors; 0 gives exact positions.
    false : float, optional
        Fraction of false detections in each list.
    blended : float, optional
        Fraction of the stars that are displaced by a close neighbour, by up to half a pixel.
    pa_v3 : float, optional
        Common roll angle of all exposures in degrees; by default the roll angles follow the Sun.
    progress : callable, optional
        Function that is called with the number of finished exposures and their total number.

    Returns
    -------
    AcsCampaign

    Raises
    ------
    InputError
        If a filter is unknown or repeated, there are too few exposures or stars, a fraction is
        outside [0, 1), or another parameter is negative.
    """
    settings = {
        "seed": seed,
        "n_exposures": n_exposures,
        "n_stars": n_stars,
        "filters": list(filters),
        "n_other": n_other,
        "fine_scale": fine_scale,
        "cte": cte,
        "scatter": scatter,
        "outlying": outlying,
        "centroid": centroid,
        "false": false,
        "blended": blended,
        "pa_v3": pa_v3,
    }
    _check(filters, settings)
    if n_stars < FEWEST:
        raise InputError(
            f"n_stars is {n_stars}, so that exposures may be empty",
            where="n_stars",
            do=f"give at least {FEWEST}",
        )

    def rng(*key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))

    stars = true_stars(n_stars, rng(0))
    catalog, early, late = measured_catalogs(stars, rng(1))
    code = {name: k for k, name in enumerate(ACS_FILTERS)}
    keys: dict[Exposure, tuple[int, int]] = {}  # keys of the random stream of each exposure
    for name in filters:
        n = n_exposures if name == BASE else n_other
        new = exposures_of(name, n, rng(2, code[name]), pa_v3=pa_v3)
        keys |= {exposure: (code[name], k) for k, exposure in enumerate(new)}
    log = ExposureLog(tuple(sorted(keys, key=lambda exposure: exposure.epoch)), source="simulation")
    tables = detector_tables(rng(3)) if fine_scale else ()
    for name in filters if fine_scale else ():
        tables += filter_tables(name, rng(4, code[name]))
    model, _ = acs_solution()
    truth = AcsTruth(
        model=model,
        theta={name: acs_solution(name)[1] for name in filters},
        tables=tables,
        stars=stars,
        log=log,
        frames=frames_of(
            log, [rng(5, *keys[exposure]) for exposure in log], scatter=scatter, outlying=outlying
        ),
        detections=(),
        settings=settings,
    )
    detector = Detector(centroid, false, blended, cte)
    measured = []
    for k, exposure in enumerate(log):
        measured.append(star_list(truth, exposure.name, detector, rng(6, *keys[exposure])))
        if progress is not None:
            progress(k + 1, len(log))
    lists, detections = zip(*measured, strict=True)
    truth = replace(truth, detections=detections)
    return AcsCampaign(catalog, early, late, log, lists, truth)


# settings: lowest allowed value, exclusive upper bound, and description
_RANGES: dict[tuple[str, ...], tuple[float, float, str]] = {
    ("n_exposures", "n_other"): (1, np.inf, "1 or more"),
    ("outlying", "false", "blended"): (0.0, 1.0, "a fraction in [0, 1)"),
    ("scatter", "centroid", "seed"): (0.0, np.inf, "0 or more"),
}


def _check(filters: Sequence[str], settings: Mapping[str, Any]) -> None:
    for name in filters:
        acs_solution(name)
    if not filters or len(set(filters)) < len(filters):
        raise InputError(
            f"filters are {', '.join(filters) or 'none'}", where="filters", do="list each one once"
        )
    for names, (low, high, words) in _RANGES.items():
        for name in names:
            if not low <= settings[name] < high:
                raise InputError(f"{name} is {settings[name]:g}", where=name, do=f"give {words}")
