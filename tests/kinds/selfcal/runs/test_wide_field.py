"""A field of 19 minutes of arc and steps of 8, from lists: the size of a pixel bends the sky."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.kinds.selfcal.diagnose.tests import selfcal_score_tests
from bayesdist.kinds.selfcal.matching import FirstSolution
from tests.app.support import good
from tests.kinds.selfcal.infer.wide import ARCSEC, MIDDLE, N, observed, on, tangent_plane
from tests.kinds.selfcal.runs.support import fitted, write_selfcal
from tests.reduced import case_in_full

SEED = 5


def _config(folder, scale_mas, **more):
    detections = observed(SEED)[0]
    names = np.array(detections.exposure_names)[detections.exposure]
    columns = {"x": detections.x, "y": detections.y, "exposure": names}
    detector = {"size": (float(N), float(N))}
    return write_selfcal(
        folder / "input",
        Table(columns),
        selfcal={"match_radius": 1.0, "start_radius": 20.0},
        detector=detector if scale_mas is None else detector | {"scale_mas": scale_mas},
        model={"order": 3, "reference_pixel": (MIDDLE, MIDDLE)},
        **more,
    )


@pytest.mark.parametrize(
    "scale_mas",
    [1000 * ARCSEC, case_in_full(None, instead="pixels of known size are run")],
)
def test_tangent_planes_are_taken_to_one_by_the_size_of_a_pixel(tmp_path, scale_mas):
    config = _config(tmp_path, scale_mas)
    told = good("check", config).out
    run = fitted(tmp_path / "run", config)
    moved = run.directory.summary["selfcal"]["tangent_planes_pix"]
    # of a corner, p (p . d) and p d^2 in pixels of so many radians, with the largest offset d
    pointings = observed(SEED)[1]
    first = tangent_plane(*pointings[0], scale=ARCSEC)
    offset, corner = np.hypot(*on(first, pointings).T).max(), N / np.sqrt(2)
    most = corner * offset * (corner + offset) * np.radians(ARCSEC / 3600) ** 2
    stars = run.placed
    tests = selfcal_score_tests(run.parts["solved"].mode, mag=stars.mag, epoch=stars.epoch)
    [test] = [one for one in tests if one.name == "pointing"]
    if scale_mas is None:
        assert "taken as flat" in told
        assert moved == 0
        assert test.significant and "detector.scale_mas" in test.remedy
        assert 0 < test.size < most
    else:
        assert "tangent planes taken to one" in told
        assert most / 4 < moved < most
        assert not test.significant
        # the stars' plane touches the sky in the middle of all pointings, whichever is first
        at = run.directory.summary["selfcal"]["tangent_plane"]
        assert at["pixel"] == [MIDDLE, MIDDLE]
        solution = run.fit
        middle = solution.model.predict(solution.mean, MIDDLE, MIDDLE, exposure=0)
        [contact] = first.wcs_pix2world([np.array(at["contact"]) - np.ravel(middle)], 1)
        off = on(tangent_plane(*contact, scale=ARCSEC), pointings).mean(axis=0)
        assert np.hypot(*off) < 0.003 * offset
        assert f"at pixel ({MIDDLE:g}, {MIDDLE:g}) of chip" in run.gauge_words
        # what the stages after the match read
        raw, kept = run.inputs.detections, run.part(FirstSolution).detections
        assert np.hypot(kept.x - raw.x, kept.y - raw.y).max() == pytest.approx(moved)
