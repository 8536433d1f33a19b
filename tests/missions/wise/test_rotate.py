"""Rotated and mirrored frames: Appendix A of the WISE report, group laws, and astropy.wcs.

Source of the table: WSDC D-T033, "WISE IOC Distortion Calibration", Appendix A.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from bayesdist.errors import InputError
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.files import read_sip, sip_header, write_sip
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.missions.wise.rotate import coefficient_map, pixel_matrix, rotated_sip
from bayesdist.model.basis import polynomial_terms
from tests.formats.support import astropy_wcs, random_pixels, some_solution

# coefficient at R = 0, and what stands there at R = 90, 180, 270
APPENDIX_A = """
A_0_2 -B_2_0 -A_0_2 B_2_0
A_0_3 -B_3_0 A_0_3 -B_3_0
A_0_4 -B_4_0 -A_0_4 B_4_0
A_1_1 B_1_1 -A_1_1 -B_1_1
A_1_2 B_2_1 A_1_2 B_2_1
A_1_3 B_3_1 -A_1_3 -B_3_1
A_2_0 -B_0_2 -A_2_0 B_0_2
A_2_1 -B_1_2 A_2_1 -B_1_2
A_2_2 -B_2_2 -A_2_2 B_2_2
A_3_0 B_0_3 A_3_0 B_0_3
A_3_1 B_1_3 -A_3_1 -B_1_3
A_4_0 -B_0_4 -A_4_0 B_0_4
A_DMAX B_DMAX A_DMAX B_DMAX
B_0_2 A_2_0 -B_0_2 -A_2_0
B_0_3 A_3_0 B_0_3 A_3_0
B_0_4 A_4_0 -B_0_4 -A_4_0
B_1_1 -A_1_1 -B_1_1 A_1_1
B_1_2 -A_2_1 B_1_2 -A_2_1
B_1_3 -A_3_1 -B_1_3 A_3_1
B_2_0 A_0_2 -B_2_0 -A_0_2
B_2_1 A_1_2 B_2_1 A_1_2
B_2_2 A_2_2 -B_2_2 -A_2_2
B_3_0 -A_0_3 B_3_0 -A_0_3
B_3_1 -A_1_3 -B_3_1 A_1_3
B_4_0 A_0_4 -B_4_0 -A_0_4
B_DMAX A_DMAX B_DMAX A_DMAX
AP_0_2 -BP_2_0 -AP_0_2 BP_2_0
AP_0_3 -BP_3_0 AP_0_3 -BP_3_0
AP_0_4 -BP_4_0 -AP_0_4 BP_4_0
AP_1_1 BP_1_1 -AP_1_1 -BP_1_1
AP_1_2 BP_2_1 AP_1_2 BP_2_1
AP_1_3 BP_3_1 -AP_1_3 -BP_3_1
AP_2_0 -BP_0_2 -AP_2_0 BP_0_2
AP_2_1 -BP_1_2 AP_2_1 -BP_1_2
AP_2_2 -BP_2_2 -AP_2_2 BP_2_2
AP_3_0 BP_0_3 AP_3_0 BP_0_3
AP_3_1 BP_1_3 -AP_3_1 -BP_1_3
AP_4_0 -BP_0_4 -AP_4_0 BP_0_4
BP_0_2 AP_2_0 -BP_0_2 -AP_2_0
BP_0_3 AP_3_0 BP_0_3 AP_3_0
BP_0_4 AP_4_0 -BP_0_4 -AP_4_0
BP_1_1 -AP_1_1 -BP_1_1 AP_1_1
BP_1_2 -AP_2_1 BP_1_2 -AP_2_1
BP_1_3 -AP_3_1 -BP_1_3 AP_3_1
BP_2_0 AP_0_2 -BP_2_0 -AP_0_2
BP_2_1 AP_1_2 BP_2_1 AP_1_2
BP_2_2 AP_2_2 -BP_2_2 -AP_2_2
BP_3_0 -AP_0_3 BP_3_0 -AP_0_3
BP_3_1 -AP_1_3 -BP_3_1 AP_1_3
BP_4_0 AP_0_4 -BP_4_0 -AP_0_4
"""
QUARTERS = (0.0, 90.0, 180.0, 270.0)
TERMS = polynomial_terms(4)
angles = st.floats(-720, 720, allow_subnormal=False)
SIZE = (1200, 900)


def header():
    return sip_from_solution(some_solution(4, flip=True, angle=0.4, strength=0.5), scale_arcsec=0.1)


def moved_pixels(x, y, size, degrees: float, mirror: bool = False):
    """Where pixels of an image are after a quarter turn, counted by hand."""
    nx, ny = size
    if mirror:
        x = nx + 1 - x
    return {
        0.0: (x, y),
        90.0: (ny + 1 - y, x),
        180.0: (nx + 1 - x, ny + 1 - y),
        270.0: (y, nx + 1 - x),
    }[degrees]


# -- the table ------------------------------------------------------------------------------------


def numbered(prefixes: tuple[str, str]) -> dict[str, float]:
    """A different number for each coefficient."""
    names = [f"{p}_{i}_{j}" for p in prefixes for i, j in TERMS]
    return {name: float(k) for k, name in enumerate(names, start=1)}


@pytest.mark.parametrize("degrees", QUARTERS[1:])
@pytest.mark.parametrize("prefixes", [("A", "B"), ("AP", "BP")])
def test_the_table_of_the_report(prefixes, degrees: float) -> None:
    """Row by row; there is no misprint in it."""
    old = numbered(prefixes)
    R = coefficient_map(4, pixel_matrix(degrees))
    new = dict(zip(old, R @ list(old.values()), strict=True))
    rows = [line.split() for line in APPENDIX_A.split("\n") if line.startswith(prefixes)]
    rows = [row for row in rows if row[0].split("_")[0] in prefixes and "DMAX" not in row[0]]
    assert len(rows) == 24
    for name, *turned in rows:
        text = turned[int(degrees / 90) - 1]
        sign = -1.0 if text.startswith("-") else 1.0
        assert new[name] == sign * old[text.lstrip("-")], name


def test_the_rule_of_the_report() -> None:
    """Its closed form, which holds for the constant and the linear terms as well."""
    old = numbered(("A", "B"))
    turned = {
        d: dict(zip(old, coefficient_map(4, pixel_matrix(d)) @ list(old.values()), strict=True))
        for d in QUARTERS
    }
    for i, j in TERMS:
        A, B = (old[f"{p}_{j}_{i}"] for p in "AB")  # with indices exchanged
        new = {d: (turned[d][f"A_{i}_{j}"], turned[d][f"B_{i}_{j}"]) for d in QUARTERS}
        sign_180 = -1 if (i + j) % 2 == 0 else 1
        assert new[90] == ((-1 if i % 2 == 0 else 1) * B, (-1 if i % 2 else 1) * A)
        assert new[180] == (sign_180 * old[f"A_{i}_{j}"], sign_180 * old[f"B_{i}_{j}"])
        assert new[270] == ((-1 if j % 2 else 1) * B, (-1 if j % 2 == 0 else 1) * A)


def test_maxima_go_with_their_axes() -> None:
    """A_DMAX and B_DMAX change places at 90 and 270 degrees: four rows of the table."""
    rows = [line.split() for line in APPENDIX_A.split("\n") if "DMAX" in line]
    assert len(rows) == 2
    sip = header()
    old = {"A_DMAX": sip.a_dmax, "B_DMAX": sip.b_dmax}
    for k, degrees in enumerate(QUARTERS[1:], start=1):
        turned = rotated_sip(sip, degrees)
        for row in rows:
            new = turned.a_dmax if row[0] == "A_DMAX" else turned.b_dmax
            assert new == old[row[k]]


# -- the group ------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(angles, angles, st.booleans(), st.booleans())
def test_coefficients_follow_the_group_of_the_frames(a, b, m, n) -> None:
    M, N = pixel_matrix(a, mirror=m), pixel_matrix(b, mirror=n)
    both = coefficient_map(4, M) @ coefficient_map(4, N)
    assert_allclose(both, coefficient_map(4, M @ N), atol=1e-12)


@settings(deadline=None, max_examples=60)
@given(angles, st.booleans())
def test_the_inverse_frame_brings_coefficients_back(a, m) -> None:
    M = pixel_matrix(a, mirror=m)
    back = coefficient_map(4, M.T) @ coefficient_map(4, M)
    assert_allclose(back, np.eye(30), atol=1e-12)
    # a mirror is its own inverse at any angle
    if m:
        assert_allclose(coefficient_map(4, M) @ coefficient_map(4, M), np.eye(30), atol=1e-12)


def test_quarter_turns_are_exact() -> None:
    for mirror in (False, True):
        for degrees in (*QUARTERS, -90.0, 450.0):
            R = coefficient_map(4, pixel_matrix(degrees, mirror=mirror))
            assert set(np.unique(R)) <= {-1.0, 0.0, 1.0}
            assert (np.abs(R).sum(axis=0) == 1).all() and (np.abs(R).sum(axis=1) == 1).all()
    quarter = coefficient_map(4, pixel_matrix(90))
    assert np.array_equal(np.linalg.matrix_power(quarter, 4), np.eye(30))


@settings(deadline=None, max_examples=60)
@given(angles, st.booleans(), st.integers(0, 2**31))
def test_turn_apply_turn_back(degrees, mirror, seed) -> None:
    """f'(M w) = M f(w), with f and f' evaluated term by term."""
    rng = np.random.default_rng(seed)
    c, w = rng.normal(size=30), rng.uniform(-1, 1, (2, 20))
    M = pixel_matrix(degrees, mirror=mirror)

    def apply(coefficients, w):
        powers = np.stack([w[0] ** i * w[1] ** j for i, j in TERMS])
        return np.stack([coefficients[:15] @ powers, coefficients[15:] @ powers])

    assert_allclose(apply(coefficient_map(4, M) @ c, M @ w), M @ apply(c, w), atol=1e-12)


def test_an_angle_is_a_number() -> None:
    with pytest.raises(InputError, match="the angle is nan"):
        pixel_matrix(np.nan)


# -- headers --------------------------------------------------------------------------------------


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("degrees", QUARTERS)
def test_astropy_finds_the_same_sky_at_the_turned_pixel(degrees: float, mirror: bool) -> None:
    sip = header()
    turned = rotated_sip(sip, degrees, mirror=mirror)
    x, y = random_pixels(SIZE, 500)
    new = moved_pixels(x, y, SIZE, degrees, mirror)
    before = astropy_wcs(sip_header(sip)).all_pix2world(x, y, 1)
    after = astropy_wcs(sip_header(turned)).all_pix2world(*new, 1)
    assert_allclose(after, before, atol=1e-13 * 360, rtol=0)
    back = turned.inverse(*turned.forward(*new))
    assert np.hypot(*(np.array(back) - new)).max() <= sip.closure * (1 + 1e-6)
    # nothing in it contradicts anything else: maxima, closure, size
    assert {f.level for f in lint_sip(turned)} <= {"note"}


@settings(deadline=None, max_examples=15)
@given(angles, st.booleans())
def test_astropy_finds_the_same_sky_at_any_angle(degrees: float, mirror: bool) -> None:
    sip = header()
    turned = rotated_sip(sip, degrees + 0.25, mirror=mirror)
    x, y = random_pixels(SIZE, 100)
    M = pixel_matrix(degrees + 0.25, mirror=mirror)
    u, v = M @ np.stack([x - sip.crpix[0], y - sip.crpix[1]])
    shift = np.array(turned.crpix)
    before = astropy_wcs(sip_header(sip)).all_pix2world(x, y, 1)
    after = astropy_wcs(sip_header(turned)).all_pix2world(u + shift[0], v + shift[1], 1)
    assert_allclose(after, before, atol=1e-10, rtol=0)


def test_four_quarters_give_the_header_back(tmp_path) -> None:
    sip = header()
    write_sip(sip, tmp_path / "a.hdr")
    sip = once = read_sip(tmp_path / "a.hdr")
    for _ in range(4):
        once = rotated_sip(once, 90)
    for name in ("a", "b", "ap", "bp", "sigma_a", "sigma_b"):
        assert dict(getattr(once, name)) == dict(getattr(sip, name)), name
    for name in ("dmax", "closure", "size", "order", "inverse_order", "offset"):
        assert getattr(once, name) == getattr(sip, name), name
    assert_allclose(once.crpix, sip.crpix, atol=1e-12)
    assert np.array_equal(once.cd, sip.cd)


def test_a_turned_header_of_a_file_says_its_new_shape(tmp_path) -> None:
    write_sip(header(), tmp_path / "a.hdr")
    sip = read_sip(tmp_path / "a.hdr")
    write_sip(rotated_sip(sip, 90), tmp_path / "b.hdr")
    assert read_sip(tmp_path / "b.hdr").size == SIZE[::-1]
    write_sip(rotated_sip(sip, 30), tmp_path / "c.hdr")
    free = read_sip(tmp_path / "c.hdr")
    assert free.size is None and free.dmax == (None, None) and not free.sigma_a


def test_orders_that_differ_go_with_their_axes() -> None:
    sip = replace(header(), order=(3, 4))
    assert rotated_sip(sip, 90).order == (4, 3)
    assert rotated_sip(sip, 180).order == (3, 4)
    free = rotated_sip(sip, 20)
    assert free.order == (4, 4)
    x, y = random_pixels(SIZE, 50)
    M = pixel_matrix(20)
    w = M @ np.stack([x - sip.crpix[0], y - sip.crpix[1]])
    after = free.forward(*(w + np.array(free.crpix)[:, None]))
    assert_allclose(np.stack(after), M @ np.stack(sip.forward(x, y)), atol=1e-9)
