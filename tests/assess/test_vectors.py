import numpy as np
import pytest

from bayesdist.assess import distortion_vectors
from bayesdist.errors import InputError
from bayesdist.model import polynomial_terms

# WISE IOC Distortion Calibration (WSDC D-T033), Appendix B: A_i_j and B_i_j with i, j in the order
# of TERMS, which is that of the file.  They are added to the offsets from the centre of the array.
TERMS = [
    (0, 0), (0, 1), (1, 0), (0, 2), (0, 3), (0, 4), (1, 1), (1, 2), (1, 3), (2, 0), (2, 1), (2, 2),
    (3, 0), (3, 1), (4, 0),
]  # fmt: skip
WISE = {
    "W1": (
        [7.228039e-01, -1.243220e-04, -7.790246e-04, -7.793528e-06, -2.928111e-10, -6.270019e-13,
         1.344445e-06, 1.228555e-09, -5.895443e-13, -1.629945e-06, -1.186318e-10, 1.503974e-12,
         2.756392e-09, -4.586393e-13, 1.794526e-12],
        [-7.946909e-02, 3.218232e-04, -2.481941e-04, -3.541684e-06, -3.174803e-09, -8.545365e-13,
         -3.541684e-06, -4.987962e-10, 1.458031e-12, -6.590985e-08, -2.600160e-10, -2.594371e-13,
         -6.360093e-11, 7.028808e-13, 8.797685e-13],
    ),
    "W2": (
        [7.597772e-01, -1.192789e-04, -5.040463e-04, -8.064834e-06, -4.935791e-10, -1.303108e-13,
         1.082862e-06, 3.389170e-10, -5.769507e-13, -1.349460e-06, -1.297961e-09, 2.075723e-12,
         2.959435e-09, -6.743610e-13, 1.787756e-12],
        [-9.433609e-02, 5.505028e-04, -2.026974e-04, 1.091415e-06, -3.840921e-09, -5.181754e-13,
         -3.953933e-06, -9.316313e-10, 8.534495e-13, 8.038015e-08, 4.101600e-10, -5.705721e-13,
         1.067827e-10, 1.952342e-12, -1.788157e-13],
    ),
    "W3": (
        [7.358456e-01, -6.410136e-04, -4.8377784e-04, -8.308111e-06, -1.625272e-10, 2.677086e-13,
         8.952514e-07, 3.550849e-10, -9.680264e-13, -1.754315e-06, -9.762929e-10, 1.454345e-12,
         2.879012e-09, -3.960689e-12, 3.033166e-12],
        [-8.389715e-02, 5.030167e-04, -6.788420e-04, 5.610990e-07, -3.660396e-09, 1.671433e-14,
         -3.515651e-06, -2.476911e-10, 9.798616e-13, 5.414236e-07, 1.285471e-10, -2.083238e-12,
         8.619879e-11, 1.482141e-12, -7.304812e-13],
    ),
}  # fmt: skip
# The printed B_0_2 of W1 repeats B_1_1; the inverse, BP_0_2 = -1.163635e-06, says what it was.
W1_B_0_2 = 1.163635e-06
# Section 4: maximum of the vectors with the zeroth order suppressed; Appendix B: A_DMAX, B_DMAX.
PUBLISHED_MAX = {"W1": 2.931, "W2": 3.048, "W3": 3.004}
PUBLISHED_DMAX = {"W1": (2.046, 1.066), "W2": (2.083, 1.089), "W3": (2.095, 1.300)}


@pytest.fixture
def wise(from_monomials):
    def make(band, half=507.5, mended=True):
        a, b = (dict(zip(TERMS, values, strict=True)) for values in WISE[band])
        if band == "W1" and mended:
            b[0, 2] = W1_B_0_2
        a[1, 0] += 1.0
        b[0, 1] += 1.0
        n = 2 * half + 1
        centre = (n + 1) / 2
        return from_monomials(a, b, order=4, size=(n, n), reference_pixel=(centre, centre))

    return make


