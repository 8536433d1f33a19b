"""WISE meta-data as written: the printed file comes back, and what is written is true of itself.

Source: WSDC D-T033, "WISE IOC Distortion Calibration", Appendices A and B.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import polynomial

from bayesdist.data import Matches
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.files import read_sip, sip_header, write_sip
from bayesdist.infer import fit_linear
from bayesdist.missions.wise.meta_data.format import lint_wise_band
from bayesdist.missions.wise.meta_data.meta import read_wise_meta, write_wise_meta
from bayesdist.missions.wise.published import WISE_COEFFICIENTS
from bayesdist.missions.wise.simulate import wise_set, wise_solution
from bayesdist.products import describe
from tests.app.support import cli, good, one_sentence, partly_run, summary_of, write_config
from tests.reduced import only_in_full

from ...formats.support import astropy_wcs, random_pixels, some_solution
from .test_sip_wise import PRINTED, meta_data

# as the appendix has them, from A to BP
ORDER = "0_0 0_1 1_0 0_2 0_3 0_4 1_1 1_2 1_3 2_0 2_1 2_2 3_0 3_1 4_0".split()
SIDE = {1: 1016, 2: 1016, 3: 1016, 4: 508}


def entries(path) -> list[tuple[str, ...]]:
    """Name, band, keyword, type and value of every line that is no comment."""
    lines = path.read_text().splitlines()
    return [tuple(line.split()[:5]) for line in lines if not line.startswith("\\")]


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """Headers as printed, with the one wrong number of W1 put right."""
    path = tmp_path_factory.mktemp("printed") / "wise.meta"
    path.write_text(meta_data())
    bands = {one.band: one.sip for one in read_wise_meta(path)}
    b_0_2 = WISE_COEFFICIENTS["W1"][1][5]
    return bands | {1: replace(bands[1], b={**bands[1].b, (0, 2): b_0_2})}


@pytest.fixture(scope="module")
def fitted():
    """Calibrations of small sets, with their errors."""
    out = {}
    for band in (1, 4):
        one = wise_set(f"W{band}", pairs=20_000, seed=5)
        c = one.chunk(0)
        fit = fit_linear(Matches(c.x, c.y, c.u, c.v, c.sigma, c.sigma), one.model)
        out[band] = sip_from_solution(fit, linear="sip", inverse_order=4, scale_arcsec=2.75)
    return out


# -- against the printed file ---------------------------------------------------------------------


def test_the_printed_file_is_written_again(printed, tmp_path):
    """Names, bands, keywords, types and all digits, the maxima among them, which are computed."""
    path = tmp_path / "again.meta"
    write_wise_meta(path, printed)
    expected = []
    for band, (maxima, table) in PRINTED.items():
        rows = {k: v for k, *v in (line.split() for line in table.strip().splitlines())}
        some = [("SKEW", "r", "0.000000E+00")]
        for column, family in enumerate(("A", "B", "AP", "BP")):
            some.append((f"{family}_ORDER", "i", "4"))
            some += [(f"{family}_{k}", "r", rows[k][column]) for k in ORDER]
            some += [(f"{family}_DMAX", "r", maxima[column])] if column < 2 else []
        expected += [
            (f"cal:gnd:distort_{key.lower()}", str(band), key, kind, value)
            for key, kind, value in some
        ]
    found = entries(path)
    assert len(found) == len(expected) == 4 * 67
    # the number printed twice, and the one with a digit too many
    assert [(a[1:3], b[4], a[4]) for a, b in zip(found, expected, strict=True) if a != b] == [
        (("1", "B_0_2"), "-3.541684E-06", "1.165700E-06"),
        (("3", "A_1_0"), "-4.8377784E-04", "-4.837778E-04"),
    ]


def test_comments_name_the_monomial_of_the_keyword(printed, tmp_path):
    path = tmp_path / "w.meta"
    write_wise_meta(path, printed)
    checked = 0
    for line in path.read_text().splitlines():
        said = re.search(r" ([AB]P?)_(\d)_(\d) .*coefficient of (\S+)", line)
        if said:
            prefix, p, q, name = said.groups()
            assert name.isupper() == prefix.endswith("P")
            powers = {"u": 0, "v": 0}
            for part in name.lower().split("."):
                powers[part[0]] += int(part[1:] or 1)
            assert (powers["u"], powers["v"]) == (int(p), int(q)), line
            checked += 1
    assert checked == 4 * 60


# -- what was written and what is read ------------------------------------------------------------


@pytest.mark.parametrize("source", ["printed", "fitted"])
def test_reading_loses_nothing_that_was_written(source, tmp_path, request):
    headers = request.getfixturevalue(source)
    path = tmp_path / "w.meta"
    write_wise_meta(path, headers, skew={4: 1.25e-4})
    back = read_wise_meta(path)
    for one in back:
        sip, given = one.sip, headers[one.band]
        for family in ("a", "b", "ap", "bp"):
            for k, value in getattr(given, family).items():
                # seven digits
                assert getattr(sip, family)[k] == pytest.approx(value, rel=5e-7, abs=1e-300)
        for family in ("sigma_a", "sigma_b"):
            assert getattr(sip, family) == pytest.approx(getattr(given, family), rel=5e-4)
        assert one.skew == (1.25e-4 if one.band == 4 else 0.0)
    again = tmp_path / "again.meta"
    write_wise_meta(again, {one.band: one.sip for one in back}, skew={4: back[-1].skew})
    assert again.read_text() == path.read_text()


def test_other_readers_see_only_the_entries_of_the_appendix(fitted, tmp_path):
    """Standard deviations stand in lines that begin with a backslash."""
    path = tmp_path / "w.meta"
    write_wise_meta(path, fitted)
    assert len(entries(path)) == 2 * 67
    assert path.read_text().count(" AE_") == 2 * 15
    assert "sigma of B_2_1" in path.read_text()


@pytest.mark.parametrize("source", ["printed", "fitted"])
def test_inspect_finds_nothing_wrong(source, tmp_path, request):
    path = tmp_path / "w.meta"
    write_wise_meta(path, request.getfixturevalue(source))
    for one in read_wise_meta(path):
        findings = lint_wise_band(one)
        assert {f.level for f in findings} == {"note"}
        said = " ".join(f.message for f in findings if "constant or linear" not in f.message)
        # the maxima of W4 are to the edges, as in the appendix; else nothing is remarked
        assert len(findings) == (3 if one.band == 4 else 1)
        assert said.count("to the edges") == (2 if one.band == 4 else 0)
    assert "error" not in describe(path) and "warning" not in describe(path)


def values(terms, u, v):
    c = np.zeros((5, 5))
    for k, value in terms.items():
        c[k] = value
    return polynomial.polyval2d(u, v, c)


@pytest.mark.parametrize("band", [1, 4])
def test_maxima_and_closure_are_those_of_the_numbers_written(fitted, tmp_path, band):
    """Over all pixel centres, and in W4 the maxima over the edges: without our own search."""
    path = tmp_path / "w.meta"
    write_wise_meta(path, fitted)
    one = next(b for b in read_wise_meta(path) if b.band == band)
    g = np.arange(SIDE[band]) - (SIDE[band] - 1) / 2
    u, v = (w.ravel() for w in np.meshgrid(g, g))
    da, db = values(one.sip.a, u, v), values(one.sip.b, u, v)
    U, V = u + da, v + db
    left = np.hypot(U + values(one.sip.ap, U, V) - u, V + values(one.sip.bp, U, V) - v)
    assert one.sip.closure == pytest.approx(left.max(), rel=0.01)
    reach = SIDE[band] / 2 - (0.0 if band == 4 else 0.5)
    fine = np.linspace(-reach, reach, 1017)
    wide = [w.ravel() for w in np.meshgrid(fine, fine)]
    for stated, terms in ((one.printed["A_DMAX"], one.sip.a), (one.printed["B_DMAX"], one.sip.b)):
        assert stated == f"{np.abs(values(terms, *wide)).max():.3f}"


# -- what cannot be written -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": (1016, 1014)}, "W1: the image size is 1016 x 1014 and CRPIX 508.5, 508.5"),
        ({"size": None}, "W1: the image size is unknown"),
        ({"crpix": (508.0, 508.5)}, r"CRPIX 508, 508\.5, but the array of this band has 1016"),
        ({"inverse_order": None, "ap": {}, "bp": {}}, "W1: the header has no AP and BP"),
        ({"cd": np.array([[1.0, 1e-4], [0.0, 1.0]])}, "CD matrix is more than a scale"),
        ({"cd": np.diag([1.0, 1.0001])}, "CD matrix is more than a scale"),
        ({"cd": np.zeros((2, 2))}, "CD matrix is more than a scale"),
        ({"order": (4, 1)}, "W1, keyword B_ORDER: is 1; choose an order from 2 to 9"),
        ({"a": {(2, 0): np.nan}}, "W1: a number is not finite"),
        ({"sigma_b": {(2, 0): np.inf}}, "W1: a number is not finite"),
    ],
)
def test_what_the_layout_cannot_hold_is_refused(printed, tmp_path, change, message):
    path = tmp_path / "w.meta"
    path.write_text("an earlier file")
    with pytest.raises(InputError, match=message):
        write_wise_meta(path, {**printed, 1: replace(printed[1], **change)})
    assert [p.name for p in tmp_path.iterdir()] == ["w.meta"]
    assert path.read_text() == "an earlier file"


@pytest.mark.parametrize(
    ("band", "message"),
    [("1,5", "is not band, keyword, type, value of an error"), ("3", "errors are of band 3")],
)
def test_errors_that_cannot_be_read_are_not_passed_over(fitted, tmp_path, band, message):
    """They stand in comment lines, of which others are passed over."""
    path = tmp_path / "w.meta"
    write_wise_meta(path, fitted)
    whole = path.read_text()
    damaged = re.sub(r"(?m)^\\ \d+ (?= *AE_2_0 )", rf"\\ {band} ", whole)
    assert damaged != whole
    path.write_text(damaged)
    with pytest.raises(FormatError, match=message):
        read_wise_meta(path)


def test_bands_there_are_four_of(printed, tmp_path):
    with pytest.raises(InputError, match="band 5 is none of 1 to 4"):
        write_wise_meta(tmp_path / "w.meta", {5: printed[1]})
    with pytest.raises(InputError, match="no band to write"):
        write_wise_meta(tmp_path / "w.meta", {})
    with pytest.raises(InputError, match="W4: the image size is 1016 x 1016"):
        write_wise_meta(tmp_path / "w.meta", {4: printed[1]})
    # linear terms in CD: A and B alone would be another distortion
    header = sip_from_solution(some_solution(4, size=(508.0, 508.0), reference_pixel=(254.5,) * 2))
    with pytest.raises(InputError, match="CD matrix is more"):
        write_wise_meta(tmp_path / "w.meta", {4: header})


# -- of a run -------------------------------------------------------------------------------------

W4 = {
    "data": {"matches": "stars.ecsv"},
    "detector": {"name": "W4", "size": (508, 508), "scale_mas": 5500.0},
    "model": {"order": 4},
    "products": {"wise_meta": {}},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    good("simulate", "wise", "--stars", 1500, "--band", "W4", "-o", folder)
    config = write_config(folder / "wise.toml", **W4)
    return partly_run(folder / "run", config, "fit", "sample", "assess", "export")


@pytest.mark.slow
@only_in_full("tests/missions/wise/test_demo_files writes each format")
def test_a_run_writes_its_band(run):
    [product] = summary_of(run)["products"]
    assert (product["path"], product["kind"]) == ("w4.meta", "WISE meta-data")
    assert not [f for f in product["findings"] if not f.startswith("note")]
    [one] = read_wise_meta(run / "w4.meta")
    assert one.band == 4 and one.sip.inverse_order == (4, 4)
    assert product["closure_pix"] == one.sip.closure < 0.01
    # the truth within what the file says of its errors: 30 coefficients, 5 sigma
    truth = WISE_COEFFICIENTS["W4"]
    terms = wise_solution("W4")[0].basis().terms
    for found, sigma, true in zip(
        (one.sip.a, one.sip.b), (one.sip.sigma_a, one.sip.sigma_b), truth, strict=True
    ):
        pulls = [(found[k] - c) / sigma[k] for k, c in zip(terms, true, strict=True)]
        assert np.abs(pulls).max() < 5


@pytest.mark.parametrize(
    ("section", "value", "words"),
    [
        ("detector", {"name": "WFC1", "size": (508, 508)}, ["W1, W2, W3 or W4", "'WFC1'"]),
        ("detector", {"name": "W4", "size": (1016, 1016)}, ["W4, 508 x 508", "detector.size"]),
        ("model", {"order": 4, "reference_pixel": (250.0, 254.5)}, ["about 254.5, 254.5"]),
    ],
)
def test_other_detectors_are_refused(tmp_path, section, value, words):
    config = write_config(tmp_path / "c.toml", **(W4 | {section: value}))
    result = cli("check", config)
    assert result.code == 1
    one_sentence(result.err, "products.wise_meta", *words)


# -- rotated --------------------------------------------------------------------------------------


def test_rotated_meta_data_are_those_of_appendix_a(printed, tmp_path):
    first = tmp_path / "0.meta"
    write_wise_meta(first, printed)
    said = good("wise", "rotate", first, "--angle", 90, "-o", tmp_path / "90.meta").out
    assert "W4: A_DMAX 0.582 px, B_DMAX 0.971 px" in said
    old = {(e[1], e[2]): e[4] for e in entries(first)}
    new = {(e[1], e[2]): e[4] for e in entries(tmp_path / "90.meta")}
    # three rows of the table, and the maxima
    for band in "1234":
        assert float(new[band, "A_0_2"]) == -float(old[band, "B_2_0"])
        assert new[band, "B_2_1"] == old[band, "A_1_2"]
        assert float(new[band, "AP_2_2"]) == -float(old[band, "BP_2_2"])
        assert new[band, "B_DMAX"] == old[band, "A_DMAX"]
    # round about
    path = tmp_path / "90.meta"
    for k, angle in enumerate((180, -270, 0)):
        good("wise", "rotate", path, "--angle", angle, "-o", tmp_path / f"turn{k}.meta")
        path = tmp_path / f"turn{k}.meta"
    assert path.read_text() == first.read_text()


def test_mirrored_twice_is_the_same(printed, tmp_path):
    first, second, third = (tmp_path / f"{k}.meta" for k in range(3))
    write_wise_meta(first, printed)
    good("wise", "rotate", first, "--mirror", "-o", second)
    assert second.read_text() != first.read_text()
    good("wise", "rotate", second, "--mirror", "-o", third)
    assert third.read_text() == first.read_text()


@pytest.mark.parametrize("name", ["out.hdr", "out.fits"])
def test_a_rotated_header_keeps_every_star_on_the_sky(tmp_path, name):
    header = sip_from_solution(
        some_solution(4, angle=0.3), scale_arcsec=0.1, crval=(30.0, -20.0), inverse_order=5
    )
    write_sip(header, tmp_path / "in.hdr")
    good("wise", "rotate", tmp_path / "in.hdr", "--angle", 90, "-o", tmp_path / name)
    x, y = random_pixels(header.size, 500)
    before = astropy_wcs(sip_header(header)).all_pix2world(x, y, 1)
    turned = read_sip(tmp_path / name)
    assert turned.size == header.size[::-1]
    # u' = -v, v' = u about the first pixel of the rotated image
    after = astropy_wcs(sip_header(turned)).all_pix2world(header.size[1] + 1 - y, x, 1)
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-12)


def test_what_cannot_be_rotated_is_refused(printed, tmp_path):
    path = tmp_path / "w.meta"
    write_wise_meta(path, printed, skew={2: 1e-3})
    (tmp_path / "text").write_text("nothing\n")
    for arguments, words in (
        ([path, "--angle", 45], ["45", "multiple of 90"]),
        ([path, "--angle", "nan"], ["nan", "multiple of 90"]),
        ([path, "--angle", 90], ["SKEW of band 2 is 0.001 rad"]),
        ([tmp_path / "text"], ["an unknown format"]),
        ([tmp_path / "nowhere"], ["nowhere"]),
    ):
        result = cli("wise", "rotate", *arguments, "-o", tmp_path / "out")
        assert result.code == 1
        one_sentence(result.err, *words)
        assert not (tmp_path / "out").exists()
    result = cli("wise", "rotate", path, "-o", path)
    assert result.code == 1
    one_sentence(result.err, "this file exists", "--force")
