"""Findings: what is wrong in real files, and what is made wrong here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from bayesdist.formats.idctab.lint import lint_idctab
from bayesdist.formats.idctab.table import IdcTab, read_idctab
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.header import SipHeader, worst_closure
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.products import describe
from bayesdist.products.common.cards import number_card
from bayesdist.products.common.content import Hdu

from .support import F606W, some_solution


def said(findings, level: str = "") -> str:
    return "\n".join(str(f) for f in findings if f.level.startswith(level))


# -- SIP -----------------------------------------------------------------------------------------


def good() -> SipHeader:
    return sip_from_solution(some_solution(4, flip=True, angle=0.4, strength=0.5), scale_arcsec=0.1)


def test_a_good_header_is_clean() -> None:
    (finding,) = lint_sip(good())
    assert finding.level == "note" and "errors of positions are not stated" in finding.message


@pytest.mark.parametrize(
    ("change", "level", "message"),
    [
        (lambda s: {"order": (1, 4)}, "warning", "A_ORDER: is 1: astropy ignores"),
        (lambda s: {"order": (10, 4)}, "error", "A_ORDER: is 10: the convention ends at 9"),
        (lambda s: {"order": (3, 4)}, "warning", "A_4_0, A_3_1, A_2_2, A_1_3, A_0_4: above"),
        (lambda s: {"a": {**s.a, (0, 0): 0.5}}, "note", "A_0_0: constant or linear terms (up to"),
        (lambda s: {"dmax": (s.a_dmax + 0.1, s.b_dmax)}, "warning", "A_DMAX: says"),
        (lambda s: {"dmax": (None, s.b_dmax)}, "note", "A_DMAX: is not stated"),
        (lambda s: {"closure": s.closure / 2}, "error", "BDCLOS: states"),
        (lambda s: {"inverse_order": None}, "note", "there is no inverse"),
        (lambda s: {"ctype": ("RA---TAN", "DEC--TAN")}, "warning", "do not end in -SIP"),
        (lambda s: {"cd": np.ones((2, 2))}, "error", "CD: the matrix is singular"),
        (lambda s: {"cd": -s.cd[::-1]}, "note", "parity"),
        (lambda s: {"size": None}, "note", "the image size is not known"),
        (lambda s: {"b": {**s.b, (3, 1): s.a[2, 0]}}, "warning", "A_2_0, B_3_1: the same value"),
        (lambda s: {"ap": {(j, i): c for (i, j), c in s.ap.items()},
                    "bp": {(j, i): c for (i, j), c in s.bp.items()}}, "error", "index order"),
    ],
)  # fmt: skip
def test_each_defect_of_a_header_is_found(change, level: str, message: str) -> None:
    sip = good()
    assert message in said(lint_sip(replace(sip, **change(sip))), level)


def test_a_radial_lens_is_not_taken_for_copied_coefficients() -> None:
    """k r^2 (x, y) + m r^4 (x, y), expanded: equal coefficients by construction."""
    k, m, sip = 3.1e-9, -2.3e-16, good()
    a = {(3, 0): k, (1, 2): k, (5, 0): m, (3, 2): 2 * m, (1, 4): m}
    radial = replace(sip, order=(5, 5), a=a, b={(j, i): c for (i, j), c in a.items()})
    assert "A_3_0" not in said(lint_sip(radial), "warning")
    # a coefficient that was copied in a file of another lens is found as before
    copied = replace(radial, a={**a, (3, 0): 1.1 * k}, b={**radial.b, (0, 3): 1.2 * k})
    assert "A_1_2, B_2_1: the same value" in said(lint_sip(copied), "warning")


HEADER = {
    "CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CRPIX1": 500.5, "CRPIX2": 400.5,
    "CRVAL1": 10.0, "CRVAL2": 20.0, "CD1_1": -1e-5, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1e-5,
    "NAXIS1": 1000, "NAXIS2": 800,
}  # fmt: skip
SIP_CARDS = {"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-6, "B_0_2": 2e-6}


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({}, "ends in -SIP, but there are no coefficients"),
        (SIP_CARDS | {"NDRIZIM": 4}, "the image was drizzled"),
    ],
)
def test_headers_whose_distortion_is_elsewhere_are_named(tmp_path, cards, words) -> None:
    path = tmp_path / "camera.hdr"
    fits.Header((HEADER | cards).items()).totextfile(path)
    assert words in " ".join(describe(path).split())
    sound = tmp_path / "sound.hdr"
    fits.Header((HEADER | SIP_CARDS).items()).totextfile(sound)
    assert words not in " ".join(describe(sound).split())


def test_a_size_can_be_told() -> None:
    sip = replace(good(), size=None)
    assert [finding.where for finding in lint_sip(sip, (1200, 900))] == ["AE, BE"]
    assert "A_DMAX: says" in said(lint_sip(sip, (600, 450)))


def test_no_coefficient_is_blamed_if_the_polynomials_overflow() -> None:
    """The closure is then not a number, for which no value of a coefficient can be solved."""

    def explain(*_):
        raise AssertionError("the closure is unknown")

    sip = good()
    high = {(4, 0): 1e308, (3, 1): -1e308}
    with np.errstate(all="ignore"):
        wrong = replace(sip, a={**sip.a, **high}, order=(4, 4))
        assert np.isnan(worst_closure(wrong, sip.size))
        found = lint_sip(wrong, explain=explain)
    assert not [f for f in found if f.where == "AP, BP"]


# -- IDCTAB --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(data_dir) -> IdcTab:
    """The rows of F606W of a real table."""
    tab = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    return keep(tab, [tab.row(1, F606W), tab.row(2, F606W)])


def keep(tab: IdcTab, rows: list[int]) -> IdcTab:
    block = tab.hdus[1]
    width = block.header["NAXIS1"]
    data = b"".join(block.data[k * width : (k + 1) * width] for k in rows)
    cards = [
        number_card("NAXIS2", len(rows)) if card.startswith("NAXIS2 ") else card
        for card in block.cards
    ]
    return IdcTab((tab.hdus[0], Hdu(tuple(cards), data)), "real")


def altered(tab: IdcTab, row: int, **values: float) -> IdcTab:
    """The table with some numbers of one row replaced."""
    block = tab.hdus[1]
    data = fits.BinTableHDU.fromstring(block.to_bytes()).data.copy()
    for name, value in values.items():
        data[name][row] = value
    data = data.view(np.ndarray).tobytes()
    return IdcTab((tab.hdus[0], Hdu(block.cards, data), *tab.hdus[2:]), "altered")


def with_keywords(tab: IdcTab, drop: tuple[str, ...] = (), add: tuple[str, ...] = ()) -> IdcTab:
    block = tab.hdus[0]
    cards = [c for c in block.cards if not c.startswith(drop)] if drop else list(block.cards)
    return IdcTab((Hdu((*cards, *add), block.data), *tab.hdus[1:]), "altered")


def test_a_delivered_table_is_clean(real: IdcTab) -> None:
    assert lint_idctab(real) == ()


def test_the_mirrored_polarizer_rows_of_the_delivered_table_are_found(data_dir) -> None:
    """60 rows of chip 2 have CY10 < 0; its HISTORY says that polarizers are not calibrated."""
    tab = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    [finding] = lint_idctab(tab)
    assert (finding.level, "parity" in finding.message) == ("warning", True)
    assert finding.where.startswith("rows 278, 280, 282 and 57 more")
    assert (tab.rows["CY10"] < 0).sum() == 60
    assert all("POL" in f[0] for f, c in zip(tab.filters(), tab.rows["CY10"], strict=True) if c < 0)


def test_the_old_table_would_drift_by_default(data_dir) -> None:
    findings = lint_idctab(read_idctab(data_dir / "hst_reference" / "qbu1641sj_idc.fits"))
    text = said(findings)
    assert "TDD_CTB1: there are no time-dependent terms, so stwcs applies its own of 2004.5" in text
    assert "single precision" in text
    assert "the same chip and filters with other values" in text  # "probably includes duplicates"
    assert said(findings, "error") == ""


@pytest.mark.parametrize(
    ("values", "level", "message"),
    [
        ({"SCALE": 0.0}, "error", "row 1, column SCALE: is zero"),
        ({"SCALE": 1.0}, "warning", "does not fit the linear terms"),
        ({"V3REF": 302.252}, "error", "row 1, column V3REF: is that of chip 2"),
        ({"V3REF": 405.0}, "warning", "parity: chip 1 lies at higher V3"),
        ({"CX11": 1.0}, "warning", "is exactly 1 and SCALE is not"),
        ({"CX11": 0.002, "CX10": 0.049, "CY11": 0.048, "CY10": 0.002}, "warning", "index order"),
        ({"CY10": -0.0486}, "warning", "parity: the linear part mirrors"),
        ({"CX11": 0.0, "CX10": 0.0}, "error", "the linear part is singular"),
        ({"CX31": 1.0e-12, "CY33": -1.0e-12}, "warning", "columns CX31, CY33: the same value"),
        ({"XREF": 9000.0}, "warning", "row 1, column XREF: lies outside"),
        ({"CX44": float("nan")}, "error", "row 1, column CX44: not a finite number"),
    ],
)
def test_each_defect_of_a_row_is_found(real, values: dict, level: str, message: str) -> None:
    assert real.rows["DETCHIP"][0] == 1
    assert real.rows["V3REF"][1] == pytest.approx(302.252, abs=1e-3)
    if values.get("V3REF") == 302.252:
        values = {"V3REF": float(real.rows["V3REF"][1])}
    assert message in said(lint_idctab(altered(real, 0, **values)), level)


@pytest.mark.parametrize(
    ("drop", "add", "level", "message"),
    [
        (("TDD",), (), "warning", "wrong by 30 to 50 mas in 2016"),
        (("TDD_DATE",), (), "error", "TDD_DATE: is missing"),
        (("TDD_CTB1",), (), "error", "stwcs looks for TDD_CTB1"),
        (("TDD_CTB2",), (), "error", "TDD_CTB2: is missing"),
        ((), (number_card("TDD_CTA1", 1e-5),), "warning", "TDD_CTA1: stwcs reads but never"),
        (("DETECTOR",), (), "warning", "DETECTOR: is missing"),
        (("PARITY",), (number_card("PARITY", 1),), "warning", "PARITY: is 1"),
        (("PEDIGREE",), (), "note", "PEDIGREE: is missing"),
        (("NORDER",), (number_card("NORDER", 4),), "note", "CX50 .. CY55: above NORDER 4"),
    ],
)
def test_each_defect_of_the_keywords_is_found(real, drop, add, level: str, message: str) -> None:
    assert message in said(lint_idctab(with_keywords(real, drop, add)), level)


def test_stray_time_keywords_of_another_detector(real: IdcTab) -> None:
    other = with_keywords(real, ("DETECTOR",), ("DETECTOR= 'HRC     '".ljust(80),))
    assert "is not read by stwcs for ACS/HRC" in said(lint_idctab(other), "warning")


def test_missing_rows(real: IdcTab) -> None:
    assert "there is no chip 2" in said(lint_idctab(keep(real, [0])), "warning")
    assert "repeats a row before it" in said(lint_idctab(keep(real, [0, 1, 1])), "note")