@pytest.mark.parametrize("band", list(WISE))
def test_the_coefficients_are_those_of_the_report(wise, band):
    """The maximum corrections printed beside them, with the constant and within +-507.5."""
    s = wise(band)
    g = np.linspace(1, 1016, 59)
    X, Y = (a.ravel() for a in np.meshgrid(g, g))
    d = s.model.predict(s.mean, X, Y) - np.stack([X - 508.5, Y - 508.5], axis=-1)
    np.testing.assert_allclose(np.abs(d).max(axis=0), PUBLISHED_DMAX[band], atol=6e-4)


@pytest.mark.parametrize("band", list(WISE))
def test_largest_vector_of_the_wise_report(wise, band):
    """The printed maximum lies between the centre and the outer corner of the corner pixel."""
    low, high = (distortion_vectors(wise(band, h)).length_max for h in (507.5, 508.0))
    assert low < PUBLISHED_MAX[band] < high
    assert high - low < 0.0065


def test_the_misprint_of_w1_would_show(wise):
    low = distortion_vectors(wise("W1", 507.5, mended=False)).length_max
    assert low > PUBLISHED_MAX["W1"] + 0.01


def test_pixels_along_the_array_are_compared_with_themselves(wise):
    m = distortion_vectors(wise("W2"), grid=(5, 5))
    assert (m.similarity == np.eye(2)).all() and "array position itself" in m.part_note
    assert (m.unit, m.part) == ("pix", "no_constant")
    np.testing.assert_array_equal(m.on_detector[0], m.du)
    # zero at the reference pixel, which is a grid point; offsets are those of the coefficients
    assert m.length[2, 2] == pytest.approx(0.0, abs=1e-12)
    s = wise("W2")
    expected = s.model.predict(s.mean, [1.0], [1.0])[0] + 507.5 - [7.597772e-01, -9.433609e-02]
    np.testing.assert_allclose([m.du[0, 0], m.dv[0, 0]], expected, rtol=1e-9)


SIMILARITIES = {
    "angle": (2.75 * np.eye(2), "arcsec"),
    "turned": (np.array([[0.0, -1.0], [1.0, 0.0]]), "pix"),
    "flipped": (np.diag([-1.0, 1.0]), "pix"),
    "all": (0.05 * np.array([[0.6, 0.8], [0.8, -0.6]]), "arcsec"),
}


@pytest.mark.parametrize("part", ["no_constant", "non_linear"])
@pytest.mark.parametrize("name", list(SIMILARITIES))
def test_vectors_follow_the_axes_of_u_and_v(from_monomials, part, name):
    """With u, v scaled, turned or flipped, the vectors are too; on the detector they stay."""
    matrix, unit = SIMILARITIES[name]
    rng = np.random.default_rng(11)
    terms = polynomial_terms(4)
    u, v = (
        {t: rng.normal() * 400.0 ** -(t[0] + t[1]) for t in terms if sum(t) > 1} for _ in range(2)
    )
    u[1, 0] = v[0, 1] = 1.3  # far from 1: both solutions are compared with their best similarity
    turned = [
        {t: matrix[a, 0] * u.get(t, 0.0) + matrix[a, 1] * v.get(t, 0.0) for t in terms}
        for a in (0, 1)
    ]
    shape = dict(order=4, size=(800.0, 600.0), reference_pixel=(380.0, 310.0))
    plain = distortion_vectors(from_monomials(u, v, **shape), part=part)
    other = distortion_vectors(from_monomials(*turned, **shape, unit=unit), part=part)
    expected = np.einsum("ab,byx->ayx", matrix, np.stack([plain.du, plain.dv]))
    np.testing.assert_allclose(np.stack([other.du, other.dv]), expected, atol=1e-9)
    np.testing.assert_allclose(other.on_detector, plain.on_detector, atol=1e-8)
    np.testing.assert_allclose(other.similarity, matrix @ plain.similarity, atol=1e-10)
    if part == "no_constant":
        assert "best similarity" in other.part_note
        assert f"parity {round(np.sign(np.linalg.det(matrix))):+d}" in other.part_note


