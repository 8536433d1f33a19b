"""Four dithered exposures of WFC3/UVIS, raw pixels alone, against the observatory's solution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.formats.hst1pass import read_hst1pass
from bayesdist.infer.solution.transforms import gauge_free
from tests.app.support import good, summary_of, write_config
from tests.reduced import only_in_full

pytestmark = [pytest.mark.slow, only_in_full("simulated fields are calibrated")]

SIDE, CELLS = 1024, 12
WITHIN_95 = 5.991  # chi-square of two numbers
NUMBERS = 14  # of an order of 3: coefficients beyond the linear ones, both axes


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
        patch.setattr("bayesdist.app.stages.report", lambda run, pdf: [])
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

    What one roll angle cannot tell is a linear map of the sky: its best one is taken off.  What is
    left of a field of order 3 is 14 numbers, so that neighbours share their errors: how many
    positions lie within their 95 % ellipse is then a lottery of mean 0.95 (half the draws of a
    posterior have more than 0.99 within, one of twenty less than 0.76), and the 14 numbers
    together are the sharper test.
    """
    opened = Run.of(RunDirectory.open(run))
    columns = read_hst1pass(data_dir / "hst1pass_uvis" / "ie8j01xlq_flt.uvwXYMpq").columns
    x, y, u, v = (np.asarray(columns[name], float) for name in "XYuv")
    nodes = (np.arange(CELLS) + 0.5) * SIDE / CELLS
    rows = np.unique([np.argmin((x - a) ** 2 + (y - b) ** 2) for a in nodes for b in nodes])
    x, y, theirs = x[rows], y[rows], np.column_stack([u, v])[rows]
    relative = gauge_free(opened.solution, opened.parts["solved"].gauge.null)
    model, K = relative.model, relative.model.n_polynomial
    first = np.zeros(len(x), np.int64)
    ours = model.predict(relative.mean, x, y, exposure=first)
    plane = np.column_stack([np.ones(len(x)), ours])
    rest = np.eye(len(x)) - plane @ np.linalg.pinv(plane)
    off = rest @ (theirs - ours)
    J = np.einsum("mn,nad->mad", rest, model.jacobian(relative.mean, x, y, exposure=first)[..., :K])
    cov_of_coefficients = np.asarray(relative.cov)[:K, :K]
    cov = np.einsum("nad,de,nbe->nab", J, cov_of_coefficients, J)
    precision = np.linalg.inv(cov)
    inside = np.mean(np.einsum("na,nab,nb->n", off, precision, off) < WITHIN_95)
    pulls = off / np.sqrt(np.einsum("naa->na", cov))
    # all positions together: along the directions in which the field can be off at all
    values, vectors = np.linalg.eigh(cov_of_coefficients)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    U, s, _ = np.linalg.svd(J.reshape(-1, K) @ root, full_matrices=False)
    assert s[NUMBERS] < 1e-6 * s[NUMBERS - 1]
    square = float(np.sum((U[:, :NUMBERS].T @ off.ravel() / s[:NUMBERS]) ** 2))
    draws = np.random.default_rng(1).standard_normal((2000, K)) @ root.T
    drawn = np.einsum("nad,sd->sna", J, draws)
    shares = (np.einsum("sna,nab,snb->sn", drawn, precision, drawn) < WITHIN_95).mean(axis=1)
    with capsys.disabled():
        print(
            f"\nself-calibration of WFC3/UVIS: {100 * inside:.1f} % of {len(rows)} positions within"
            f" the 95 % ellipse (so many or fewer in {100 * np.mean(shares <= inside):.0f} % of the"
            f" posterior's own draws), chi-square {square:.1f} of {NUMBERS}, rms pull"
            f" {np.sqrt((pulls**2).mean()):.2f}, difference {off.std():.3f} pix rms"
        )
    assert inside >= np.quantile(shares, 0.01)
    low, high = stats.chi2.ppf([0.005, 0.995], NUMBERS)
    assert low < square < high
