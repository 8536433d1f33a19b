"""Periods against the combined model: brute-force refits, exact covariances, honest p-values."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.time import Time
from scipy.stats import kstest, ncx2

from bayesdist.data import Matches
from bayesdist.diagnose.periods import period_verdict
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import Rejection, fit_linear
from bayesdist.infer.compare.periods import (
    PeriodComparison,
    compare_periods,
    mjd_periods,
    sum_by_period,
    sums_of_stars,
)
from bayesdist.infer.equations.scaled import chi_square
from bayesdist.infer.stars.stars import prepare
from bayesdist.model import DistortionModel, TimeDependence
from tests.batched import in_batches
from tests.infer.support import CHIP, SIZE, TWO_CHIPS, UNCLIPPED, legendre_design, simulated

pytestmark = pytest.mark.usefixtures("one_thread")

PERIODS = {"early": (2010.0, 2010.1), "middle": (2010.3, 2010.4), "late": (2010.6, 2010.9)}
MODEL = DistortionModel(2, (CHIP,))
K = MODEL.n_terms


def dated(rng, n, *, order=2, sigma=0.1, change=None, shares=(0.5, 0.3, 0.2), quoted=1.0):
    """Pairs of three periods; `change` is added to the coefficients of the last one."""
    period = rng.choice(3, size=n, p=shares)
    start, stop = np.array(list(PERIODS.values()))[period].T
    x, y = (rng.uniform(0.5, s + 0.5, n) for s in SIZE)
    phi = legendre_design(order, x, y)
    uv = np.column_stack([x, y])
    if change is not None:
        uv = uv + (period == 2)[:, None] * (phi @ change.reshape(2, -1).T)
    sigmas = sigma * rng.uniform(0.5, 2.0, (n, 2))
    uv = uv + rng.standard_normal((n, 2)) * sigmas
    return Matches(x, y, *uv.T, sigma_u=sigmas[:, 0] * quoted, sigma_v=sigmas[:, 1] * quoted,
                      epoch=rng.uniform(start, stop))  # fmt: skip


def period_sums(fit, table, periods, *, radial_weight=1.0):
    """Sums over the pairs of each period."""

    def task(part):
        return sums_of_stars(prepare(fit.model, part)[0], fit, radial_weight)

    return sum_by_period(table, periods, task)


def combined_cov(found: PeriodComparison) -> np.ndarray:
    """Covariance of the combined model."""
    return (found.fractions @ found.covs @ found.fractions.swapaxes(1, 2)).sum(axis=0)


def compared(table, model=MODEL, *, rescale=False, radial_weight=1.0) -> PeriodComparison:
    fit = fit_linear(table, model, rejection=Rejection(np.inf, None, radial_weight))
    sums = period_sums(fit, table, PERIODS, radial_weight=radial_weight)
    return compare_periods(fit, sums, rescale=rescale)


def verdict(found, rng, tolerance=None):
    changes = {name: found.positions(name, rng=rng) for name in found.names}
    return period_verdict(found, changes, tolerance)


def part(table, name):
    start, stop = PERIODS[name]
    return table.select((table.epoch >= start) & (table.epoch < stop))


def test_the_models_are_those_of_separate_fits(rng):
    table = dated(rng, 1500)
    found = compared(table)
    for k, name in enumerate(PERIODS):
        alone = fit_linear(part(table, name), MODEL, **UNCLIPPED)
        np.testing.assert_allclose(found.means[k], alone.mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.covs[k], alone.cov, rtol=1e-8, atol=1e-14)
        assert found.counts[k] == alone.n_rows
    whole = fit_linear(table, MODEL, **UNCLIPPED)
    np.testing.assert_allclose(found.combined, whole.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(combined_cov(found), whole.cov, rtol=1e-8, atol=1e-14)


def test_pairs_outside_all_periods_are_not_used(rng):
    """The combined model is that of the periods, not of all data that the fit saw."""
    table = dated(rng, 1500)
    fit = fit_linear(table, MODEL, **UNCLIPPED)
    two = {name: PERIODS[name] for name in ("early", "late")}
    found = compare_periods(fit, period_sums(fit, table, two), rescale=False)
    inside = part(table, "early"), part(table, "late")
    whole = fit_linear(Matches.concatenate(inside), MODEL, **UNCLIPPED)
    np.testing.assert_allclose(found.combined, whole.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(combined_cov(found), whole.cov, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize("corner", [1.0, 10.0])
def test_the_covariance_of_differences_star_by_star(rng, corner):
    """Each estimate is linear in the data: its covariance is L Sigma L^T, from no sums at all."""
    table = dated(rng, 300)
    found = compared(table, radial_weight=corner)
    phi = legendre_design(2, table.x, table.y)
    X, Y = ((2 * p - s - 1) / s for p, s in zip((table.x, table.y), SIZE, strict=True))
    extra = 1 + (corner - 1) * (X**2 + Y**2) / 2
    names = list(PERIODS)
    inside = [(table.epoch >= a) & (table.epoch < b) for a, b in PERIODS.values()]
    late = names.index("late")
    for axis, sigma in enumerate((table.sigma_u, table.sigma_v)):
        weight = extra / sigma**2

        def map_of(use, weight=weight):
            weighted = phi.T * (weight * use)
            return np.linalg.solve(weighted @ phi, weighted)

        block = slice(axis * K, (axis + 1) * K)
        for against in (None, "early"):
            other = np.ones(300, bool) if against is None else inside[names.index(against)]
            L = map_of(inside[late]) - map_of(other)
            difference, cov = found.difference("late", against)
            expected = (L * sigma**2) @ L.T
            scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
            np.testing.assert_allclose(cov[block, block] / scale, expected / scale, atol=1e-8)
            uv = (table.u, table.v)[axis]
            np.testing.assert_allclose(difference[block], L @ uv, rtol=0, atol=1e-8)


def test_shared_data_make_the_covariance_that_of_the_period_less_the_combined(rng):
    found = compared(dated(rng, 1000))
    for k, name in enumerate(PERIODS):
        _, cov = found.difference(name)
        np.testing.assert_allclose(cov, found.covs[k] - combined_cov(found), rtol=1e-6, atol=1e-15)
    _, cov = found.difference("late", "early")
    np.testing.assert_allclose(cov, found.covs[2] + found.covs[0], rtol=1e-12)


def test_a_period_with_nearly_all_data_keeps_its_digits(rng):
    table = dated(rng, 60_000, shares=(0.998, 0.001, 0.001))
    found = compared(table)
    difference, cov = found.difference("early")
    # theta_1 - theta = A (theta_1 - theta_rest), with A the share of the rest
    rest = Matches.concatenate([part(table, "middle"), part(table, "late")])
    alone = [fit_linear(one, MODEL, **UNCLIPPED) for one in (part(table, "early"), rest)]
    share = combined_cov(found) @ np.linalg.inv(alone[1].cov)
    expected = share @ (alone[0].cov + alone[1].cov) @ share.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(cov / scale, expected / scale, atol=1e-8)
    np.testing.assert_allclose(
        difference, share @ (alone[0].mean - alone[1].mean), rtol=0, atol=1e-10
    )


def test_homogeneity_is_the_classical_sum(rng):
    """sum (theta_p - theta)^T N_p (theta_p - theta), the between-groups sum of squares."""
    found = compared(dated(rng, 1000))
    classical = sum(
        (mean - found.combined) @ np.linalg.solve(cov, mean - found.combined)
        for mean, cov in zip(found.means, found.covs, strict=True)
    )
    chi2, dof, p = found.homogeneity
    assert chi2 == pytest.approx(classical, rel=1e-8) and dof == 2 * 2 * K
    assert 0 < p < 1


def test_the_field_is_as_good_as_its_coefficients(rng):
    """Chi-square of the differences on a grid, with their joint covariance, by pseudo-inverse."""
    found = compared(dated(rng, 1000))
    difference, cov = found.difference("late")
    x, y = (p.ravel() for p in np.meshgrid(np.linspace(1, 1000, 6), np.linspace(1, 800, 6)))
    phi = np.kron(np.eye(2), MODEL.basis().evaluate(x, y))
    field, joint = phi @ difference, phi @ cov @ phi.T
    values, vectors = np.linalg.eigh(joint)
    real = values > 1e-9 * values[-1]
    chi2 = ((vectors[:, real].T @ field) ** 2 / values[real]).sum()
    most = found.positions("late", rng=rng, grid=6)
    assert real.sum() == most.dof == 2 * K
    assert chi2 == pytest.approx(most.chi2, rel=1e-6)
    radial = np.hypot(*field.reshape(2, -1))
    k = int(np.argmax(radial))
    assert most.largest == pytest.approx(radial[k]) and most.at == pytest.approx((x[k], y[k]))
    pair = joint[np.ix_([k, k + 36], [k, k + 36])]
    along = field[[k, k + 36]] / radial[k]
    assert most.sigma == pytest.approx(np.sqrt(along @ pair @ along))


def test_the_map_of_differences_against_its_covariance_by_draws(rng):
    """Vectors by evaluating both models; each p-value from the scatter of draws at its place."""
    change = np.zeros(2 * K)
    change[1] = 0.03
    found = compared(dated(rng, 1000, change=change))
    field = found.field("late", "early", grid=(4, 3))
    assert field.x[[0, -1]].tolist() == [1.0, 1000.0] and field.y[[0, -1]].tolist() == [1.0, 800.0]
    x, y = (a.ravel() for a in np.meshgrid(field.x, field.y))
    late, early = (MODEL.predict(found.means[k], x, y) for k in (2, 0))
    vectors = np.column_stack([field.du.ravel(), field.dv.ravel()])
    np.testing.assert_allclose(vectors, late - early, rtol=0, atol=1e-9)
    difference, cov = found.difference("late", "early")
    phi = legendre_design(2, x, y)
    draws = rng.multivariate_normal(difference, cov, 20_000)
    at = np.stack([draws[:, :K] @ phi.T, draws[:, K:] @ phi.T], axis=-1)
    for n in range(len(x)):
        z2 = vectors[n] @ np.linalg.solve(np.cov(at[:, n].T), vectors[n])
        assert field.p_value.ravel()[n] == pytest.approx(np.exp(-z2 / 2), rel=0.3)


def test_monomial_coefficients_are_those_of_pixel_offsets(rng):
    """The same difference, evaluated either way; errors from the draws of the difference."""
    found = compared(dated(rng, 1000))
    legendre, monomial = (found.coefficients("late", monomial=m) for m in (False, True))
    x, y = rng.uniform(1, 800, (2, 50))
    powers = np.stack([(x - 500.0) ** i * (y - 400.0) ** j for i, j in MODEL.basis().terms], axis=1)
    phi = MODEL.basis().evaluate(x, y)
    for block in (slice(0, K), slice(K, 2 * K)):
        np.testing.assert_allclose(
            powers @ monomial.difference[block], phi @ legendre.difference[block], atol=1e-12
        )
    _, cov = found.difference("late")
    draws = rng.multivariate_normal(np.zeros(2 * K), cov, 4000)
    spread = np.hstack([MODEL.basis().to_monomials(draws[:, s]) for s in
                        (slice(0, K), slice(K, 2 * K))]).std(axis=0)  # fmt: skip
    np.testing.assert_allclose(monomial.sigma, spread, rtol=0.06)
    np.testing.assert_allclose(legendre.z, legendre.difference / np.sqrt(np.diag(cov)))
    assert legendre.names == MODEL.names and ((legendre.p_value > 0) & (legendre.p_value < 1)).all()


def test_probabilities_are_uniform_where_nothing_changes(full):
    """Of each coefficient, of the field, of the largest difference, of all periods together."""
    n, found = 1000 if full else 120, []
    for seed in range(n):
        rng = np.random.default_rng(seed)
        one = compared(dated(rng, 120, order=1), DistortionModel(1, (CHIP,)))
        most = one.positions("late", rng=rng, grid=5, n_draws=400)
        pair = chi_square(*one.difference("early", "late"))
        found.append([
            one.homogeneity[2], most.p_field, most.p_value, pair.p_value,
            *one.coefficients("middle").p_value, *one.coefficients("late", monomial=True).p_value,
        ])  # fmt: skip
    columns = np.array(found).T
    worst = min(kstest(column, "uniform").pvalue for column in columns)
    assert worst > 0.001 / len(columns)


def test_a_planted_change_is_found_as_often_as_it_must_be(full):
    """Chi-square follows the non-central distribution of the change and its covariance."""
    n, quantiles = 400 if full else 60, []
    change = np.zeros(6)
    change[1], change[5] = 0.12, -0.08  # P_1(X) of u, P_1(Y) of v
    for seed in range(n):
        rng = np.random.default_rng(5000 + seed)
        one = compared(dated(rng, 150, order=1, change=change), DistortionModel(1, (CHIP,)))
        _, cov = one.difference("late", "early")
        strength = change @ np.linalg.solve(cov, change)
        chi2, dof, _ = chi_square(*one.difference("late", "early"))
        quantiles.append(ncx2.cdf(chi2, dof, strength))
    assert strength > 10
    assert kstest(quantiles, "uniform").pvalue > 0.001


def test_a_change_is_placed_measured_and_said(rng):
    change = np.zeros(2 * K)
    change[3] = 0.08  # P_2(X) of u: the largest part at the left and right edges
    table = dated(rng, 8000, sigma=0.05, change=change)
    found = compared(table)
    most = found.positions("late", "early", rng=rng)
    assert abs(most.largest - 0.08) < 4 * most.sigma + 0.01 and most.p_value < 1e-3
    assert most.at[0] in (1.0, 1000.0) and most.p_field < 1e-12
    said = verdict(found, rng, 0.5)
    assert said.startswith("The distortion changes") and "p < 1e-12" in said
    assert "late differs most" in said
    assert said.endswith("all periods are below the tolerance of 0.5 pix.")
    said = verdict(found, rng, 0.01)
    assert "beyond the tolerance of 0.01 pix: " in said and said.endswith("late.")
    quiet = compared(dated(rng, 8000, sigma=0.05))
    assert verdict(quiet, rng).startswith("No change is seen")
    level = max(quiet.positions(name, rng=rng).largest for name in PERIODS)
    assert "do not decide" in verdict(quiet, rng, level)


def test_quoted_errors_that_are_too_small_do_not_make_a_change(rng):
    table = dated(rng, 4000, quoted=0.2)
    trusting, wary = (compared(table, rescale=r) for r in (False, True))
    assert trusting.homogeneity[2] < 1e-6 < 0.001 < wary.homogeneity[2]
    assert trusting.homogeneity[0] == pytest.approx(wary.homogeneity[0] * wary.error_scale**2)
    assert trusting.error_scale == 1.0
    assert wary.error_scale == pytest.approx(5.0, abs=4 * 5 / np.sqrt(2 * 8000))
    # chi-square per degree of freedom of the separate fits, added
    fits = [fit_linear(part(table, name), MODEL, **UNCLIPPED) for name in PERIODS]
    expected = sum(f.chi2 for f in fits) / sum(f.dof for f in fits)
    assert wary.error_scale**2 == pytest.approx(expected, rel=1e-9)


def test_pieces_and_parts_of_a_period_add_up(rng):
    table = dated(rng, 1000)
    fit = fit_linear(table, MODEL)
    whole = period_sums(fit, table, PERIODS)
    cut = in_batches(table, 130)
    assert len(cut.readers()) > 5
    pieces = period_sums(fit, cut, PERIODS)
    for name in PERIODS:
        assert pieces[name].n == whole[name].n
        for field in ("weight", "right"):
            one, other = (getattr(s[name].equations, field) for s in (pieces, whole))
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-6)
    assert sum(one.n for one in whole.values()) == fit.n_used
    # two periods as one are the period that spans both
    both = period_sums(fit, table, {"early": PERIODS["early"], "rest": (2010.3, 2010.9)})
    joined = {"early": whole["early"], "rest": whole["middle"] + whole["late"]}
    one, other = (compare_periods(fit, s) for s in (both, joined))
    np.testing.assert_allclose(one.means, other.means, rtol=0, atol=1e-10)
    assert one.counts == other.counts


def test_false_matches_stay_out_by_one_rule_for_all_periods(rng):
    table = dated(rng, 3000)
    u = table.u.copy()
    false = rng.choice(3000, 150, replace=False)
    u[false] += rng.uniform(3, 6, 150)
    table = Matches(table.x, table.y, u, table.v, sigma_u=table.sigma_u, sigma_v=table.sigma_v,
                       epoch=table.epoch)  # fmt: skip
    fit = fit_linear(table, MODEL)
    found = compare_periods(fit, period_sums(fit, table, PERIODS))
    assert sum(found.counts) == fit.n_used <= 2850
    np.testing.assert_allclose(found.combined, fit.mean, rtol=0, atol=1e-9)
    assert found.homogeneity[2] > 1e-3


def test_periods_of_days_about_modified_julian_dates():
    """Those of Appendix C: five days each; an epoch belongs to the period that its date is in."""
    centres = [55212.5, 55262.5, 55312.5, 55362.5, 55412.5]
    periods = mjd_periods(centres, 5.0)
    assert list(periods) == ["55212.5", "55262.5", "55312.5", "55362.5", "55412.5"]
    dates = np.linspace(55150.0, 55500.0, 701)
    epochs = Time(dates, format="mjd", scale="tt").decimalyear
    for centre, (start, stop) in zip(centres, periods.values(), strict=True):
        inside = (dates >= centre - 2.5) & (dates < centre + 2.5)
        np.testing.assert_array_equal((epochs >= start) & (epochs < stop), inside)
        assert inside.sum() == 10
    with pytest.raises(InputError, match="0 days"):
        mjd_periods(centres, 0.0)


def test_two_chips(rng):
    """The largest difference is looked for on all chips."""
    _, table, truth = simulated(3, 4000, chips=TWO_CHIPS, order=1, sigma=0.02)
    model = DistortionModel(1, TWO_CHIPS)
    start = np.where(rng.uniform(size=4000) < 0.5, 2010.0, 2010.3)
    late = (start == 2010.3) & (table.chip == 1)
    moved = Matches(table.x, table.y, table.u + 0.5 * late, table.v, sigma_u=table.sigma_u,
                       sigma_v=table.sigma_v, epoch=start + 0.05, chip=table.chip,
                       chip_numbers=table.chip_numbers)  # fmt: skip
    fit = fit_linear(moved, model, **UNCLIPPED)
    two = {name: PERIODS[name] for name in ("early", "middle")}
    found = compare_periods(fit, period_sums(fit, moved, two), rescale=False)
    most = found.positions("middle", "early", rng=rng)
    assert most.chip == 2 and abs(most.largest - 0.5) < 5 * most.sigma
    change = found.coefficients("middle", "early", monomial=True)
    constant = [k for k, name in enumerate(change.names) if abs(change.difference[k]) > 0.3]
    assert [model.parameters[k].chip for k in constant] == [2]
    assert truth.false.sum() == 0


def test_what_cannot_be_compared_is_refused(rng):
    table = dated(rng, 500)
    fit = fit_linear(table, MODEL)
    sums = period_sums(fit, table, PERIODS)
    with pytest.raises(InputError, match="the number of periods is 1"):
        period_sums(fit, table, {"early": PERIODS["early"]})
    with pytest.raises(InputError, match="periods early and other overlap"):
        period_sums(fit, table, PERIODS | {"other": (2010.05, 2010.2)})
    with pytest.raises(InputError, match=r"period none .* has no pairs"):
        period_sums(fit, table, PERIODS | {"none": (2012.0, 2013.0)})
    with pytest.raises(InputError, match="period back starts at"):
        period_sums(fit, table, PERIODS | {"back": (2013.0, 2012.0)})
    bare = Matches(table.x, table.y, table.u, table.v, sigma_u=table.sigma_u,
                      sigma_v=table.sigma_v)  # fmt: skip
    with pytest.raises(InputError, match="need an epoch"):
        period_sums(fit, bare, PERIODS)
    drifting = DistortionModel(2, (CHIP,), time=TimeDependence((("u", 1, 0),), (2010.0,)))
    with pytest.raises(InputError, match="time-dependent terms"):
        compare_periods(fit_linear(table, drifting), sums)
    found = compare_periods(fit, sums)
    with pytest.raises(InputError, match="there is no period 'noon'"):
        found.difference("noon")
    with pytest.raises(InputError, match="compared with itself"):
        found.difference("late", "late")
    with pytest.raises(InputError, match="the number of periods is 1"):
        compare_periods(fit, {"late": sums["late"]})
    few = dated(rng, 300, shares=(0.6, 0.395, 0.005))
    fit = fit_linear(few, MODEL)
    with pytest.raises(DegenerateError, match=r"degenerate|not determined"):
        compare_periods(fit, period_sums(fit, few, PERIODS))
