"""`bd.read_calibration` of a run: as its files and its budget have it."""

from __future__ import annotations

import numpy as np
import pytest

import bayesdist as bd
from bayesdist import formats
from bayesdist.app.products import product_of_run
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory

X, Y = (a.ravel() for a in np.meshgrid(np.linspace(1, 1000, 9), np.linspace(1, 800, 7)))

pytestmark = pytest.mark.filterwarnings("ignore::bayesdist.errors.BayesdistWarning")


def test_a_run_has_the_calibration_that_it_exports(finished):
    with Run.of(RunDirectory(finished.path)) as results:
        exported = product_of_run(results).calibration
    for path in (finished.path, finished.path / "posterior.nc"):
        found = bd.read_calibration(path)
        assert (found.unit, found.numbers, found.detector) == ("pix", (1,), "A")
        np.testing.assert_array_equal(found.forward(X, Y, chip=1), exported.forward(X, Y, chip=1))
        np.testing.assert_array_equal(found.solution.cov, exported.solution.cov)
        assert found.further  # rows of the budget beside the covariance


def test_the_size_of_a_pixel_is_that_of_the_run(finished, tmp_path):
    """A header has the same numbers as the one that the run has written."""
    calibration = bd.read_calibration(finished.path)
    _, path = calibration.write("sip", tmp_path / "camera.hdr", inverse_order=4)
    ours, theirs = (formats.read_sip(p) for p in (path, finished.path / "sip.hdr"))
    np.testing.assert_array_equal(ours.cd, theirs.cd)
    assert ours.a == theirs.a and ours.b == theirs.b and ours.sigma_a == theirs.sigma_a
    assert abs(np.sqrt(abs(np.linalg.det(ours.cd))) * 3600e3 - 50.0) < 0.5
    _, other = calibration.write("sip", tmp_path / "other.hdr", scale_mas=100.0)
    np.testing.assert_allclose(formats.read_sip(other).cd, 2 * ours.cd, rtol=1e-12)


@pytest.mark.parametrize("name", ["gone", "notes.txt", "empty"])
def test_what_is_no_calibration_is_refused(tmp_path, name):
    (tmp_path / "notes.txt").write_text("nothing\n")
    (tmp_path / "empty").mkdir()
    words = {
        "gone": "there is no such file",
        "notes.txt": "has an unknown format",
        "empty": "but not a run",
    }
    with pytest.raises(bd.InputError, match=f"{name}: .*{words[name]}") as refused:
        bd.read_calibration(tmp_path / name)
    assert "\n" not in str(refused.value)
