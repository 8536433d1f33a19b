"""`bayesdist compare`: two calibrations from files of any kind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from bayesdist.app.calibrations import calibration_at
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.table import write_idctab
from bayesdist.infer import LinearFit, fit_linear, save_fit
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.simulate import simulate_matches
from tests.app.support import cli, good, one_sentence, refused

SIZE = (512, 256)


def sip_header(path: Path, a: dict, b: dict, *, turn: float = 0.0, parity: int = -1) -> Path:
    """A header of SIZE with 0.05 arcsec pixels, turned, and mirrored where parity is +1."""
    header = fits.Header()
    header["CTYPE1"], header["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
    header["CRPIX1"], header["CRPIX2"] = 250.0, 130.0
    header["CRVAL1"], header["CRVAL2"] = 40.0, -30.0
    c, s = np.cos(turn) * 0.05 / 3600, np.sin(turn) * 0.05 / 3600
    header["CD1_1"], header["CD1_2"] = parity * c, -s
    header["CD2_1"], header["CD2_2"] = parity * s, c
    header["A_ORDER"], header["B_ORDER"] = 3, 3
    for prefix, terms in (("A", a), ("B", b)):
        for (p, q), value in terms.items():
            header[f"{prefix}_{p}_{q}"] = value
    header["IMAGEW"], header["IMAGEH"] = SIZE
    header.totextfile(path, endcard=True)
    return path


A = {(2, 0): 2e-5, (1, 1): -1e-5, (3, 0): 3e-9}
B = {(0, 2): 1.5e-5, (2, 1): -4e-9}


def test_sip_headers_against_astropy(tmp_path) -> None:
    """Positions on the sky by astropy.wcs, a similarity by least squares, and nothing of ours."""
    first = sip_header(tmp_path / "a.hdr", A, B)
    second = sip_header(tmp_path / "b.hdr", A | {(2, 0): 2.4e-5}, B, turn=0.7, parity=1)
    good("compare", first, second, "-o", tmp_path / "out", "--grid", 5, 4)
    x = np.linspace(0.5, SIZE[0] + 0.5, 257)[:-1] + 1
    y = np.linspace(0.5, SIZE[1] + 0.5, 129)[:-1] + 1
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    table = Table.read(tmp_path / "out" / "difference.ecsv")
    places = np.stack([table["x"], table["y"]], axis=1)

    def plane(path: Path, pixels: np.ndarray) -> np.ndarray:
        sky = WCS(fits.Header.fromtextfile(path)).all_pix2world(pixels, 1)
        ra, dec = np.radians(sky[:, 0] - 40.0), np.radians(sky[:, 1])
        sin0, cos0 = np.sin(np.radians(-30.0)), np.cos(np.radians(-30.0))
        down = sin0 * np.sin(dec) + cos0 * np.cos(dec) * np.cos(ra)
        xi = np.cos(dec) * np.sin(ra) / down
        eta = (cos0 * np.sin(dec) - sin0 * np.cos(dec) * np.cos(ra)) / down
        return (xi + 1j * eta) * np.degrees(3600.0)

    wa, wb = plane(first, grid), plane(second, grid).conj()  # mirrored
    design = np.stack([np.ones_like(wb), wb], axis=1)
    turn = np.linalg.lstsq(design, wa)[0]
    rest = plane(first, places) - turn[0] - turn[1] * plane(second, places).conj()
    d = np.linalg.solve(0.05 * np.diag([-1.0, 1.0]), np.stack([rest.real, rest.imag]))
    assert np.abs(d).max() > 0.02
    np.testing.assert_allclose(table["du"], d[0], atol=2e-5)
    np.testing.assert_allclose(table["dv"], d[1], atol=2e-5)
    summary = json.loads((tmp_path / "out" / "comparison.json").read_text())["chips"][0]
    assert summary["linear"]["mirrored"] is True
    assert summary["linear"]["rotation_rad"] == pytest.approx(np.angle(turn[1]), abs=1e-8)
    assert summary["chi2"] is None and summary["significance_of"] == "none"


def test_the_sky_of_two_headers_is_compared_as_astropy_has_it(tmp_path) -> None:
    """The same distortion at another CRVAL: 0.02 degrees apart, and no agreement."""
    first = sip_header(tmp_path / "a.hdr", A, B)
    header = fits.Header.fromtextfile(first)
    header["CRVAL2"] += 0.02
    header.totextfile(tmp_path / "b.hdr", endcard=True)
    out = good("compare", first, tmp_path / "b.hdr", "-o", tmp_path / "out").out
    x, y = np.meshgrid(np.linspace(0.5, SIZE[0] + 0.5, 65), np.linspace(0.5, SIZE[1] + 0.5, 65))
    a = WCS(fits.Header.fromtextfile(first)).all_pix2world(x, y, 1)
    b = WCS(header).all_pix2world(x, y, 1)
    far = SkyCoord(*a, unit="deg").separation(SkyCoord(*b, unit="deg")).arcsec
    [chip] = json.loads((tmp_path / "out" / "comparison.json").read_text())["chips"]
    assert chip["sky"]["largest_arcsec"] == pytest.approx(far.max(), rel=1e-4)
    assert chip["sky"]["largest_pix"] == pytest.approx(far.max() / 0.05, rel=0.01)
    assert "and not on the sky" in out.splitlines()[0]
    assert "on the sky A and B are 72 arcsec" in out.splitlines()[1]
    same = good("compare", first, first).out
    assert same.startswith("The calibrations agree to rounding.\non the sky A and B have the same")


def test_a_run_with_itself_and_with_its_own_products(finished, tmp_path) -> None:
    out = good("compare", finished.path, finished.path / "posterior.nc").out
    assert out.startswith("The calibrations agree to rounding.")
    assert "come from one source" in out
    good("compare", finished.path, finished.path / "sip.hdr", "-o", tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "comparison.ecsv", "comparison.json", "difference.ecsv", "figures"
    ]  # fmt: skip
    assert (tmp_path / "out" / "figures" / "difference.png").stat().st_size > 10_000
    chip = json.loads((tmp_path / "out" / "comparison.json").read_text())["chips"][0]
    # the header has the posterior's mean, but for its cards' digits
    assert chip["largest"] < 1e-6
    assert chip["a"]["errors"] == chip["b"]["errors"] == "covariance"
    alone = tmp_path / "sip.hdr"  # without its parameters: angles, where the run has pixels
    alone.write_bytes((finished.path / "sip.hdr").read_bytes())
    assert "no difference can be told" in good("compare", finished.path, alone).out


def test_fit_and_posterior_agree_within_their_errors(finished) -> None:
    result = good("compare", finished.path, finished.path / "fit.nc", "--keep-linear")
    assert result.out.startswith("No significant difference")
    assert "kept in the difference" in result.out


@pytest.fixture(scope="module")
def solution() -> LinearFit:
    """Two chips of ACS/WFC that drift, in pixels of 0.05 arcsec."""
    chips = tuple(Chip(k, f"WFC{k}", (512.0, 256.0), (256.0, 128.0)) for k in (1, 2))
    time = TimeDependence((("u", 1, 0), ("v", 1, 0), ("v", 0, 1)), (2010.0,))
    model = DistortionModel(3, chips, "arcsec", time)
    rng = np.random.default_rng(4)
    theta = np.zeros(model.n_params)
    for chip in chips:
        basis = model.basis(chip.number)
        for axis, first in enumerate(((1, 0), (0, 1))):
            c = np.zeros(model.n_terms)
            c[basis.terms.index(first)] = 0.05
            legendre = basis.from_monomials(c)
            legendre[3:] += 0.03 * rng.standard_normal(7)
            legendre[0] += 13.0 * (chip.number - 1) * axis
            theta[model.coefficient_slice(chip.number, axis)] = legendre
        theta[model.tdd_slice(chip.number)] = 1e-3 * rng.standard_normal(3)
    exposures = tuple(f"e{k}" for k in range(8))
    many = replace(model, exposures=exposures)
    matches, _ = simulate_matches(
        many, theta, 4000, rng=rng, sigma=1e-3, fraction=0.0, epochs=np.linspace(2004, 2016, 8)
    )
    return fit_linear(matches, many)


def without_drift(fit: LinearFit) -> LinearFit:
    """The polynomials of a fit at their reference date."""
    n = fit.model.n_polynomial
    model = replace(fit.model, time=None)
    return replace(fit, model=model, mean=fit.mean[:n], cov=fit.cov[:n, :n])


def test_an_idctab_has_the_covariance_of_what_it_was_made_from(solution, tmp_path) -> None:
    """At a date far from the reference date: V3 is mirrored, nothing else is lost."""
    tab = idctab_from_solution(solution, instrument="ACS", detector="WFC", scale_arcsec=0.05)
    write_idctab(tab, tmp_path / "x_idc.fits")
    save_fit(solution, tmp_path / "fit.nc")
    one = calibration_at(tmp_path / "x_idc.fits").by_chip(2016.0)
    other = calibration_at(tmp_path / "fit.nc").by_chip(2016.0)
    assert set(one) == set(other) == {1, 2}
    for chip in (1, 2):
        a, b = one[chip], other[chip]
        assert a.basis == b.basis and a.errors == b.errors == "covariance"
        np.testing.assert_allclose(a.coefficients[:, 1:], b.coefficients[:, 1:], atol=1e-12)
        K = a.basis.n_terms
        # the constant of the monomials is V2REF, V3REF, and is not in the polynomial
        rows = np.r_[1:K, K + 1 : 2 * K]
        to_monomials = np.kron(np.eye(2), a.basis.monomial_matrix)
        of_a, of_b = (to_monomials @ c.cov @ to_monomials.T for c in (a, b))
        scale = np.sqrt(np.diag(of_b))[rows]
        np.testing.assert_allclose(
            of_a[np.ix_(rows, rows)] / np.outer(scale, scale),
            of_b[np.ix_(rows, rows)] / np.outer(scale, scale),
            atol=1e-7,
        )


def test_filters_of_one_table_have_their_own_covariance(solution, tmp_path) -> None:
    bare = without_drift(solution)
    wide = replace(bare, mean=bare.mean * (1 + 1e-6), cov=4 * bare.cov)
    tab = idctab_from_solution(
        {"F606W": bare, "F814W": wide}, instrument="ACS", detector="WFC", scale_arcsec=0.05
    )
    write_idctab(tab, tmp_path / "x_idc.fits")
    one, two = (
        calibration_at(tmp_path / "x_idc.fits", filter=f).by_chip() for f in ("F606W", "F814W")
    )
    for chip in (1, 2):
        assert one[chip].cov is not None and two[chip].cov is not None
        np.testing.assert_allclose(two[chip].cov, 4 * one[chip].cov, rtol=1e-9)
    out = good(
        "compare", *2 * [tmp_path / "x_idc.fits"], "--filter", "F606W:F814W", "--chip", 1
    ).out
    # a factor on all numbers is a scale, which is told and taken out
    assert out.startswith("The calibrations agree to rounding.") and "come from one source" in out
    assert "scale - 1   -1e-06 +-" in out


def test_a_header_without_size_takes_that_of_the_other(solution, tmp_path) -> None:
    sip = sip_header(tmp_path / "a.hdr", A, B)
    lines = [line for line in sip.read_text().splitlines() if not line.startswith("IMAGE")]
    (tmp_path / "b.hdr").write_text("\n".join(lines) + "\n")
    refused(
        tmp_path,
        "compare",
        tmp_path / "b.hdr",
        tmp_path / "b.hdr",
        words=["does not state the size"],
    )
    out = good("compare", tmp_path / "b.hdr", sip).out
    assert out.startswith("The calibrations agree to rounding.")


def test_chips_filters_and_dates_are_asked_for(solution, tmp_path, data_dir) -> None:
    save_fit(solution, tmp_path / "fit.nc")
    acs = data_dir / "hst_reference" / "0461802ej_idc.fits"
    old = data_dir / "hst_reference" / "qbu1641sj_idc.fits"
    sip = sip_header(tmp_path / "a.hdr", A, B)
    refused(tmp_path, "compare", tmp_path / "fit.nc", sip, words=["depends on time", "--epoch"])
    refused(tmp_path, "compare", tmp_path / "fit.nc", sip, "--epoch", 2010, words=["--chip"])
    good("compare", tmp_path / "fit.nc", sip, "--epoch", 2010, "--chip", 2)
    refused(tmp_path, "compare", acs, old, words=["name the filter"])
    refused(tmp_path, "compare", acs, acs, "--filter", "F999W", words=["F999W"])
    refused(tmp_path, "compare", acs, old, "--filter", "F606W", "--epoch", 2010, words=["scheme"])
    both = good("compare", acs, acs, "--filter", "F606W:F814W").out
    assert both.count("by itself:") == 2 and "in arcsec, chip 2" in both
    refused(tmp_path, "compare", acs, sip, "--filter", "F606W", "--chip", 2, words=["512 x 256"])
    refused(tmp_path, "compare", acs, sip, "--filter", "F606W", "--chip", 3, words=["no chip 3"])


def test_what_is_no_calibration_is_refused(finished, tmp_path) -> None:
    (tmp_path / "text").write_text("nothing\n")
    folder = tmp_path / "in"
    folder.mkdir()
    run = finished.path
    refused(tmp_path, "compare", run, tmp_path / "text", words=["an unknown format"])
    refused(tmp_path, "compare", run, tmp_path / "none.fits", words=["no such file"])
    refused(tmp_path, "compare", run, folder, words=["in"])
    refused(tmp_path, "compare", run, run, "--grid", 1, 1, words=["grid"])
    (folder / "mine").write_text("x")
    refused(tmp_path, "compare", run, run, "-o", folder, words=["other files"])
    alone = folder / "sip.hdr"  # without the file of its parameters it is in arcseconds
    alone.write_bytes((run / "sip.hdr").read_bytes())
    result = cli("compare", run, alone, "--keep-linear")
    assert result.code == 1
    one_sentence(result.err, "--keep-linear")


def test_wise_bands(tmp_path) -> None:
    lines = []
    for band, quadratic in ((1, 1e-6), (2, 3e-6)):
        for key, value in (("A_ORDER", 2), ("B_ORDER", 2), ("A_2_0", quadratic), ("B_0_2", 2e-6)):
            kind = "i" if isinstance(value, int) else "r"
            lines.append(f"cal:gnd:distort_{key.lower()} {band} {key} {kind} {value} text")
    path = tmp_path / "meta.tbl"
    path.write_text("\n".join(lines) + "\n")
    refused(tmp_path, "compare", path, path, words=["W1, W2", "--filter"])
    good("compare", path, path, "--filter", "W1:W2", "-o", tmp_path / "out")
    rows = Table.read(tmp_path / "out" / "comparison.ecsv")
    row = rows[(rows["form"] == "monomial") & (rows["axis"] == "u") & (rows["i"] == 2)][0]
    assert row["difference"] == pytest.approx(-2e-6, rel=1e-2)
