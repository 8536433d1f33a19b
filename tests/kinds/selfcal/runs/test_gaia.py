"""Three years of a field in the bulge, seen by HST, with half of its Gaia stars as references.

The lists are corrected by the observatory's solution, so that the distortion found here is what is
left; proper motions are those of all stars, and the other half of Gaia's says whether they are
right.
"""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table
from scipy.spatial import cKDTree

from bayesdist.data import ReferenceCatalog, read_catalog
from bayesdist.kinds.selfcal.infer import star_catalogue
from tests.app.support import summary_of, write_config
from tests.kinds.selfcal.runs.support import fitted

pytestmark = pytest.mark.slow

DAYS = {"2011_10_31": 2011.83, "2012_09_25": 2012.73, "2013_10_24": 2013.81}
COLUMNS = {
    "x0": "u", "y0": "v", "x0e": "sigma_u", "y0e": "sigma_v", "vx": "pm_u", "vy": "pm_v",
    "vxe": "sigma_pm_u", "vye": "sigma_pm_v", "t0": "epoch",
    "m": "mag",
}  # fmt: skip
ROBUST = 1.4826  # standard deviation over median absolute deviation of a normal density


@pytest.fixture(scope="module")
def solved(data_dir, tmp_path_factory):
    """A fitted run, and the Gaia stars that it has not seen."""
    folder = tmp_path_factory.mktemp("flystar")
    for day, epoch in DAYS.items():
        path = data_dir / "flystar" / f"{day}_F606W_MATCHUP_XYMEEE_final.calib"
        table = Table.read(path, format="ascii")["x", "y", "m"]
        table.rename_column("m", "mag")
        table["exposure"], table["epoch"] = day, epoch
        table.write(folder / f"{day}.ecsv")
    gaia = Table.read(data_dir / "flystar" / "my_gaia.fits")[list(COLUMNS)]
    gaia.meta.clear()
    for old, new in COLUMNS.items():
        gaia.rename_column(old, new)
        if new not in ("epoch", "mag"):
            gaia[new].unit = "arcsec / yr" if "pm" in new else "arcsec"
    half = np.random.default_rng(1).uniform(size=len(gaia)) < 0.5
    gaia[half].write(folder / "references.ecsv")
    gaia[~half].write(folder / "others.ecsv")
    config = write_config(
        folder / "config.toml",
        data=None,
        selfcal={
            "lists": "20*.ecsv",
            "match_radius": 1.0,
            "start_radius": 3.0,
            "min_detections": 3,
            "motion": "proper_motion",
            "unit": "arcsec",
        },
        gauge={"reference": {"catalog": "references.ecsv"}},
        detector={"size": (2100, 2100), "scale_mas": 40.0},
        model={"order": 3},
    )
    run = fitted(folder / "run", config)
    others = read_catalog(folder / "others.ecsv")
    return run, others.select(others.measured_motion)


def test_gaia_fixes_what_the_detections_leave_open(solved):
    run, _ = solved
    gauge = summary_of(run.directory.path)["selfcal"]["gauge"]
    free = [one for one in gauge["directions"] if one["state"] == "free"]
    assert {one["name"] for one in free} >= {"zero_point_u", "zero_point_v", "scale", "rotation"}
    assert {one["fixed_by"] for one in free} == {"reference stars"}
    assert not gauge["held"]


def test_other_gaia_stars_move_as_was_found(solved, capsys):
    """Motions agree within the errors of both; places, in a crowded field, to a tenth of a pixel.

    Gaia's errors of faint stars are too small where stars are crowded, and a cubic leaves 0.03
    pixels of what the observatory's solution has left: places differ by more than their errors.
    """
    run, others = solved
    stars = star_catalogue(run.parts["solved"].mode)
    there: ReferenceCatalog = others.at(stars.epoch)
    tree = cKDTree(stars.values[:, :2])
    distance, which = tree.query(np.column_stack([there.u, there.v]), distance_upper_bound=0.08)
    pairs = np.flatnonzero(np.isfinite(distance))
    pairs = pairs[~run.parts["solved"].mode.problem.priors.informed[which[pairs]]]
    which = which[pairs]
    found = {}
    for name, first in (("place", 0), ("motion", 2)):
        names = ("u", "v") if name == "place" else ("pm_u", "pm_v")
        theirs, error = (
            np.column_stack([getattr(there, prefix + key)[pairs] for key in names])
            for prefix in ("", "sigma_")
        )
        off = stars.values[which, first : first + 2] - theirs
        own = np.einsum("naa->na", stars.cov[which, first : first + 2, first : first + 2])
        pull = off / np.sqrt(own + error**2)
        found[name] = [ROBUST * np.median(np.abs(one)) for one in (off * 1000, pull)]
    with capsys.disabled():
        print(
            f"\n{len(pairs)} Gaia stars beside the references: places differ by "
            f"{found['place'][0]:.2f} mas, {found['place'][1]:.2f} of their errors; motions by "
            f"{found['motion'][0]:.2f} mas a year, {found['motion'][1]:.2f} of their errors"
        )
    assert len(pairs) > 80
    # a robust deviation of 2 n numbers is known to 1.17 / sqrt(2 n): 8 %
    assert abs(found["motion"][1] - 1) < 4 * 1.17 / np.sqrt(2 * len(pairs))
    assert found["place"][0] < 5.0
