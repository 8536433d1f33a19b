"""The true distortion and look-up tables against what ACS ISR 2015-06 and the handbook print."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.missions.hst.simulate import ACS_FILTERS, acs_solution
from bayesdist.missions.hst.simulate.making import detector_tables, filter_tables

# Tables 1-3: chip, RDATE: (alpha, beta)
A_2 = {
    (1, 2004.5): (0.98205648, -9.22e-06),
    (2, 2004.5): (0.99468101, -9.16e-06),
    (1, 2012.5): (0.98196909, -2.18e-05),
    (2, 2012.5): (0.99459657, -2.26e-05),
}
B_3 = {
    (1, 2004.5): (0.97263238, 2.42e-06),
    (2, 2004.5): (1.00622300, 3.30e-06),
    (1, 2012.5): (0.97263233, -1.12e-06),
    (2, 2012.5): (1.00621870, -8.04e-07),
}
B_2 = {
    (1, 2004.5): (0.080947069, 3.617e-05),
    (2, 2004.5): (0.068598586, 3.532e-05),
    (1, 2012.5): (0.081139194, 3.235e-05),
    (2, 2012.5): (0.068779336, 3.070e-05),
}


def gradient(chip, epoch, filter="F606W"):
    """Derivatives of (u, v) by (x, y) at the zero point, from differences of positions.

    Central differences over 16 and 32 pixels, extrapolated: the error is of the fifth order.
    """
    model, theta = acs_solution(filter)

    def difference(h):
        x = np.array([2048.0 + h, 2048.0 - h, 2048.0, 2048.0])
        y = np.array([1024.0, 1024.0, 1024.0 + h, 1024.0 - h])
        w = model.predict(theta, x, y, epoch=epoch, chip=chip)
        return np.stack([(w[0] - w[1]) / (2 * h), (w[2] - w[3]) / (2 * h)], axis=-1)

    return (4 * difference(16.0) - difference(32.0)) / 3


@pytest.mark.parametrize(("chip", "date"), A_2)
@pytest.mark.parametrize(
    ("table", "axis", "by"), [(A_2, 0, 0), (B_3, 1, 1), (B_2, 1, 0)], ids=["A_2", "B_3", "B_2"]
)
def test_linear_terms_are_those_of_tables_1_to_3(chip, date, table, axis, by):
    alpha, beta = table[chip, date]
    at = [gradient(chip, date + dt)[axis, by] for dt in (-1.5, 0.0, 1.5)]
    assert at[1] == pytest.approx(alpha, abs=2e-10)
    assert (at[2] - at[0]) / 3.0 == pytest.approx(beta, abs=2e-10)


def test_the_reference_chip_holds_the_gauge():
    model, theta = acs_solution()
    for epoch in (2002.3, 2014.5):
        here = model.predict(theta, [2048.0], [1024.0], epoch=epoch, chip=2)[0]
        np.testing.assert_allclose(here, 0.0, atol=1e-9)
        assert gradient(2, epoch)[0, 1] == pytest.approx(0.0, abs=1e-10)
        other = model.predict(theta, [2048.0], [1024.0], epoch=epoch, chip=1)[0]
        assert other[1] == pytest.approx(2079.58, abs=1e-9)  # Section 4.4.1


def test_the_distortion_is_as_large_as_that_of_acs():
    """Handbook 4.1.4: axes ~85 degrees apart, area 0.89 to 1.08, displacements up to ~82 pixels."""
    model, theta = acs_solution()
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(1, 4096, 65), np.linspace(1, 2048, 33)))
    areas, largest = [], []
    for chip in (1, 2):
        J = gradient(chip, 2004.5)
        cosine = J[:, 0] @ J[:, 1] / np.prod(np.linalg.norm(J, axis=0))
        assert 84.0 < np.degrees(np.arccos(cosine)) < 87.0
        w = model.predict(theta, x, y, epoch=2004.5, chip=chip)
        centre = model.predict(theta, [2048.0], [1024.0], epoch=2004.5, chip=chip)
        straight = centre + np.column_stack([x - 2048.0, y - 1024.0]) @ J.T
        largest.append(np.hypot(*(w - straight).T).max())
        right = model.predict(theta, x + 0.5, y, epoch=2004.5, chip=chip)
        left = model.predict(theta, x - 0.5, y, epoch=2004.5, chip=chip)
        up = model.predict(theta, x, y + 0.5, epoch=2004.5, chip=chip)
        down = model.predict(theta, x, y - 0.5, epoch=2004.5, chip=chip)
        a, b = right - left, up - down
        areas.append(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert min(largest) > 50.0 and max(largest) < 90.0
    # against the area in the middle of the two chips, where these touch
    middle = np.abs(x - 2048.0) < 64
    central = (areas[0][middle & (y < 65)].mean() + areas[1][middle & (y > 1983)].mean()) / 2
    ratio = np.concatenate(areas) / central
    assert ratio.min() == pytest.approx(0.89, abs=0.02)
    assert ratio.max() == pytest.approx(1.08, abs=0.02)


def test_the_chips_touch_as_they_do_on_the_focal_plane():
    """Between the last row of WFC2 and the first of WFC1 is a gap of some 50 pixels, no overlap."""
    model, theta = acs_solution()
    x = np.linspace(1, 4096, 9)
    low = model.predict(theta, x, np.full(9, 2048.0), epoch=2004.5, chip=2)
    high = model.predict(theta, x, np.full(9, 1.0), epoch=2004.5, chip=1)
    gap = high - low
    assert np.all((gap[:, 1] > 30) & (gap[:, 1] < 70)) and np.all(np.abs(gap[:, 0]) < 10)


@pytest.mark.parametrize(("filter", "pixels"), [("F435W", 0.05), ("F475W", 0.05), ("F814W", -0.1)])
def test_filters_differ_in_scale_as_in_figure_25(filter, pixels):
    for chip in (1, 2):
        base, other = gradient(chip, 2006.0), gradient(chip, 2006.0, filter)
        assert 2048 * (other - base)[0, 0] == pytest.approx(pixels, abs=0.006)
        # Figure 26: B_2 differs on WFC2 in F814W, by 0.06 px, and nowhere else
        expected = 0.06 if (filter, chip) == ("F814W", 2) else 0.0
        assert abs(2048 * (other - base)[1, 0]) == pytest.approx(expected, abs=0.01)
        # Section 4.4.4: the drift is the same in all filters
        drift = gradient(chip, 2006.0, filter) - gradient(chip, 2003.0, filter)
        np.testing.assert_allclose(
            drift, gradient(chip, 2006.0) - gradient(chip, 2003.0), rtol=0, atol=2e-9
        )


def test_other_filters_are_refused():
    with pytest.raises(InputError, match=r"no filter 'F850LP'.*F814W"):
        acs_solution("F850LP")


@pytest.fixture(scope="module")
def tables():
    rng = np.random.default_rng(5)
    out = list(detector_tables(rng))
    for name in ACS_FILTERS:
        out += filter_tables(name, rng)
    return {(table.chip, table.filter): table for table in out}


def test_fine_scale_is_as_large_as_published(tables):
    """Section 4.3: 0.17 px before the correction (Figure 7), half of it on WFC2; Figures 11-13."""
    longest = {key: np.hypot(*table.values).max() for key, table in tables.items()}
    assert longest[1, ""] == pytest.approx(0.17)
    assert longest[2, ""] == pytest.approx(longest[1, ""] / 2)
    for name, most in (("F606W", 0.032), ("F435W", 0.062), ("F475W", 0.08)):
        assert max(longest[1, name], longest[2, name]) == pytest.approx(most)
    assert 0.02 < max(longest[1, "F814W"], longest[2, "F814W"]) <= 0.08
    # amplitudes of 0.02 to 0.05 px are quoted: typical vectors are shorter still
    rms = [np.sqrt((tables[1, name].values ** 2).sum(axis=0).mean()) for name in ACS_FILTERS]
    assert min(rms) > 0.005 and max(rms) < 0.05


def test_no_polynomial_of_order_5_follows_the_tables(tables):
    """Least squares on plain monomials finds nothing: the polynomial's truth is unambiguous."""
    for table in tables.values():
        x, y = np.meshgrid(*table.nodes())
        X, Y = (x.ravel() - 2048) / 2048, (y.ravel() - 1024) / 1024
        design = np.stack([X**i * Y**j for i in range(6) for j in range(6 - i)], axis=-1)
        found, *_ = np.linalg.lstsq(design, table.values.reshape(2, -1).T, rcond=None)
        np.testing.assert_allclose(design @ found, 0.0, atol=1e-13)


