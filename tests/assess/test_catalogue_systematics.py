"""Systematic errors of a catalogue: their covariance over the field, growth and coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import bayesdist as bd
from bayesdist.assess import Catalogue
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.assess.terms.catalogue import PUBLISHED_SYSTEMATICS
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel
from tests.assess.drawn_fields import fields_at
from tests.reduced import FULL

SIZE = (2001.0, 1001.0)
CENTRE = (1001.0, 501.0)
EPOCH = 2016.0
N = 4000


def gaia_motions(theta):
    """Lindegren et al. 2021, Eq. 25, and 25 microarcsec per year in all; mas^2 and degrees."""
    return 1e-6 * (292.0 * np.exp(-theta / 12.0) + 333.0 * np.exp(-theta / 0.25))


def gaia_positions(theta):
    """As motions of one year, and half of the variance of parallaxes with their zero point."""
    return gaia_motions(theta) + 0.5e-6 * (142.0 * np.exp(-theta / 16.0) + 400.0)


@pytest.fixture
def pixels(solution_of):
    """Maker of a solution with u, v in pixels; two chips, the second above the first."""

    def make(n_chips=1):
        chips = tuple(Chip(k + 1, "AB"[k], SIZE, CENTRE) for k in range(n_chips))
        model = DistortionModel(1, chips, unit="pix")
        mean = np.zeros(model.n_params)
        for k, chip in enumerate(chips):
            basis = model.basis(chip.number)
            for axis in (0, 1):
                monomials = np.zeros(basis.n_terms)
                monomials[basis.terms.index((1, 0) if axis == 0 else (0, 1))] = 1.0
                monomials[0] = 1100.0 * k * axis
                mean[model.coefficient_slice(chip.number, axis)] = basis.from_monomials(monomials)
        return solution_of(model, mean=mean)

    return make


def drawn(
    solution, catalogue, dates=(EPOCH,), *, scale=50.0, bright=0.0, n=N, seed=1, aligned=False
):
    term = catalogue.term(np.array(dates), bright)
    errors = error_model(solution, [term], pixel_scale=scale, aligned=aligned)
    return errors.drawn(n, np.random.default_rng(seed))


def summed(fields, names):
    return sum(fields.field(name) for name in names)


@pytest.mark.parametrize("scale", [20.0, 200.0, 3000.0])  # fields of 0.01 to 1.7 degrees
def test_draws_have_the_published_covariance_at_any_separation(pixels, scale):
    """Between positions of both chips, in pixels: V(theta) of the papers."""
    draws = drawn(pixels(2), Catalogue("Gaia DR3"), scale=scale)
    rng = np.random.default_rng(3)
    x, y = rng.uniform(1, SIZE[0], (2, 40)), rng.uniform(1, SIZE[1], (2, 40))
    names = ("Gaia DR3", "Gaia DR3 (over the field)")
    errors = np.concatenate(
        [summed(fields_at(draws, x[k], y[k], chip=k + 1), names) for k in (0, 1)], axis=1
    )
    v = y + np.array([0.0, 1100.0])[:, None]
    x, v = x.ravel() * scale / 3.6e6, v.ravel() * scale / 3.6e6
    theta = np.hypot(x[:, None] - x, v[:, None] - v)
    expected = gaia_positions(theta) / scale**2
    n = 1000  # different draws
    for axis in (0, 1):
        found = errors[:n, :, axis].T @ errors[:n, :, axis] / n
        # 6 sigma of 3,200 covariances, and the functions that represent the rest
        assert np.abs(found / expected[0, 0] - expected / expected[0, 0]).max() < 0.27
        together = np.abs(np.mean(found - expected)) / expected[0, 0]
        assert together < 5 * np.sqrt(2 / n)
        # differences, for which the common part cancels: by their distance
        apart = np.array([(errors[:n, i, axis] - errors[:n, j, axis]) for i, j in PAIRS])
        ratio = np.mean(apart**2, axis=1) / [
            2 * (expected[0, 0] - expected[i, j]) for i, j in PAIRS
        ]
        assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
        assert np.all((ratio > 0.6) & (ratio < 1.6))
    assert abs(np.mean(errors[:n, :, 0] * errors[:n, :, 1])) < 0.1 * expected[0, 0]


def even_stars(nx, ny):
    """Pixels that cover a chip evenly."""
    centres = (0.5 + (np.arange(k) + 0.5) * n / k for n, k in zip(SIZE, (nx, ny), strict=True))
    return tuple(a.ravel() for a in np.meshgrid(*centres))


def panstarrs_positions(theta):
    """Magnier et al. 2020 and Lubow et al. 2021; mas^2 and degrees."""
    return 5.0**2 + 11.5**2 * np.exp(-theta * 60.0)


@pytest.mark.parametrize(
    ("catalogue", "covariance", "scale"),
    [
        ("Gaia DR3", gaia_positions, 50.0),
        ("Pan-STARRS", panstarrs_positions, 20.0),
        ("Pan-STARRS", panstarrs_positions, 250.0),
    ],
)
def test_errors_that_exposures_absorb_by_shift_and_rotation_are_not_stated(
    pixels, catalogue, covariance, scale
):
    """Fields of V(theta) on both chips, to whose stars shift and rotation are fitted."""
    x, y = (
        a.ravel()
        for a in np.meshgrid(
            (np.arange(14) + 0.5) * SIZE[0] / 14, (np.arange(7) + 0.5) * SIZE[1] / 7
        )
    )
    u, v = np.tile(x, 2), np.concatenate([y, y + 1100.0])
    theta = np.hypot(u[:, None] - u, v[:, None] - v) * scale / 3.6e6
    root = np.linalg.cholesky(covariance(theta) / scale**2)
    rng, zero, one = np.random.default_rng(5), np.zeros_like(u), np.ones_like(u)
    errors = np.concatenate([root @ rng.standard_normal((len(u), 2000)) for _ in range(2)])
    fitted = np.stack([np.r_[one, zero], np.r_[zero, one], np.r_[-v, u]], axis=1)
    rest = errors - fitted @ np.linalg.lstsq(fitted, errors)[0]
    draws = drawn(pixels(2), Catalogue(catalogue), scale=scale, aligned=True)
    squares, plain = (
        np.concatenate(
            [
                sum(np.square(fields.sigma(name)) for name in fields.parts if catalogue in name).T
                for fields in (fields_at(d, x, y, chip=chip) for chip in (1, 2))
            ]
        )
        for d in (draws, drawn(pixels(2), Catalogue(catalogue), scale=scale))
    )
    simulated = np.mean(rest.reshape(2, len(u), -1) ** 2, axis=2).T
    assert np.sqrt(squares.mean() / simulated.mean()) == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(np.sqrt(squares / simulated), 1.0, atol=0.2)
    assert plain.mean() > 1.15 * squares.mean()


def test_an_offset_and_a_smooth_field_are_aligned_as_least_squares_does(pixels):
    """One offset vanishes; of smooth fields, independent on each chip, the fitted part does."""
    solution, model = pixels(2), pixels(2).model
    term = bd.UserTerm("Gaia", "systematic", 0.01, 0.02, "pix")
    smooth, noise = term.treatments(model, None)
    x, y = even_stars(40, 40)
    domain = EvaluationDomain(model, np.repeat([1, 2], len(x)), np.tile(x, 2), np.tile(y, 2))
    found = {}
    for name, kind in (("offset", term), ("smooth", smooth), ("noise", noise)):
        for aligned in (False, True):
            errors = error_model(solution, [kind], pixel_scale=50.0, aligned=aligned)
            found[name, aligned] = errors.drawn(500, np.random.default_rng(2))
    row = slice(0, 500)
    offset = found["offset", True].errors(domain)(row, np.zeros(1))
    assert np.all(offset == 0.0)
    u, v = np.tile(x, 2), np.concatenate([y, y + 1100.0])
    zero, one = np.zeros_like(u), np.ones_like(u)
    fitted = np.stack(
        [np.stack([one, zero], 1), np.stack([zero, one], 1), np.stack([-v, u], 1)], axis=2
    ).reshape(-1, 3)
    before, after = (found["smooth", a].errors(domain)(row, np.zeros(1)) for a in (False, True))
    before = before.reshape(500, -1).T
    expected = (before - fitted @ np.linalg.lstsq(fitted, before)[0]).T.reshape(after.shape)
    # 1600 stars of a chip in place of an integral
    np.testing.assert_allclose(after, expected, atol=0.005 * before.std())
    few = replace(domain, chip=domain.chip[::97], x=domain.x[::97], y=domain.y[::97])
    for relative in ("", "pairs"):
        at = replace(few, relative=relative)
        [field] = [f for f in found["smooth", True].at(at) if f.rows and f.rows[0].name == "Gaia"]
        np.testing.assert_allclose(
            np.sqrt(field.total()), np.sqrt(field.by_draws(row)), rtol=6 / np.sqrt(2 * 500)
        )
    noise = [d.at(few)[-1].total() for d in (found["noise", False], found["noise", True])]
    np.testing.assert_array_equal(noise[0], noise[1])


PAIRS = [(i, j) for i in range(80) for j in range(i)]


@pytest.mark.parametrize("lengths", [0.01, 1.0, 3.0, 10.0, 30.0, 100.0])
def test_differences_follow_the_covariance_in_fields_of_any_width(pixels, lengths):
    """Mean squares of differences, in the mean over the field, against 2 (V(0) - V(theta))."""
    scale = 100.0
    width = SIZE[0] * scale / 3.6e6  # degrees
    own = {"systematics_mas": 3.0, "correlation_deg": width / lengths}
    draws = drawn(pixels(), Catalogue("A", **own), scale=scale)
    rng = np.random.default_rng(6)
    x, y = (rng.uniform(1, m, 250) for m in SIZE)
    model = draws.solution.model
    domain = EvaluationDomain(model, np.ones(250, int), x, y, relative="pairs")
    square = sum(f.total() for f in draws.at(domain) if f.rows and " A" in f.rows[0].name)
    first, second = domain.pairs()
    apart = np.hypot(x[first] - x[second], y[first] - y[second]) / SIZE[0]  # in widths
    expected = 2.0 * (3.0 / scale) ** 2 * -np.expm1(-apart * lengths)
    for low, high in ((0.003, 0.02), (0.02, 0.06), (0.06, 0.2), (0.2, 0.6)):
        rows = (apart > low) & (apart < high)
        ratio = np.sqrt(square[rows].mean() / expected[rows].mean())
        assert ratio == pytest.approx(1.0, abs=0.05), (low, high)


@pytest.mark.parametrize("apart", [1e-4, 3e-4, 1e-3, 3e-3, 1e-2])
@pytest.mark.parametrize("lengths", [0.01, 1.0, 10.0, 100.0])
def test_differences_of_close_positions_follow_the_covariance_in_all_directions(
    pixels, lengths, apart
):
    """Closed form 2 (V(0) - V(theta)) for pairs in random directions, and for their draws."""
    scale, rng = 100.0, np.random.default_rng(8)
    own = {"systematics_mas": 3.0, "correlation_deg": SIZE[0] * scale / 3.6e6 / lengths}
    draws = drawn(pixels(), Catalogue("A", **own), scale=scale, n=1000)
    x, y = (rng.uniform(30, m - 30, 100) for m in SIZE)
    angle, d = rng.uniform(0, 2 * np.pi, 100), apart * SIZE[0]
    x, y = np.concatenate([x, x + d * np.cos(angle)]), np.concatenate([y, y + d * np.sin(angle)])
    expected = 2.0 * (3.0 / scale) ** 2 * -np.expm1(-apart * lengths)
    domain = EvaluationDomain(draws.solution.model, np.ones(200, int), x, y, relative="pairs")
    square = sum(f.total() for f in draws.at(domain) if f.rows and " A" in f.rows[0].name)
    first, second = domain.pairs()
    ratio = np.sqrt(square[second == first + 100] / expected)
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)
    fields = fields_at(draws, x, y)
    errors = summed(fields, [n for n in fields.parts if n.startswith("reference catalogue A")])
    of_draws = np.mean((errors[:, 100:] - errors[:, :100]) ** 2) / expected
    assert np.sqrt(of_draws) == pytest.approx(1.0, abs=0.05 + 0.03)  # of 1000 draws


@pytest.mark.parametrize("degrees", [1e12, 1e3, 1e-12, 1e-300])
def test_correlation_lengths_far_from_the_field_are_limits(pixels, degrees):
    """An offset of the whole field, or independent errors."""
    catalogue = Catalogue("A", systematics_mas=3.0, correlation_deg=degrees)
    fields = fields_at(drawn(pixels(), catalogue), [1.0, 1500.0], [1.0, 900.0])
    names = [name for name in fields.parts if name.startswith("reference catalogue A")]
    errors = summed(fields, names)
    np.testing.assert_allclose(
        sum(np.square(fields.sigma(name)) for name in names), 9.0 / 50.0**2, rtol=1e-6
    )
    difference = np.std(errors[:, 1] - errors[:, 0]) / (3.0 / 50.0)
    separation = np.hypot(1499.0, 899.0) * 50.0 / 3.6e6
    expected = np.sqrt(2.0 * -np.expm1(-separation / degrees))
    assert difference == pytest.approx(expected, rel=0.15, abs=1e-6)


@pytest.mark.parametrize("scale", [50.0, 500.0])
def test_mean_squares_are_exact_at_positions_and_for_differences(pixels, scale):
    solution = pixels()
    draws = drawn(solution, Catalogue("Gaia DR3"), scale=scale)
    rng = np.random.default_rng(4)
    fields = fields_at(draws, rng.uniform(1, SIZE[0], 300), rng.uniform(1, SIZE[1], 300))
    names = [name for name in fields.parts if name.startswith("Gaia")]
    assert names[:2] == ["Gaia DR3", "Gaia DR3 (over the field)"]
    total = sum(np.square(fields.sigma(name)) for name in names[:2])
    np.testing.assert_allclose(total, gaia_positions(0.0) / scale**2, rtol=1e-6)
    constant, rest = (np.square(fields.sigma(name)).mean() for name in names[:2])
    assert rest < constant  # of a small field


def test_the_rest_is_independent_of_constant_and_tilt(pixels):
    draws = drawn(pixels(), Catalogue("Gaia DR3"))
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(1, SIZE[0], 9), np.linspace(1, SIZE[1], 9)))
    fields = fields_at(draws, x, y)
    tilt, rest = (fields.field(name)[:1000, :, 0] for name in fields.parts[1:3])
    plane = np.column_stack([np.ones_like(x), x, y])
    residual = tilt - (plane @ np.linalg.lstsq(plane, tilt.T, rcond=None)[0]).T
    assert np.abs(residual).max() < 1e-9 * tilt.std()
    correlation = (tilt.T @ rest) / 1000 / np.outer(tilt.std(axis=0), rest.std(axis=0))
    assert np.abs(correlation).max() < 6 / np.sqrt(1000)


@pytest.mark.parametrize(("dates", "years"), [([2006.0], -10.0), ([2024.0, 2026.0], 9.0)])
def test_errors_of_motions_grow_with_the_time_from_the_epoch(pixels, dates, years):
    fields = fields_at(drawn(pixels(), Catalogue("Gaia DR3"), dates), CENTRE[:1], CENTRE[1:])
    names = [name for name in fields.parts if "motions" in name]
    total = sum(np.square(fields.sigma(name)) for name in names)
    np.testing.assert_allclose(total, years**2 * gaia_motions(0.0) / 50.0**2, rtol=1e-6)


def test_the_frame_of_bright_stars_rotates(pixels):
    """Cantat-Gaudin & Brandt 2021: up to 0.08 mas/yr; w^2 / 3 on an axis in the mean of the sky."""
    square = {}
    for bright in (0.0, 0.5, 1.0):
        fields = fields_at(
            drawn(pixels(), Catalogue("Gaia DR3"), [2026.0], bright=bright), 9.0, 9.0
        )
        names = [name for name in fields.parts if "motions" in name]
        square[bright] = sum(np.square(fields.sigma(name)) for name in names).mean()
    spin = 10.0**2 * 0.08**2 / 3.0 / 50.0**2
    assert square[1.0] - square[0.0] == pytest.approx(spin, rel=1e-6)
    assert square[0.5] - square[0.0] == pytest.approx(spin / 4, rel=1e-6)
    told = Catalogue("Gaia DR3", bright_fraction=0.5)
    fields = fields_at(drawn(pixels(), told, [2026.0], bright=1.0), 9.0, 9.0)
    again = sum(np.square(fields.sigma(n)) for n in fields.parts if "motions" in n).mean()
    assert again == pytest.approx(square[0.5], rel=1e-12)


def test_numbers_of_the_user_replace_published_ones(pixels):
    own = {"systematics_mas": 2.0, "correlation_deg": 0.1, "motions_mas_yr": 0.5, "epoch": 2000.0}
    for name in ("Gaia DR3", "UKIDSS"):
        draws = drawn(pixels(), Catalogue(name, **own, source="a paper"), [2010.0])
        fields = fields_at(draws, CENTRE[:1], CENTRE[1:])
        parts = [part for part in fields.parts if name in part]
        assert parts[0] == ("Gaia DR3" if name == "Gaia DR3" else "reference catalogue UKIDSS")
        square = [np.square(fields.sigma(part)) for part in parts]
        np.testing.assert_allclose(square[0] + square[1], 4.0 / 50.0**2, rtol=1e-6)
        np.testing.assert_allclose(square[2] + square[3], 25.0 / 50.0**2, rtol=1e-6)
        (row,) = [r for field in draws.at(fields.domain) for r in field.rows if r.name == parts[0]]
        assert row.source == "given by the user: a paper"


def test_every_published_catalogue_makes_positive_covariances(pixels):
    for name, systematics in PUBLISHED_SYSTEMATICS.items():
        fields = fields_at(drawn(pixels(), Catalogue(name), [2020.0]), CENTRE[:1], CENTRE[1:])
        parts = [part for part in fields.parts if part.startswith(name)]
        assert np.all(np.concatenate([fields.sigma(part) for part in parts[:1]]) > 0), name
        assert systematics.source.startswith("published: ")
        # no release of Gaia publishes a covariance of its positions
        assert ("assumption" in systematics.of_positions) == name.startswith("Gaia")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "UKIDSS"}, "no published errors .* but of Gaia DR3, Gaia EDR3, .* give syst"),
        ({"name": "UKIDSS", "systematics_mas": 1.0}, "without correlation_deg"),
        ({"name": "Gaia DR3", "correlation_deg": 1.0}, "without systematics_mas"),
        ({"name": "Gaia DR3", "motions_mas_yr": 1.0}, "without systematics_mas"),
        ({"name": "A", "systematics_mas": -1.0, "correlation_deg": 1.0}, "systematics_mas is -1"),
        ({"name": "A", "systematics_mas": 1.0, "correlation_deg": 0.0}, "correlation_deg is 0"),
        ({"name": "Gaia DR3", "bright_fraction": 1.5}, "bright_fraction is 1.5"),
        ({"name": "Gaia DR3", "sigma": 1.0, "systematics_mas": 1.0}, "sigma and systematics_mas"),
        (
            {"name": "A", "systematics_mas": 1.0, "correlation_deg": 1.0, "motions_mas_yr": 1.0},
            "motions_mas_yr is given without epoch",
        ),
    ],
)
def test_a_catalogue_that_says_too_little_or_too_much_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        Catalogue(**options)


def test_without_dates_or_scale_nothing_is_guessed(pixels):
    with pytest.raises(InputError, match="date of the exposures is not known"):
        drawn(pixels(), Catalogue("Gaia DR3"), dates=())
    with pytest.raises(InputError, match="without a pixel scale"):
        drawn(pixels(), Catalogue("Gaia DR3"), scale=None)


# -- coverage -------------------------------------------------------------------------------------

TRUTHS = 1000 if FULL else 200
NOISE = 2e-4  # pix, of one star


@pytest.mark.parametrize("years", [0.0, 10.0])
def test_stated_errors_cover_calibrations_on_a_catalogue_with_this_covariance(years):
    """Fits to stars whose catalogue errors are exact draws of V(theta), at one place and across."""
    scale, n, rng = 100.0, 150, np.random.default_rng(int(years) + 8)
    probes = np.array([[300.0, 200.0], [1800.0, 900.0]])
    catalogue, hits = Catalogue("Gaia DR3", bright_fraction=0.0), {"place": [], "across": []}
    for _ in range(TRUTHS):
        x, y = rng.uniform(1, SIZE[0], n), rng.uniform(1, SIZE[1], n)
        theta = np.hypot(x[:, None] - x, y[:, None] - y) * scale / 3.6e6
        V = (gaia_positions(theta) + years**2 * gaia_motions(theta)) / scale**2
        field = rng.standard_normal((2, n)) @ np.linalg.cholesky(V).T
        u, v = np.stack([x - CENTRE[0], y - CENTRE[1]]) + field + NOISE * rng.normal(size=(2, n))
        stars = bd.Matches(x=x, y=y, u=u, v=v, sigma_u=np.full(n, NOISE), sigma_v=np.full(n, NOISE))
        model = bd.build_model(stars, order=1, size=SIZE, reference_pixel=CENTRE)
        fit = bd.fit_linear(stars, model)
        term = catalogue.term([EPOCH + years])
        fields = fields_at(error_model(fit, [term], pixel_scale=scale).drawn(300, rng), *probes.T)
        joint = fields.field("model")
        found = np.reshape(fit.mean, (2, -1)) @ fit.model.basis().evaluate(*probes.T).T
        error = found - (probes - CENTRE).T
        hits["place"] += [error[a, 0] / joint[:, 0, a].std() for a in (0, 1)]
        apart = joint[:, 1] - joint[:, 0]
        hits["across"] += [(error[a, 1] - error[a, 0]) / apart[:, a].std() for a in (0, 1)]
    spread = 4 * np.sqrt(0.25 / (2 * TRUTHS))
    for name, deviations in hits.items():
        z = np.abs(deviations)
        assert np.mean(z < 1.0) == pytest.approx(0.683, abs=spread), name
        assert np.mean(z < 1.96) == pytest.approx(0.95, abs=spread), name
