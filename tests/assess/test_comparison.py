"""Comparison of two calibrations: known differences, known errors, and what frames hide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from bayesdist.assess.comparison.compare import (
    compare,
    comparison_lines,
    comparison_table,
    difference_table,
    verdict,
)
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis
from bayesdist.products.registry import read_calibration

pytestmark = pytest.mark.plugins

SIZE = (1000.0, 800.0)
BASIS = PolynomialBasis(4, SIZE, (500.0, 400.0))
LOW = PolynomialBasis(3, SIZE, (300.0, 420.0))


def truth() -> np.ndarray:
    """Coefficients (2, K) of some pixels of distortion, of third order."""
    rng = np.random.default_rng(8)
    c = np.zeros((2, BASIS.n_terms))
    c[0, 1], c[1, 2] = SIZE[0] / 2, SIZE[1] / 2
    c[:, 3:6] = 3 * rng.standard_normal((2, 3))
    c[:, 6:10] = 0.3 * rng.standard_normal((2, 4))
    return c


def covariance(n: int, seed: int, sigma: float = 1e-3) -> np.ndarray:
    """A covariance with strong correlations."""
    A = 0.3 * np.random.default_rng(seed).standard_normal((n, n)) + np.eye(n)
    return sigma**2 * A @ A.T


def moved(c: np.ndarray, cov: np.ndarray | None, turn: complex, shift: complex, mirror: bool):
    """Coefficients and covariance of shift + turn (u + i v), mirrored in the end."""
    z = turn * (c[0] + 1j * c[1])
    z[0] += shift
    M = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    if mirror:
        z, M = z.conj(), np.diag([1.0, -1.0]) @ M
    T = np.kron(M, np.eye(c.shape[1]))
    return np.array([z.real, z.imag]), None if cov is None else T @ cov @ T.T


def drawn(rng, c, cov):
    return c + (np.linalg.cholesky(cov) @ rng.standard_normal(len(cov))).reshape(c.shape)


def test_with_itself_nothing_is_left(rng) -> None:
    one = ChipMap("A", BASIS, "pix", truth(), covariance(30, 1))
    found = compare(one, one, rng=rng)
    assert found.largest < 1e-11
    assert found.field.chi2 < 1e-12 and found.field.p_value == 1.0
    assert found.p_largest_z == found.p_largest_chi2 == 1.0
    assert found.similarity.rotation == pytest.approx(0, abs=1e-12)
    assert verdict(found) == "The calibrations agree to rounding."


@pytest.mark.parametrize("keep", [False, True])
def test_errors_alone_make_a_chi_square(keep, rng) -> None:
    """Of pairs in other frames, orders, units: chi-square(dof), and p-values that are uniform."""
    A, B = covariance(2 * BASIS.n_terms, 1), covariance(2 * LOW.n_terms, 2)
    turn, mirror, unit = (1.0, False, "pix") if keep else (0.05 * np.exp(2.3j), True, "arcsec")
    values, dofs, p_z, p_map, pulls, n = [], set(), [], [], [], 120
    for _ in range(n):
        a = drawn(rng, truth(), A)
        b, B_moved = moved(
            drawn(rng, truth()[:, : LOW.n_terms], B), B, turn, 0j if keep else 7, mirror
        )
        found = compare(
            ChipMap("A", BASIS, "pix", a, A),
            ChipMap("B", LOW, unit, b, B_moved),
            rng=rng,
            grid=(5, 4),
            keep=keep,
            n_draws=99,
        )
        values.append(found.field.chi2)
        dofs.add(found.field.dof)
        p_z.append(found.p_largest_z)
        p_map.append(found.p_largest_chi2)
        s = found.similarity
        angle = np.angle(np.exp(1j * (s.rotation + (0.0 if keep else 2.3))))
        pulls.append(
            (angle / s.sigma_rotation, (s.scale * abs(turn) - 1) / s.sigma_scale / abs(turn))
        )
    assert dofs == {30 if keep else 26}
    assert kstest(values, chi2(dofs.pop()).cdf).pvalue > 1e-3
    for p in (p_z, p_map):  # multiples of 1 / 100: made continuous, else the test sees the steps
        assert kstest(np.array(p) - rng.uniform(size=n) / 100, "uniform").pvalue > 1e-3
    for pull in np.transpose(pulls):
        assert (pull**2).sum() == pytest.approx(n, abs=3.3 * np.sqrt(2 * n))


def test_shift_rotation_and_scale_are_told_and_taken_out(rng) -> None:
    cov = covariance(30, 1, 1e-4)
    turn = 1.0005 * np.exp(2e-4j)
    a, cov_a = moved(truth(), cov, turn, 0.3 - 0.2j, False)
    found = compare(
        ChipMap("A", BASIS, "pix", a, cov_a),
        ChipMap("B", BASIS, "pix", truth(), cov),
        rng=rng,
    )
    s = found.similarity
    assert (s.rotation, s.scale) == (
        pytest.approx(2e-4, abs=1e-12),
        pytest.approx(1.0005, abs=1e-12),
    )
    # the mean offset over the detector, in pixels of A
    assert s.shift == (pytest.approx(0.3, abs=5e-3), pytest.approx(-0.2, abs=5e-3))
    assert s.rotation > 10 * s.sigma_rotation and s.scale - 1 > 10 * s.sigma_scale
    assert found.largest < 1e-10 and not found.differs
    assert "scale - 1" in "\n".join(comparison_lines(found))


def test_kept_they_are_the_difference(rng) -> None:
    cov = covariance(30, 1, 1e-4)
    a, _ = moved(truth(), None, 1.0 + 1e-4j, 0j, False)
    found = compare(
        ChipMap("A", BASIS, "pix", a, cov),
        ChipMap("B", BASIS, "pix", truth(), cov),
        rng=rng,
        keep=True,
    )
    # a rotation by 1e-4 about the middle moves the corners, 640 pixels away, by 0.064
    assert found.largest == pytest.approx(1e-4 * np.hypot(500, 400), rel=0.05)
    assert found.differs


def test_a_known_difference_is_found_where_it_is(rng) -> None:
    """0.02 px of x^2 in u: size, place, significance and the one coefficient."""
    cov = covariance(30, 1, 5e-4)
    more = truth()
    more[0, 3] += 0.02
    found = compare(
        ChipMap("A", BASIS, "pix", more, cov),
        ChipMap("B", BASIS, "pix", truth(), cov),
        rng=rng,
    )
    assert found.differs and found.errors_of == "both"
    # P_2(X) has mean square 1/5; the linear part is the identity up to the distortion
    assert found.rms == pytest.approx(0.02 / np.sqrt(5), rel=0.02)
    table = comparison_table(found)
    row = table[(table["form"] == "legendre") & (table["axis"] == "u") & (table["i"] == 2)][0]
    assert row["difference"] == pytest.approx(0.02, rel=0.02)
    assert row["sigma"] == pytest.approx(np.sqrt(2 * cov[3, 3]), rel=0.05)
    assert abs(row["z"]) == pytest.approx(found.largest_z)
    grid = difference_table(found)
    k = int(np.argmax(np.hypot(grid["du"], grid["dv"])))
    assert (grid["x"][k], grid["y"][k]) == found.position_of_largest


def test_map_and_its_errors_against_sums_of_terms(rng) -> None:
    """Without taking anything out: positions and J C J^T, point by point."""
    A = covariance(30, 1)
    a, b = truth(), truth() + 1e-3 * rng.standard_normal((2, 15))
    found = compare(
        ChipMap("A", BASIS, "pix", a, A),
        ChipMap("B", BASIS, "pix", b),
        rng=rng,
        grid=(3, 3),
        keep=True,
    )
    x, y = found.x[2], found.y[1]
    phi = BASIS.evaluate([x], [y])[0]
    linear = BASIS.to_monomials(a)[:, 1:3]
    J = np.linalg.solve(linear, np.kron(np.eye(2), phi))
    d, C = J @ (a - b).ravel(), J @ A @ J.T
    assert (found.du[1, 2], found.dv[1, 2]) == (pytest.approx(d[0]), pytest.approx(d[1]))
    assert found.sigma_u[1, 2] == pytest.approx(np.sqrt(C[0, 0]))
    assert found.chi2[1, 2] == pytest.approx(d @ np.linalg.solve(C, d))
    assert found.errors_of == "A"


def test_without_errors_only_sizes_are_told(rng) -> None:
    b = truth()
    b[1, 5] += 0.01
    found = compare(ChipMap("A", BASIS, "pix", truth()), ChipMap("B", BASIS, "pix", b), rng=rng)
    assert found.field is None and found.differs is None and found.sigma_u is None
    assert "neither gives errors" in verdict(found)
    assert np.isnan(comparison_table(found)["z"]).all()


def test_sigmas_without_correlations_test_single_terms_only(rng) -> None:
    sigma = np.full(30, 1e-9)

    def positions(x, y):
        dx, dy = x - 500.0, y - 400.0
        return dx + 2e-8 * dx**2, dy + 0.0 * dx

    options = {"order": 4, "size": SIZE, "reference_pixel": (500.0, 400.0), "unit": "pix"}
    given = fitted_map(positions, "A", monomial_cov=np.diag(sigma**2), **options)
    given = replace(given, correlated=False)
    plain = fitted_map(lambda x, y: (x - 500.0, y - 400.0), "B", **options)
    found = compare(given, plain, rng=rng)
    assert found.field is None and "without their correlations" in verdict(found)
    table = comparison_table(found)
    row = table[(table["form"] == "monomial") & (table["axis"] == "u") & (table["i"] == 2)][0]
    assert row["z"] == pytest.approx(20, rel=1e-3)
    assert np.isnan(table[table["form"] == "legendre"]["z"]).all()


def test_terms_that_no_covariance_speaks_of_are_told_apart(rng) -> None:
    a = truth()
    a[0, 12] += 0.05  # fourth order, of which B knows nothing and A gives no error
    b = truth()[:, : LOW.n_terms]
    found = compare(
        ChipMap("A", BASIS, "pix", a),
        ChipMap("B", LOW, "pix", b, covariance(20, 2)),
        rng=rng,
    )
    i, j = BASIS.terms[12]
    assert found.unknown_rms == pytest.approx(0.05 / np.sqrt((2 * i + 1) * (2 * j + 1)), rel=0.05)
    assert found.field.dof == 16 and not found.differs
    assert "not tested" in "\n".join(comparison_lines(found))


def test_a_covariance_from_few_draws_does_not_cry_wolf(rng) -> None:
    """Estimated from 200 draws, the uncorrected chi-square of 26 terms is 16 % too large."""
    A, n = covariance(30, 1), 200
    root = np.linalg.cholesky(A)
    values = []
    for _ in range(150):
        estimate = np.cov(rng.standard_normal((n, 30)) @ root.T, rowvar=False)
        values.append(
            compare(
                ChipMap("A", BASIS, "pix", drawn(rng, truth(), A), estimate, draws=n),
                ChipMap("B", BASIS, "pix", truth()),
                rng=rng,
                grid=(2, 2),
                n_draws=1,
            ).field.chi2
        )
    mean, error = np.mean(values), np.std(values) / np.sqrt(len(values))
    assert mean == pytest.approx(26, abs=4 * error)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"basis": PolynomialBasis(4, (900.0, 800.0), (450.0, 400.0))}, "900 x 800"),
        ({"coefficients": np.zeros((2, 15))}, "no linear part"),
        ({"coefficients": np.full((2, 15), np.nan)}, "not finite"),
    ],
)
def test_what_cannot_be_compared_is_refused(change, words, rng) -> None:
    plain = {"name": "B", "basis": BASIS, "unit": "pix", "coefficients": truth()}
    with pytest.raises(InputError, match=words):
        compare(ChipMap("A", BASIS, "pix", truth()), ChipMap(**(plain | change)), rng=rng)


def test_frames_of_other_axes_cannot_be_kept(rng) -> None:
    b, _ = moved(truth(), None, 1j, 0j, False)
    with pytest.raises(InputError, match="keep-linear"):
        compare(
            ChipMap("A", BASIS, "pix", truth()),
            ChipMap("B", BASIS, "pix", b),
            rng=rng,
            keep=True,
        )


# -- real tables ----------------------------------------------------------------------------------


def test_two_released_tables_by_themselves(data_dir, rng) -> None:
    """ACS/WFC of 2004 and of 2015 against a least-squares fit that knows only the FITS columns."""
    from astropy.io import fits

    names = ("0461802ej_idc.fits", "qbu1641sj_idc.fits")
    paths = [data_dir / "hst_reference" / name for name in names]
    a, b = (read_calibration(p, filter="F606W").by_chip() for p in paths)
    x = np.linspace(0.5, 4096.5, 401)[:-1] + 5.12  # cell centres: an even cover of the chip
    y = np.linspace(0.5, 2048.5, 201)[:-1] + 5.12
    X, Y = (g.ravel() for g in np.meshgrid(x, y))
    for chip in (1, 2):
        plane = []
        for path in paths:
            with fits.open(path) as hdus:
                order = hdus[0].header["NORDER"]
                row = next(
                    r for r in hdus[1].data
                    if r["DETCHIP"] == chip and r["DIRECTION"].strip() == "FORWARD"
                    and "F606W" in (r["FILTER1"].strip(), r["FILTER2"].strip())
                )  # fmt: skip
                dx, dy = X - row["XREF"], Y - row["YREF"]
                both = [
                    sum(
                        float(row[f"{c}{n}{j}"]) * dx**j * dy ** (n - j)
                        for n in range(1, order + 1)
                        for j in range(n + 1)
                    )
                    for c in ("CX", "CY")
                ]
                linear = np.array([[row[f"{c}11"], row[f"{c}10"]] for c in ("CX", "CY")], float)
                plane.append((both[0] + 1j * both[1], linear))
        (wa, linear), (wb, _) = plane
        design = np.stack([np.ones_like(wb), wb], axis=1)
        found = np.linalg.lstsq(design, wa)[0]
        rest = wa - design @ found
        d = np.linalg.solve(linear, np.stack([rest.real, rest.imag]))
        ours = compare(a[chip], b[chip], rng=rng)
        assert ours.similarity.rotation == pytest.approx(np.angle(found[1]), rel=1e-3)
        assert ours.similarity.scale - 1 == pytest.approx(abs(found[1]) - 1, rel=1e-3)
        assert ours.rms == pytest.approx(np.sqrt((d**2).sum(axis=0).mean()), rel=1e-3)
        assert ours.frame.pixel_mas == pytest.approx(1e3 * np.sqrt(abs(np.linalg.det(linear))))
