"""The 47 Tucanae campaign of ACS/WFC, all from one seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesdist.data.exposures import Exposure, ExposureLog
from bayesdist.errors import InputError
from bayesdist.missions.acs.simulate.detections import Detector, star_list
from bayesdist.missions.acs.simulate.distortion import ACS_FILTERS, acs_solution
from bayesdist.missions.acs.simulate.pointings import exposures_of, frames_of
from bayesdist.missions.acs.simulate.stars import measured_catalogs, true_stars
from bayesdist.missions.acs.simulate.tables import detector_tables, filter_tables
from bayesdist.missions.acs.simulate.truth import AcsCampaign, AcsTruth

BASE = "F606W"
FEWEST = 100  # stars
SCATTER = 7e-6  # of the linear terms: 7e-6 / sqrt(60) is the sigma(alpha) of Table 1


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
    """Campaign of ACS ISR 2015-06: star lists of 47 Tuc, and their truth.

    Each part has random numbers of its own: an option that changes one leaves the others as they
    are.

    Parameters
    ----------
    seed : int, optional
    n_exposures : int, optional
        In F606W.
    n_stars : int, optional
        Of the catalogue.
    filters : sequence of str, optional
        Of F435W, F475W, F606W, F814W.
    n_other : int, optional
        Exposures in each other filter.
    fine_scale : bool, optional
        True for look-up tables of the detector and of the filters.
    cte : bool, optional
        True where trailed charge displaces the positions.
    scatter : float, optional
        Standard deviation of A_2, B_2 and B_3 from exposure to exposure, mostly common to both
        chips.
    outlying : float, optional
        Probability that an exposure deviates ten times as much.
    centroid : float, optional
        Factor on the centroid errors; 0 gives exact positions.
    false : float, optional
        Fraction of each list that is no star.
    blended : float, optional
        Fraction of the stars that a close neighbour displaces, by up to half a pixel.
    pa_v3 : float, optional
        One roll angle for all exposures, degrees, in place of angles that follow the Sun.
    progress : callable, optional
        Called with the exposures made and their number.

    Returns
    -------
    AcsCampaign

    Raises
    ------
    InputError
        For an unknown or repeated filter, too few exposures or stars, fractions outside [0, 1), or
        a negative size.
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
            f"n_stars is {n_stars}, and exposures may stay empty",
            where="n_stars",
            do=f"give {FEWEST} or more",
        )

    def rng(*key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))

    stars = true_stars(n_stars, rng(0))
    catalog, early, late = measured_catalogs(stars, rng(1))
    code = {name: k for k, name in enumerate(ACS_FILTERS)}
    keys: dict[Exposure, tuple[int, int]] = {}  # an exposure's own random numbers
    for name in filters:
        n = n_exposures if name == BASE else n_other
        made = exposures_of(name, n, rng(2, code[name]), pa_v3=pa_v3)
        keys |= {one: (code[name], k) for k, one in enumerate(made)}
    log = ExposureLog(tuple(sorted(keys, key=lambda one: one.epoch)), source="simulation")
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
            log, [rng(5, *keys[one]) for one in log], scatter=scatter, outlying=outlying
        ),
        detections=(),
        settings=settings,
    )
    detector = Detector(centroid, false, blended, cte)
    measured = []
    for k, one in enumerate(log):
        measured.append(star_list(truth, one.name, detector, rng(6, *keys[one])))
        if progress is not None:
            progress(k + 1, len(log))
    lists, detections = zip(*measured, strict=True)
    truth = replace(truth, detections=detections)
    return AcsCampaign(catalog, early, late, log, lists, truth)


# settings: lowest, first above the highest, and what to give
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
            f"filters are {', '.join(filters) or 'none'}", where="filters", do="name each one once"
        )
    for names, (low, high, words) in _RANGES.items():
        for name in names:
            if not low <= settings[name] < high:
                raise InputError(f"{name} is {settings[name]:g}", where=name, do=f"give {words}")