def test_a_fit_without_tables_finds_the_same_polynomial(tables):
    """What the tables do to u and v of evenly spread stars leaves the linear terms as they are.

    They are printed with sigmas of 9e-7: a leak of the tables would be seen at a tenth of that.
    """
    model, theta = acs_solution()
    x, y = (g.ravel() for g in np.meshgrid(np.arange(4.5, 4097, 8), np.arange(4.5, 2049, 8)))
    X, Y = (x - 2048) / 2048, (y - 1024) / 1024
    powers = [(i, j) for i in range(6) for j in range(6 - i)]
    q, r = np.linalg.qr(np.stack([X**i * Y**j for i, j in powers], axis=-1))
    for (chip, _), table in tables.items():
        dx, dy = table.evaluate(x, y).T
        moved = model.predict(theta, x + dx, y + dy, epoch=2004.5, chip=chip)
        moved -= model.predict(theta, x, y, epoch=2004.5, chip=chip)
        found = np.linalg.solve(r, q.T @ moved)
        assert np.abs(found[powers.index((1, 0))]).max() / 2048 < 5e-8
        assert np.abs(found[powers.index((0, 1))]).max() / 1024 < 5e-8
        assert np.abs(moved).max() > 0.01


def test_filters_are_coherent_over_some_150_pixels(tables):
    """Half of the correlation is gone around that distance, and all of it some steps further."""

    def correlation(lag):
        pairs = [
            (v[:, :-lag].ravel() @ v[:, lag:].ravel() / v[:, lag:].size) / (v**2).mean()
            for name in ACS_FILTERS
            for chip in (1, 2)
            for v in tables[chip, name].values
        ]
        return np.mean(pairs)

    assert correlation(1) > 0.5 > correlation(3)  # 64 and 192 pixels
    assert abs(correlation(12)) < 0.1  # 768 pixels
