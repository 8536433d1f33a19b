"""Stars found by a self-calibration, written as a catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from astropy.table import Column, Table
from astropy.units import Unit

from bayesdist.app.store.output import write_table
from bayesdist.data import ReferenceCatalog
from bayesdist.data.storage import write_columns
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.infer import Compute
from bayesdist.kinds.selfcal.infer import SelfCalibrationMode, StarCatalogue, star_catalogue
from bayesdist.kinds.selfcal.solved import SelfCalibrated
from bayesdist.utils.arrays import Float

NAMES = ("u", "v", "pm_u", "pm_v", "parallax")
FEW, DOUBTFUL, REFERENCE = 1, 2, 4
FLAGS = {
    FEW: "two detections: one false one would not show",
    DOUBTFUL: "more than a third of the detections are expected to be false",
    REFERENCE: "a reference star: its catalogue position is among its measurements",
}
MIN_MEMBERS = 2 / 3  # expected fraction of true detections below which a star is doubtful
PARQUET_FROM = 100_000  # number of stars above which a Parquet file is written, too


class StarsFacts(TypedDict):
    """Entry 'stars' of the section 'selfcal' of summary.json."""

    n: int
    unit: str  # of the radii
    epoch: float | None  # decimal years; None if stars do not move
    n_two_detections: int
    n_doubtful: int
    n_reference: int
    radius_median: float  # errors of both axes together, including those of the distortion
    radius_own_median: float  # from the detections of the star alone


def write_stars(
    folder: Path,
    solved: SelfCalibrated,
    correlated: Discrepancy | None,
    notes: Mapping[str, Any],
    compute: Compute,
) -> StarsFacts:
    """Write stars.ecsv and, if there are many stars, stars.parquet.

    Parameters
    ----------
    folder : Path
    solved : SelfCalibrated
    correlated : Discrepancy or None
        Adds its covariance of the parameters, which all stars have in common.
    notes : mapping
        Metadata of the table.
    compute : Compute

    Returns
    -------
    StarsFacts
    """
    solution, references = solved.mode, solved.references
    cov = None if correlated is None else correlated.covariance
    catalogue = star_catalogue(solution, cov, compute=compute)
    table = star_table(solution, catalogue, solved.matches.mag, references)
    table.meta |= notes
    if solved.contact is not None:
        table.meta["contact"] = list(solved.contact)
    write_table(table, folder / "stars.ecsv")
    path = folder / "stars.parquet"
    path.unlink(missing_ok=True)
    if len(table) > PARQUET_FROM:
        columns = {name: np.asarray(table[name]) for name in table.colnames}
        units = {name: str(table[name].unit) for name in columns if table[name].unit is not None}
        write_columns(path, columns, units)
    flags = np.asarray(table["flags"])
    sigma = np.hypot(table["sigma_u"], table["sigma_v"])
    radius_detections = np.hypot(table["sigma_own_u"], table["sigma_own_v"])
    return {
        "n": len(table),
        "unit": catalogue.unit,
        "epoch": catalogue.epoch or None,
        "n_two_detections": int((flags & FEW > 0).sum()),
        "n_doubtful": int((flags & DOUBTFUL > 0).sum()),
        "n_reference": int((flags & REFERENCE > 0).sum()),
        "radius_median": float(np.median(sigma)),
        "radius_own_median": float(np.median(radius_detections)),
    }


def star_table(
    solution: SelfCalibrationMode,
    found: StarCatalogue,
    mag: Float | None = None,
    references: ReferenceCatalog | None = None,
) -> Table:
    """Table of stars with their covariance, one row per star.

    Columns are u, v (and pm_u, pm_v); sigma_u and so on, which include the errors of distortion and
    frames in the gauge of the run; cov_u_v and so on; sigma_own_u and sigma_own_v from the
    detections of the star alone; n, n_members, mag (the median) and flags.
    """
    names = NAMES[: found.values.shape[1]]
    units = [f"{found.unit} / yr" if name.startswith("pm") else found.unit for name in names]
    table = Table({"star": np.arange(len(found))})
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        table[name] = Column(found.values[:, k], unit=unit)
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        table[f"sigma_{name}"] = Column(np.sqrt(found.cov[:, k, k]), unit=unit)
    for a, b in combinations(range(len(names)), 2):
        unit = Unit(units[a]) * Unit(units[b])
        table[f"cov_{names[a]}_{names[b]}"] = Column(found.cov[:, a, b], unit=unit)
    for k, name in enumerate(names[:2]):
        table[f"sigma_own_{name}"] = Column(np.sqrt(found.own[:, k, k]), unit=found.unit)
    table["n"] = found.n
    table["n_members"] = found.n_members
    if mag is not None:
        table["mag"] = solution.problem.medians(mag)
    flags = np.where(found.n == 2, FEW, 0)
    flags |= np.where(found.n_members < MIN_MEMBERS * found.n, DOUBTFUL, 0)
    flags |= np.where(solution.problem.priors.informed, REFERENCE, 0)
    table["flags"] = flags
    table.meta = {"flags": {str(bit): text for bit, text in FLAGS.items()}}
    if found.epoch:
        table.meta["epoch"] = found.epoch
    if references is not None and references.tangent_point:
        table.meta["tangent_point"] = list(references.tangent_point)
    return table