def test_a_similarity_has_no_distortion(from_monomials):
    s = from_monomials(
        {(0, 0): 7.0, (1, 0): 0.03, (0, 1): 0.04},
        {(0, 0): -3.0, (1, 0): 0.04, (0, 1): -0.03},
        order=3,
        size=(100.0, 60.0),
        reference_pixel=(20.0, 50.0),
        unit="arcsec",
    )
    m = distortion_vectors(s)
    assert m.length_max < 1e-12
    assert "scale 0.05 arcsec/pixel" in m.part_note and "parity -1" in m.part_note


def test_the_similarity_is_the_least_squares_one(from_monomials):
    u = {(1, 0): 0.05, (0, 1): 0.004, (2, 0): 1e-6, (1, 2): 1e-9}
    v = {(1, 0): 0.002, (0, 1): 0.048, (1, 1): -2e-6}
    s = from_monomials(
        u, v, order=3, size=(900.0, 500.0), reference_pixel=(300.0, 260.0), unit="arcsec"
    )
    # every pixel counts as much as any other: a fine grid of their positions, evenly over the area
    x, y = (0.5 + n * (np.arange(250) + 0.5) / 250 for n in (900, 500))
    X, Y = (a.ravel() for a in np.meshgrid(x, y))
    w = s.model.predict(s.mean, X, Y) - s.model.predict(s.mean, [300.0], [260.0])
    dx, dy = X - 300.0, Y - 260.0
    design = np.concatenate([np.stack([dx, -dy], 1), np.stack([dy, dx], 1)])
    (c, q), *_ = np.linalg.lstsq(design, w.T.ravel())
    np.testing.assert_allclose(
        distortion_vectors(s).similarity, [[c, -q], [q, c]], rtol=1e-3, atol=1e-9
    )


@pytest.mark.parametrize("chip", [1, 2])
def test_the_non_linear_part_is_the_monomials_above_order_one(rich, chip):
    epoch = 2011.0
    m = distortion_vectors(rich, part="non_linear", grid=(6, 5), epoch=epoch, chip=chip)
    model = rich.model
    basis = model.basis(chip)
    groups = model.groups(1, epoch=epoch, chip=chip)
    mono = basis.to_monomials(model.effective(rich.mean, groups)[0])
    xref, yref = basis.reference_pixel
    X, Y = np.meshgrid(m.x - xref, m.y - yref)
    expected = sum(
        mono[:, k, None, None] * X**i * Y**j for k, (i, j) in enumerate(basis.terms) if i + j > 1
    )
    np.testing.assert_allclose(np.stack([m.du, m.dv]), expected, rtol=1e-9, atol=1e-9)


def test_constant_and_linear_terms_are_no_part_of_the_non_linear_one(wise):
    a = distortion_vectors(wise("W3"), part="non_linear")
    s = wise("W3")
    basis = s.model.basis()
    linear = basis.from_monomials([5.0, 0.3, -0.2, *np.zeros(basis.n_terms - 3)])
    b = distortion_vectors(type(s)(s.model, s.mean + np.tile(linear, 2), s.cov), part="non_linear")
    np.testing.assert_allclose(b.du, a.du, atol=1e-9)
    np.testing.assert_allclose(b.dv, a.dv, atol=1e-9)


def test_largest_vector_and_its_place(wise):
    m = distortion_vectors(wise("W2"))
    assert m.position_of_max == (1.0, 1016.0)
    assert m.length_max == m.length[-1, 0]


def test_wrong_parts_and_empty_solutions_are_refused(wise, from_monomials):
    with pytest.raises(InputError, match="'non_linear' if that is meant"):
        distortion_vectors(wise("W1"), part="nonlinear")
    flat = from_monomials({}, {}, order=1, size=(9.0, 9.0), reference_pixel=(5.0, 5.0))
    with pytest.raises(InputError, match="no linear part"):
        distortion_vectors(flat)
