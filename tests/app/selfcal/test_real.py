"""Four dithered exposures of WFC3/UVIS, raw pixels alone, against the observatory's solution."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.app import stages
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.selfcal.session import SelfcalSession
from bayesdist.app.sessions import session_of
from bayesdist.data import read_hst1pass
from tests.app.selfcal.support import affine_left
from tests.app.support import good, summary_of, write_config

pytestmark = pytest.mark.slow

SIDE, CELLS = 1024, 12
WITHIN_95 = 5.991  # chi-square of two numbers


@pytest.fixture(scope="module")
def run(data_dir, tmp_path_factory):
    folder = tmp_path_factory.mktemp("uvis")
    config = write_config(
        folder / "config.toml",
        data=None,
        selfcal={
            "lists": str(data_dir / "hst1pass_uvis" / "*.uvwXYMpq"),
            "match_radius": 0.5,
            "start_radius": 2.0,
        },
        detector={"size": (SIDE, SIDE), "scale_mas": 39.6},
        model={"order": 3},
        sampler={"seed": 1},
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(stages._FUNCTIONS, "report", lambda session: None)
        good("run", config, "-o", folder / "run")
    return folder / "run"


def test_what_was_found(run):
    """The lists hold 7386 detections; the exposures have one roll and 5.5-pixel dithers."""
    found = summary_of(run)
    counts = found["selfcal"]["detections"]
    assert counts["read"] == 7386
    assert counts["used"] > 7000
    free = {d["name"] for d in found["selfcal"]["gauge"]["directions"] if d["state"] == "free"}
    assert {"skew_plus", "skew_cross"} < free
    assert found["sampler"]["converged"]


def test_the_distortion_is_that_of_the_observatory(run, data_dir, capsys):
    """Quadratic terms and higher, at the detections nearest to a grid of 12 by 12.

    What one roll angle cannot tell is a linear map of the sky: its best one is taken off.
    """
    session = session_of(RunDirectory.open(run))
    assert isinstance(session, SelfcalSession)
    columns = read_hst1pass(data_dir / "hst1pass_uvis" / "ie8j01xlq_flt.uvwXYMpq").columns
    x, y, u, v = (np.asarray(columns[name], float) for name in "XYuv")
    nodes = (np.arange(CELLS) + 0.5) * SIDE / CELLS
    rows = np.unique([np.argmin((x - a) ** 2 + (y - b) ** 2) for a in nodes for b in nodes])
    relative = session.relative
    model, K = relative.model, relative.model.n_polynomial
    first = np.zeros(len(x), np.int64)
    ours = model.predict(relative.mean, x, y, exposure=first)
    theirs = np.column_stack([u, v])
    off = (theirs - ours - affine_left(ours, theirs, ours, "linear"))[rows]
    J = model.jacobian(relative.mean, x[rows], y[rows], exposure=first[rows])[..., :K]
    cov = np.einsum("nad,de,nbe->nab", J, np.asarray(relative.cov)[:K, :K], J)
    square = np.einsum("na,nab,nb->n", off, np.linalg.inv(cov), off)
    inside = np.mean(square < WITHIN_95)
    pulls = off / np.sqrt(np.einsum("naa->na", cov))
    with capsys.disabled():
        print(
            f"\nself-calibration of WFC3/UVIS: {100 * inside:.1f} % of {len(rows)} positions within"
            f" the 95 % ellipse, rms pull {np.sqrt((pulls**2).mean()):.2f}, difference"
            f" {off.std():.3f} pix rms"
        )
    # errors of neighbours are shared: a field of 14 numbers, of which one is a few positions
    assert inside >= 0.95
