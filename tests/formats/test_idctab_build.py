"""IDCTABs from solutions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from numpy.testing import assert_allclose

from bayesdist.errors import DegenerateError, InputError
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.lint import lint_idctab
from bayesdist.formats.idctab.table import read_idctab, write_idctab
from bayesdist.model import DistortionModel, TimeDependence

from .support import F606W, StandIn, random_pixels, some_covariance, some_solution, wfc_solution

ACS = {"instrument": "ACS", "detector": "WFC"}
UVIS = {"instrument": "WFC3", "detector": "UVIS"}


def test_real_coefficients_survive_the_model(real, tmp_path: Path) -> None:
    solution = wfc_solution(real)
    record = real.rows[real.row(2, F606W)]
    made = idctab_from_solution(
        solution, **ACS, scale_arcsec=0.05, filters=F606W,
        v2ref=float(record["V2REF"]), v3ref=float(record["V3REF"]),
    )  # fmt: skip
    write_idctab(made, tmp_path / "a_idc.fits")
    back = read_idctab(tmp_path / "a_idc.fits")
    for chip in (1, 2):
        for ours, theirs in zip(
            back.coefficients(chip, F606W), real.coefficients(chip, F606W), strict=True
        ):
            assert_allclose(ours[1:], theirs[1:], rtol=1e-13, atol=0)
        for name in ("V2REF", "V3REF", "XREF", "YREF", "XSIZE", "YSIZE", "SCALE", "DETCHIP"):
            a, b = (t.rows[name][t.row(chip, F606W)] for t in (back, real))
            assert float(a) == pytest.approx(float(b), rel=1e-13)
    assert set(back.tdd) == set(real.tdd)
    for name, value in real.tdd.items():
        assert back.tdd[name] == pytest.approx(value, rel=1e-14)
    assert all(back.rows.dtype[n] == "f8" for n in back.columns if n[:2] in ("CX", "CY"))


@pytest.mark.parametrize("epoch", [2004.5, 2015.25])
def test_table_is_the_model_at_every_epoch(real, epoch: float) -> None:
    factor = 1.00002
    solution = wfc_solution(real, vafactor=factor)
    made = idctab_from_solution(solution, **ACS, vafactor=factor)
    x, y = random_pixels((4096, 2048))
    for chip in (1, 2):
        uv = solution.model.predict(solution.mean, x, y, epoch=epoch, chip=chip) / factor
        record = made.rows[made.row(chip)]
        # V2 = V2REF + Xc, V3 = V3REF - Yc for this detector
        Xc, Yc = made.evaluate(chip, x, y, epoch=epoch)
        assert_allclose(Xc + record["V2REF"], uv[:, 0], atol=1e-11, rtol=0)
        assert_allclose(Yc - record["V3REF"], uv[:, 1], atol=1e-11, rtol=0)


def test_parity_of_uvis() -> None:
    solution = some_solution(3, unit="mas", pixel=40.0, offset=(5e3, -7e3))
    made = idctab_from_solution(solution, **UVIS, v2ref=100.0, v3ref=200.0)
    record = made.rows[0]
    constant = solution.model.predict(solution.mean, 610.3, 444.7)[0] / 1e3
    # V2 = V2REF - Xc, V3 = V3REF + Yc
    assert record["V2REF"] == pytest.approx(100.0 - constant[0], abs=1e-11)
    assert record["V3REF"] == pytest.approx(200.0 + constant[1], abs=1e-11)
    assert made.header["BDU0_1"] == pytest.approx(constant[0], abs=1e-11)
    assert made.header["PARITY"] == -1
    assert made.tdd == {}
    x, y = random_pixels((1200, 900), 500)
    uv = solution.model.predict(solution.mean, x, y) / 1e3
    assert_allclose(np.stack(made.evaluate(1, x, y)).T + constant, uv, atol=1e-11, rtol=0)


def test_pixels_are_scaled() -> None:
    solution = some_solution(2)
    made = idctab_from_solution(solution, **UVIS, scale_arcsec=0.04)
    x, y = random_pixels((1200, 900), 100)
    uv = 0.04 * solution.model.predict(solution.mean, x, y)
    zero = 0.04 * solution.model.predict(solution.mean, 610.3, 444.7)
    assert_allclose(np.stack(made.evaluate(1, x, y)).T, uv - zero, atol=1e-12, rtol=0)
    assert made.rows["SCALE"][0] == 0.04
    with pytest.raises(InputError, match="give the pixel scale"):
        idctab_from_solution(solution, **UVIS)


def test_scale_is_the_mean_one_where_none_is_given() -> None:
    solution = some_solution(3, unit="arcsec", pixel=0.0395, strength=0.0)
    made = idctab_from_solution(solution, **UVIS)
    assert made.rows["SCALE"][0] == pytest.approx(0.0395, abs=1e-8)


def test_linear_term_of_exactly_one_is_not_taken_for_a_unit() -> None:
    # identity in arcseconds, SCALE 0.5: stwcs would halve a table with CX11 == 1
    solution = some_solution(1, unit="arcsec", pixel=1.0, strength=0.0)
    made = idctab_from_solution(solution, **UVIS, scale_arcsec=0.5)
    Xc, Yc = made.evaluate(1, 710.3, 544.7)
    assert (Xc, Yc) == (pytest.approx(100.0, rel=1e-12), pytest.approx(100.0, rel=1e-12))


# -- uncertainty ---------------------------------------------------------------------------------


def with_time(terms, breaks=(), sigma: float = 1.0) -> StandIn:
    """Two chips with drifting terms, in arcseconds."""
    base = some_solution(3, unit="arcsec", pixel=0.05)
    chips = tuple(replace(base.model.chips[0], number=n, name=f"WFC{n}") for n in (1, 2))
    time = TimeDependence(terms, (2004.5,), breaks)
    model = DistortionModel(3, chips, "arcsec", time)
    theta = np.zeros(model.n_params)
    theta[: model.n_polynomial] = np.tile(base.mean, 2)
    rng = np.random.default_rng(8)
    theta[model.n_polynomial :] = rng.normal(size=theta.size - model.n_polynomial)
    return StandIn(model, theta, some_covariance(theta.size, sigma, rng))


def test_covariance_is_that_of_the_numbers_in_the_file() -> None:
    """Every number is linear in the parameters: steps of all give the covariance exactly."""
    terms = (("u", 1, 0), ("v", 1, 0), ("v", 0, 1))
    given = with_time(terms)
    steps = np.random.default_rng(9).normal(size=(8, given.mean.size))
    solution = replace(given, cov=steps.T @ steps)

    def built(mean):
        moved = replace(solution, mean=mean)
        return idctab_from_solution(moved, **ACS, scale_arcsec=0.05, vafactor=1.00003)

    made = built(given.mean)
    stated = made.covariance
    moves = [built(given.mean + step).covariance["VALUE"] - stated["VALUE"] for step in steps]
    expected = np.transpose(moves) @ moves
    sd = np.sqrt(np.diag(expected))
    assert_allclose(stated["COV"] / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-7)
    columns = {n for n in stated["PARAM"] if not n.startswith("TDD")}
    assert columns == {n for n in made.columns if n[:2] in ("CX", "CY", "V2", "V3")}
    header = next(b for b in made.hdus if b.name == "SIGMA").header
    for chip, name, value, s in zip(
        stated["DETCHIP"], stated["PARAM"], stated["VALUE"], sd, strict=True
    ):
        if name.startswith("TDD"):
            assert (made.tdd[name], header[name]) == (value, pytest.approx(s, rel=1e-7))
        else:
            [row] = np.flatnonzero(made.rows["DETCHIP"] == chip)
            assert made.rows[name][row] == value
            assert made.sigma[name][row] == pytest.approx(s, rel=1e-7)


def test_position_error_from_the_covariance_is_that_of_the_model(real) -> None:
    """Sigma of Xc - Xc(reference) by the table's COVAR and by the model's Jacobian."""
    solution = wfc_solution(real, drift=False)
    made = idctab_from_solution(solution, **ACS)
    cov = made.covariance
    pick = (cov["DETCHIP"] == 1) & np.isin(np.char.ljust(cov["PARAM"], 2).astype("U2"), ["CX"])
    names = cov["PARAM"][pick]
    x, y = random_pixels((4096, 2048), 200)
    dx, dy = x - 2048.0, y - 1024.0
    powers = [(int(n[3]), int(n[2]) - int(n[3])) for n in names]  # CXnj: x^j y^(n-j)
    phi = np.stack([dx**i * dy**j for i, j in powers], axis=1)
    by_table = np.einsum("nk,kl,nl->n", phi, cov["COV"][np.ix_(pick, pick)], phi)
    jac = solution.model.jacobian(solution.mean, x, y, chip=1)[:, 0]
    jac = jac - solution.model.jacobian(solution.mean, 2048.0, 1024.0, chip=1)[:, 0]
    by_model = np.einsum("nd,de,ne->n", jac, solution.cov, jac)
    assert_allclose(by_table, by_model, rtol=1e-7)


def test_others_can_read_the_file(real, tmp_path: Path) -> None:
    path = tmp_path / "a_idc.fits"
    write_idctab(idctab_from_solution(wfc_solution(real), **ACS, filters=F606W), path)
    with fits.open(path) as hdus:
        hdus.verify("exception")
        assert [h.name for h in hdus] == ["PRIMARY", "", "SIGMA", "COVAR"]
        assert list(hdus[1].data["FILTER1"]) == ["F606W", "F606W"]
    table = Table.read(path, hdu="COVAR")
    assert table["COV"].shape == (len(table), len(table))


# -- filters and time ----------------------------------------------------------------------------


def test_rows_for_several_filters(real) -> None:
    filters = (F606W, ("CLEAR1L", "F814W"))
    made = idctab_from_solution(wfc_solution(real), **ACS, filters=filters)
    assert len(made.rows) == 4
    for chip in (1, 2):
        a, b = (made.coefficients(chip, f) for f in ("F606W", "F814W"))
        assert np.array_equal(a, b)
    one = idctab_from_solution(
        some_solution(2), **UVIS, scale_arcsec=0.04, filters=(("F606W",), ("F814W",))
    )
    assert [str(f) for f in one.rows["FILTER"]] == ["F606W", "F814W"]
    with pytest.raises(InputError, match="give 2 for ACS"):
        idctab_from_solution(wfc_solution(real), **ACS, filters=("F606W",))
    with pytest.raises(InputError, match="occurs twice"):
        idctab_from_solution(wfc_solution(real), **ACS, filters=(F606W, F606W))


def test_one_solution_for_several_filters_is_told_in_two_ways() -> None:
    """Names beside a solution, or each name with that solution: the same rows, the same file."""
    solution = some_solution(2, unit="arcsec")
    beside = idctab_from_solution(solution, **UVIS, filters=(("F606W",), ("F814W",)))
    each = idctab_from_solution({"F606W": solution, "F814W": solution}, **UVIS)
    assert [b.to_bytes() for b in beside.hdus] == [b.to_bytes() for b in each.hdus]


@pytest.mark.parametrize(
    "terms", [(("u", 0, 1),), (("v", 2, 0),), (("u", 0, 0),), (("u", 1, 0), ("v", 1, 1))]
)
def test_time_dependence_that_cannot_be_stored_is_refused(terms) -> None:
    with pytest.raises(InputError, match="cannot store the time-dependent term"):
        idctab_from_solution(with_time(terms), **ACS)


def test_breaks_and_other_detectors_are_refused() -> None:
    terms = (("u", 1, 0), ("v", 1, 0), ("v", 0, 1))
    with pytest.raises(InputError, match="there are 2 segments"):
        idctab_from_solution(with_time(terms, (2009.4,)), **ACS)
    with pytest.raises(InputError, match="for ACS/WFC only"):
        idctab_from_solution(with_time(terms), **UVIS)
    made = idctab_from_solution(with_time(terms), **ACS)
    assert {f"TDD_{n}{c}" for n in ("CXB", "CTB", "CYB") for c in (1, 2)} < set(made.tdd)


def test_no_time_dependence_is_said_in_so_many_words(real) -> None:
    made = idctab_from_solution(wfc_solution(real, drift=False), **ACS)
    assert made.tdd_scheme == "2015"  # and not stwcs's default of 2004.5
    assert (made.tdd["TDD_CTB1"], made.tdd["TDD_CTB2"]) == (0.0, 0.0)
    x, y = random_pixels((4096, 2048), 10)
    assert np.array_equal(made.evaluate(1, x, y, epoch=2030.0), made.evaluate(1, x, y))


def test_one_chip_alone_is_enough_for_the_scheme(real) -> None:
    made = idctab_from_solution(wfc_solution(real), **ACS, chips=(2,))
    assert list(made.rows["DETCHIP"]) == [2]
    assert made.tdd_scheme == "2015"
    assert made.tdd["TDD_CTB2"] == pytest.approx(1.7872250212e-06, rel=1e-12)
    assert "TDD_CXB1" not in made.tdd


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"instrument": "WISE", "detector": "W1"}, "parity of WISE/W1 is not known"),
        ({"vafactor": 0.0}, "vafactor is 0.0"),
        ({"scale_arcsec": -1.0}, "positive"),
        ({"chips": (7,)}, "no chip 7"),
        ({"chips": ()}, "no chip is given"),
    ],
)
def test_wrong_arguments_are_refused(names: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        idctab_from_solution(some_solution(2, unit="arcsec"), **{**UVIS, **names})


def test_a_singular_linear_part_is_degenerate() -> None:
    solution = some_solution(2, unit="arcsec")
    theta = solution.mean.copy()
    u, v = (solution.model.coefficient_slice(None, axis) for axis in (0, 1))
    theta[v] = 2 * theta[u]
    with pytest.raises(DegenerateError, match="singular"):
        idctab_from_solution(replace(solution, mean=theta), **UVIS)


def test_our_own_tables_are_clean(real) -> None:
    made = idctab_from_solution(
        wfc_solution(real), **ACS, scale_arcsec=0.05, filters=F606W,
        useafter="Mar 01 2002 00:00:00", pedigree="INFLIGHT 01/05/2006",
    )  # fmt: skip
    assert lint_idctab(made) == ()
