"""IDCTABs of ours read by stwcs, and the sky it makes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.table import IdcTab, write_idctab
from tests.reduced import case_in_full

from .stwcs_offline import archived_sky, gnomonic, separation_mas, sky
from .support import F606W, wfc_solution

pytest.importorskip("stwcs")
VAFACTOR = {2: 1.000018683511, 1: 1.000018683511}  # of the exposure


@pytest.fixture(scope="module")
def pixels():
    rng = np.random.default_rng(4)
    return rng.uniform(1, 4096, 300), rng.uniform(1, 2048, 300)


def written(tab: IdcTab, folder: Path, name: str) -> Path:
    path = folder / f"{name}_idc.fits"
    write_idctab(tab, path)
    return path


def made_from(real: IdcTab, **names) -> IdcTab:
    record = real.rows[real.row(2, F606W)]
    return idctab_from_solution(
        wfc_solution(real), instrument="ACS", detector="WFC", scale_arcsec=0.05,
        v2ref=float(record["V2REF"]), v3ref=float(record["V3REF"]), **names,
    )  # fmt: skip


def test_the_way_through_stwcs_is_the_pipelines(data_dir, tmp_path, pixels) -> None:
    """The table of that time gives the solution that the archive wrote into the header."""
    source = data_dir / "hst_reference" / "qbu1641sj_idc.fits"
    ours = sky(tmp_path, source, *pixels)
    for chip, theirs in archived_sky(*pixels).items():
        assert separation_mas(ours[chip], theirs).max() < 0.005


@pytest.mark.parametrize(
    ("filters", "date"),
    [
        *[(F606W, "2005-03-07"), (None, "2016-07-01")],
        *(
            case_in_full(*one, instead="each date and each kind of row is run")
            for one in ((F606W, "2016-07-01"), (None, "2005-03-07"))
        ),
    ],
)
def test_same_sky_as_the_original(real, data_dir, tmp_path, pixels, date, filters) -> None:
    original = sky(tmp_path, data_dir / "hst_reference" / "0461802ej_idc.fits", *pixels, date)
    path = written(made_from(real, filters=filters), tmp_path, "ours")
    ours = sky(tmp_path, path, *pixels, date)
    for chip in (1, 2):
        assert separation_mas(ours[chip], original[chip]).max() < 0.01


def test_the_comparison_would_see_a_small_change(real, tmp_path, pixels) -> None:
    """facts: a change of CX22 by 2e-9 moves the sky by 8.38 mas."""
    solution = wfc_solution(real)
    basis = solution.model.basis(1)
    step = np.zeros(basis.n_terms)
    step[basis.terms.index((2, 0))] = 2e-9
    theta = solution.mean.copy()
    theta[solution.model.coefficient_slice(1, 0)] += basis.from_monomials(step)
    skies = [
        sky(
            tmp_path,
            written(
                idctab_from_solution(s, instrument="ACS", detector="WFC", scale_arcsec=0.05),
                tmp_path, name,
            ),
            np.array([4096.0, 1.0]), np.array([1024.0, 1024.0]),
        )
        for name, s in (("a", solution), ("b", replace(solution, mean=theta)))
    ]  # fmt: skip
    assert separation_mas(skies[0][1], skies[1][1]).max() == pytest.approx(8.38, abs=0.02)
    assert separation_mas(skies[0][2], skies[1][2]).max() < 1e-4


def test_drift_is_applied_with_the_sign_of_the_model(real, tmp_path, pixels) -> None:
    """Between two dates the sky moves as the model's drift does."""
    solution = wfc_solution(real)
    path = written(made_from(real), tmp_path, "ours")
    early, late = (sky(tmp_path, path, *pixels, date)[2] for date in ("2005-01-01", "2015-01-01"))
    years = 10.0  # both are day 1
    model = solution.model
    uv = [model.predict(solution.mean, *pixels, epoch=2005.0 + dt, chip=2) for dt in (0.0, years)]
    expected = np.hypot(*(uv[1] - uv[0]).T) * 1e3
    assert expected.max() > 30  # this is what a file without the keywords would lose
    assert_allclose(separation_mas(early, late), expected, atol=0.05)


def test_the_sky_is_the_models_plane(real, tmp_path, pixels) -> None:
    """Both chips at once: (xi, eta) of stwcs is (u, v) of the model, but for a rotation.

    The fit has the velocity aberration of the exposure in it, the table has not, and stwcs puts it
    back: no scale is left free.  Chip 1 has its own tangent point, which costs less than 0.1 mas.
    """
    factor = VAFACTOR[2]
    solution = wfc_solution(real, vafactor=factor)
    record = real.rows[real.row(2, F606W)]
    tab = idctab_from_solution(
        solution, instrument="ACS", detector="WFC", scale_arcsec=0.05, vafactor=factor,
        v2ref=float(record["V2REF"]), v3ref=float(record["V3REF"]),
    )  # fmt: skip
    ours = sky(tmp_path, written(tab, tmp_path, "ours"), *pixels)
    epoch = 2005 + 66 / 365.25  # March 7
    uv = np.concatenate(
        [solution.model.predict(solution.mean, *pixels, epoch=epoch, chip=c) for c in (1, 2)]
    )
    plane = gnomonic(np.concatenate([ours[1], ours[2]]), ours[2].mean(axis=0))
    a, b = uv - uv.mean(axis=0), plane - plane.mean(axis=0)
    left, _, right = np.linalg.svd(b.T @ a)
    turn = left @ right  # the orthogonal matrix that brings (u, v) nearest to (xi, eta)
    residual = np.hypot(*(b - a @ turn.T).T) * 1e3
    # the tangent points of the two differ: quadratic terms of 1e-7 arcsec^-1 over 100 arcsec remain
    assert residual.max() < 0.1
    assert np.linalg.det(turn) == pytest.approx(-1.0)  # the sky is seen from inside
