"""Stars without a proper motion get one from the others, with its error."""

from __future__ import annotations

import numpy as np
import pyarrow
import pyarrow.parquet as pq
import pytest
from astropy import units
from astropy import units as u
from astropy.table import MaskedColumn, Table
from astropy.wcs import WCS

import bayesdist as bd
from bayesdist.data import catalog_from_table
from bayesdist.data.preparing import (
    motion_error_line,
    select_motions,
    with_measured_motions,
)
from bayesdist.errors import InputError
from tests.data.test_sky import POINT, catalogue, read
from tests.reduced import FULL

YEARS = 12.0
EPOCH = 2016.0 + YEARS


def field(n=600, seed=2, **changes):
    """Bright stars move fast and faint ones slowly, about a common motion."""
    rng = np.random.default_rng(seed)
    t = catalogue(n, seed)
    t["x"], t["y"] = rng.uniform(1, 1000, (2, n))
    faint = np.asarray(t["phot_g_mean_mag"]) > 17.5
    sigma = np.where(faint, 2.0, 8.0)
    t["pmra"], t["pmdec"] = 3.0 + sigma * rng.normal(size=n), -5.0 + sigma * rng.normal(size=n)
    t["parallax"] = 0.5 + 0.1 * rng.normal(size=n)
    t["parallax_error"] = 0.02
    for name in ("ra_error", "dec_error", "pmra_error", "pmdec_error"):
        t[name] = 0.05
    for name, value in changes.items():
        t[name] = value
    return t, faint


def masked(
    t, gone, names=("pmra", "pmdec", "pmra_error", "pmdec_error", "parallax", "parallax_error")
):
    t = t.copy()
    for name in names:
        t[name] = MaskedColumn(t[name], mask=gone)
    return t


def third(n):
    return np.arange(n) % 3 == 0


def test_their_errors_grow_by_the_scatter_of_stars_of_their_magnitude():
    t, faint = field(3000)
    gone = third(len(t))
    m = read(masked(t, gone), epoch=EPOCH)
    assert len(m) == len(t) and not m.rejected
    for sigma, group in ((2.0, faint & gone), (8.0, ~faint & gone)):
        for axis in (m.sigma_u, m.sigma_v):
            assert np.median(axis[group]) == pytest.approx(YEARS * sigma / 1e3, rel=0.15)
    with_motion = read(t, epoch=EPOCH)
    for name in ("u", "v", "sigma_u", "sigma_v"):
        np.testing.assert_allclose(getattr(m, name)[~gone], getattr(with_motion, name)[~gone])
    # they are moved by the mean motion of the field
    offset = np.mean([m.u - with_motion.u, m.v - with_motion.v], axis=1, where=gone)
    assert np.abs(offset).max() < 5 * YEARS * 6e-3 / np.sqrt(gone.sum())
    assert any("1000 of 3000 rows have no motion" in note for note in m.notes)


@pytest.mark.parametrize("how", ["zeros", "nan", "two parameters"])
def test_every_form_of_a_missing_motion_is_one(how, caplog):
    t, _ = field()
    gone = third(len(t))
    expected = read(masked(t, gone), epoch=EPOCH)
    t = t.copy()
    for name in ("pmra", "pmdec", "pmra_error", "pmdec_error", "parallax", "parallax_error"):
        if how == "two parameters":  # numbers that are none
            t[name][gone] = 1e3 if name.startswith("pm") else 0.0
        else:
            t[name][gone] = 0.0 if how == "zeros" and name.startswith("pm") else np.nan
    if how == "two parameters":
        t["astrometric_params_solved"] = np.where(gone, 3, 31)
    m = read(t, epoch=EPOCH)
    for name in ("u", "v", "sigma_u", "sigma_v", "rho_uv"):
        np.testing.assert_allclose(getattr(m, name), getattr(expected, name), rtol=1e-9, atol=1e-12)
    assert ("exactly 0" in caplog.text) == (how == "zeros")


def test_the_prior_may_be_given():
    t, _ = field(60)
    gone = third(60)
    wide = read(masked(t, gone), epoch=EPOCH, motion_prior=40.0)
    assert wide.sigma_u[gone] == pytest.approx(YEARS * 0.040, rel=0.01)
    few = masked(t, np.arange(60) >= 10)
    assert read(few, epoch=EPOCH).rejected == {"no proper motion": 50}
    assert len(read(few, epoch=EPOCH, motion_prior=5.0)) == 60
    with pytest.raises(InputError, match="motion_prior is -1"):
        read(t, epoch=EPOCH, motion_prior=-1.0)


def test_the_prior_may_be_a_quantity():
    t = masked(field(900)[0], third(900))
    as_number = read(t, epoch=EPOCH, motion_prior=20.0)
    as_quantity = read(t, epoch=EPOCH, motion_prior=0.02 * units.arcsec / units.yr)
    np.testing.assert_allclose(as_quantity.sigma_u, as_number.sigma_u, rtol=1e-12)
    with pytest.raises(InputError, match=r"cannot be converted to mas / yr"):
        read(t, epoch=EPOCH, motion_prior=20 * units.arcsec)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"sigma": 0.01, "epoch": EPOCH}, "sigma is 0.01"),
        ({"columns": {"sigma_ra": "", "sigma_dec": ""}, "epoch": EPOCH}, "read for 'sigma_ra'"),
        ({"columns": {"pm_ra": "", "pm_dec": ""}, "epoch": EPOCH}, "read for 'pm_ra'"),
        ({}, "epoch of the exposures is not known"),
    ],
)
def test_a_prior_without_effect_is_refused(options, reason):
    with pytest.raises(InputError, match=reason):
        read(field(60)[0], motion_prior=5.0, **options)


@pytest.mark.parametrize("name", ["pmra_error", "pmdec_error", "parallax_error"])
def test_errors_below_zero_are_refused_by_row(name):
    t, _ = field()
    t[name][17] = -0.1
    with pytest.raises(InputError, match=f"row 18, column '{name}': an error is -0.0001"):
        read(t, epoch=EPOCH)


def test_a_measured_motion_without_an_error_is_refused_by_row():
    t, _ = field()
    t["pmdec_error"][4] = np.nan
    with pytest.raises(InputError, match="row 5, column 'pmdec_error': a measured proper motion"):
        read(t, epoch=EPOCH)
    assert read(t, epoch=EPOCH, not_finite="reject").rejected == {"no proper motion": 1}


def test_doubtful_solutions_are_counted():
    t, _ = field(ruwe=1.0)
    t["ruwe"][:7] = 2.0
    assert "7 of 600 rows have a ruwe above 1.4" in " ".join(read(t, epoch=EPOCH).notes)


# -- coverage -------------------------------------------------------------------------------------

TRUTHS = 200 if FULL else 60
PROBES = np.array([[200.0, 300.0], [850.0, 700.0]])


def of_catalogue(t):
    """Matches of a table by the positions and errors that a campaign takes from its catalogue."""
    then = catalog_from_table(t, tangent_point=POINT).as_seen(EPOCH)
    x, y = (np.asarray(t[name])[then.star] for name in ("x", "y"))
    return bd.Matches(x, y, then.u, then.v, unit="arcsec", **then.position_errors)


WAYS = {"table": lambda t: read(t, epoch=EPOCH), "catalogue": of_catalogue}


def fitted(t, way="table"):
    """Fit to the stars of a table with their own errors, as positions (2, 2) and errors of u."""
    stars = WAYS[way](t)
    model = bd.build_model(stars, order=1, size=(1000, 1000))
    fit = bd.fit_linear(stars, model)
    phi = fit.model.basis().evaluate(*PROBES.T)
    variance = np.einsum("nk,kl,nl->n", phi, fit.cov[:3, :3], phi)
    return phi @ np.reshape(fit.mean, (2, -1)).T, np.sqrt(variance)


@pytest.mark.slow
def test_a_third_of_the_stars_without_motions_is_covered():
    """Least squares, 12 years from the catalogue: neither left out nor believed to stand still."""
    z = {"table": [], "catalogue": [], "standing still": []}
    for seed in range(TRUTHS):
        rng = np.random.default_rng([7, seed])
        t, _ = field(150, seed)
        gone = third(len(t))
        seen = read(t, epoch=EPOCH)  # true positions at the date
        model = bd.build_model(seen, order=1, size=(1000, 1000))
        truth = np.array([0.0, 50.0, 0.0, 0.0, 0.0, 50.0])
        phi = model.basis().evaluate(t["x"], t["y"])
        place = phi @ truth.reshape(2, -1).T
        # the detector sees true stars; the catalogue has errors of its positions and motions
        shift = place - np.column_stack([seen.u, seen.v])
        t["ra"] += shift[:, 0] / 3600 / np.cos(np.radians(POINT[1]))
        t["dec"] += shift[:, 1] / 3600
        again = read(t, epoch=EPOCH)  # the plane bends by less than the errors
        rest = place - np.column_stack([again.u, again.v])
        t["ra"] += rest[:, 0] / 3600 / np.cos(np.radians(POINT[1]))
        t["dec"] += rest[:, 1] / 3600
        for name, error in (("pmra", 0.05), ("pmdec", 0.05)):
            t[name] += error * rng.normal(size=len(t))
        t["ra"] += 0.05e-3 / 3600 / np.cos(np.radians(POINT[1])) * rng.normal(size=len(t))
        t["dec"] += 0.05e-3 / 3600 * rng.normal(size=len(t))
        t["parallax"] += 0.02 * rng.normal(size=len(t))
        still = t.copy()
        for name in ("pmra", "pmdec"):
            still[name][gone] = 1e-9
        expected = model.basis().evaluate(*PROBES.T) @ truth.reshape(2, -1).T
        for kind in z:
            table = still if kind == "standing still" else masked(t, gone)
            found, sigma = fitted(table, kind if kind in WAYS else "table")
            z[kind] += list((found - expected)[:, 0] / sigma)
    within = {kind: [np.mean(np.abs(v) < k) for k in (1.0, 1.96)] for kind, v in z.items()}
    spread = 4 * np.sqrt(0.25 / (2 * TRUTHS))
    print(within)
    for way in WAYS:
        assert within[way] == pytest.approx([0.683, 0.95], abs=spread), way
    assert within["standing still"][1] < 0.3


# -- catalogues and tables on disk ----------------------------------------------------------------


def two_thirds(n=900, **options):
    """A table, which stars lack a motion, and the reference catalogue that is read from it."""
    t, _ = field(n)
    gone = third(n)
    return t, gone, catalog_from_table(masked(t, gone), tangent_point=POINT, **options)


def test_catalogues_have_the_motions_and_errors_of_tables_of_matches():
    t, gone, c = two_thirds()
    m = read(masked(t, gone), epoch=EPOCH)
    then = c.at(EPOCH)
    np.testing.assert_array_equal(c.assumed_motion, gone)
    assert any("300 of 900 rows have no motion" in note for note in c.notes)
    # without the parallaxes' errors, which depend on the date in the year
    np.testing.assert_allclose(then.sigma_u, m.sigma_u, atol=3e-5)
    assert np.median(then.sigma_u[gone]) > 20 * np.median(then.sigma_u[~gone])
    years = np.array([0.0, 5.0, 20.0])
    growing = [np.median(c.at(2016.0 + dt).sigma_u[gone]) for dt in years]
    sizes = np.median(c.sigma_pm_u[gone]) * years
    np.testing.assert_allclose(growing, np.hypot(0.05e-3, sizes), rtol=0.3)
    given = two_thirds(motion_prior=0.040 * u.arcsec / u.yr)[2]
    np.testing.assert_allclose(given.sigma_pm_u[gone], 0.040, rtol=1e-5)  # of a tangent plane
    few = catalog_from_table(masked(t, np.arange(900) >= 10), tangent_point=POINT)
    assert len(few) == 10 and few.assumed_motion is None


@pytest.mark.parametrize(
    ("name", "value"), [("pmra", np.inf), ("pmra_error", np.nan), ("pmdec_error", np.inf)]
)
def test_a_motion_that_is_infinite_or_without_an_error_is_not_a_missing_one(name, value):
    t = masked(field(900)[0], third(900))
    t[name][1] = value
    c = catalog_from_table(t, tangent_point=POINT)
    assert len(c) == 899 and c.assumed_motion.sum() == 300
    assert any("1 stars are left out" in note for note in c.notes), c.notes
    m = read(t, epoch=EPOCH, not_finite="reject")
    assert len(m) == 899 and sum(m.rejected.values()) == 1
    if name != "pmra":  # rows without a motion that can be used are left out in any case
        with pytest.raises(InputError, match=rf"row 2, column '{name}'"):
            read(t, epoch=EPOCH)


@pytest.mark.parametrize("unit", ["mas", "pix"])
def test_catalogues_on_a_plane_have_them_in_their_unit(unit):
    rng = np.random.default_rng(3)
    n, gone = 300, third(300)
    t = Table({"u": rng.uniform(0, 1e5, n), "v": rng.uniform(0, 1e5, n), "sigma_u": np.ones(n)})
    t["sigma_v"] = 1.0
    for name in ("pm_u", "pm_v"):
        t[name] = MaskedColumn(rng.normal(2.0, 5.0, n), mask=gone)
    t["sigma_pm_u"] = t["sigma_pm_v"] = MaskedColumn(np.full(n, 0.1), mask=gone)
    c = catalog_from_table(t, unit=unit, epoch=2016.0)
    assert c.pm_u[gone] == pytest.approx(np.median(c.pm_u[~gone]))
    assert c.sigma_pm_u[gone] == pytest.approx(np.std(c.pm_u[~gone]), rel=0.2)
    if unit == "pix":
        with pytest.raises(InputError, match="in mas/yr, and positions are in pix"):
            catalog_from_table(t, unit=unit, epoch=2016.0, motion_prior=5.0)
    else:
        given = catalog_from_table(t, unit=unit, epoch=2016.0, motion_prior=5.0)
        assert given.sigma_pm_v[gone] == pytest.approx(5.0)


@pytest.mark.parametrize("prior", [-5.0, 0.0, np.nan, np.inf])
def test_catalogues_refuse_a_prior_that_is_not_positive(prior):
    with pytest.raises(InputError, match=f"motion_prior is {prior}"):
        two_thirds(motion_prior=prior)


@pytest.mark.parametrize("key", ["sigma_pm_ra", "pm_ra", "sigma_ra"])
def test_a_prior_without_effect_is_refused_in_catalogues_and_match(key, rng):
    t, gone, _ = two_thirds()
    without = {key: "", key.replace("ra", "dec"): ""}
    reason = f"motion_prior is given, .* read for '{key}'"
    with pytest.raises(InputError, match=reason):
        catalog_from_table(masked(t, gone), without, motion_prior=5.0)
    detections, wcs = seen_table(t, rng)
    options = {"radius": 0.5, "wcs": wcs, "epoch": EPOCH, "catalogue_columns": without}
    with pytest.raises(InputError, match="motion_prior is given"):
        bd.match(detections, masked(t, gone), **options, motion_prior=5.0)
    plane = Table({"u": [0.0, 1.0], "v": [0.0, 1.0], "sigma_u": [1.0, 1], "sigma_v": [1.0, 1]})
    with pytest.raises(InputError, match="read for 'pm_u'"):
        catalog_from_table(plane, unit="mas", motion_prior=5.0)


@pytest.mark.parametrize("n", [1, 3, 10])
def test_a_given_prior_includes_the_error_of_the_median_of_few_stars(n):
    """Stars of one common motion with the scatter that is given: standard scores have variance 1.

    The common motion is uniform within +- 60 mas/yr.
    """
    z = []
    for seed in range(200):
        rng = np.random.default_rng([n, seed])
        true = rng.uniform(-60, 60, 2)[:, None] + 5.0 * rng.normal(size=(2, n + 1))
        t = Table({"u": np.arange(n + 1.0), "v": np.zeros(n + 1)})
        t["sigma_u"] = t["sigma_v"] = np.full(n + 1, 0.3)
        for k, axis in enumerate("uv"):
            t[f"pm_{axis}"] = np.append(true[k, :n], np.nan)
            t[f"sigma_pm_{axis}"] = np.append(np.full(n, 0.01), np.nan)
        c = catalog_from_table(t, unit="mas", epoch=2016.0, motion_prior=5.0)
        z += [
            (c.pm_u[n] - true[0, n]) / c.sigma_pm_u[n],
            (c.pm_v[n] - true[1, n]) / c.sigma_pm_v[n],
        ]
    # of 400 normal scores with an error of the variance of 0.07; larger errors are allowed for few
    assert 0.6 < np.mean(np.square(z)) < 1.2
    assert f"the median of the {n} measured motions" in c.notes[0]


@pytest.mark.parametrize("n", [1, 3, 20])
def test_few_parallaxes_do_not_give_those_of_the_others(n):
    t, _ = field(900)
    gone = np.arange(900) >= n
    t["parallax"] = 10.0
    c = catalog_from_table(masked(t, gone), tangent_point=POINT, motion_prior=5.0)
    assert np.all(c.parallax[gone] == 0) and c.sigma_parallax[gone].min() >= 0.010


def test_the_note_states_the_median_error_of_the_stars_that_get_it(tmp_path):
    t, faint = field(3000)
    gone = faint & (np.arange(3000) % 2 == 0)  # with a scatter of 2 mas/yr, that of all is larger
    expected = np.median(np.asarray(catalog_from_table(masked(t, gone)).sigma_pm_u)[gone]) * 1e3
    pq.write_table(
        pyarrow.Table.from_pandas(masked(t, gone).to_pandas()), tmp_path / "stars.parquet"
    )
    disk = bd.open_matches(tmp_path / "stars.parquet", epoch=EPOCH, tangent_point=POINT)
    for notes in (catalog_from_table(masked(t, gone)).notes, disk.notes):
        note = next(note for note in notes if "no motion" in note)
        stated = float(note.split("median error of ")[1].split()[0])
        assert stated == pytest.approx(expected, rel=0.05) and stated < 3.0


def test_reliable_motions_are_selected_among_the_measured_ones():
    c = two_thirds()[2]
    line = motion_error_line(c)
    measured = c.select(c.measured_motion)
    np.testing.assert_array_equal(line.sigma, motion_error_line(measured).sigma)
    assert select_motions(c).assumed_motion.sum() == 300


def test_matches_with_measured_motions_and_the_exposures_that_have_enough_of_them():
    c = two_thirds()[2]
    measured, assumed = c.star[c.measured_motion], c.star[c.assumed_motion]
    star = np.concatenate([measured[:12], assumed[:40], measured[20:29], assumed[:40]])
    x, y = np.random.default_rng(4).uniform(1, 1000, (2, len(star)))
    exposure = np.repeat(["a", "b"], [52, 49])
    m = bd.Matches(x, y, x, y, star=star, exposure=exposure == "b", exposure_names=("a", "b"))
    chosen = with_measured_motions(m, c)
    np.testing.assert_array_equal(np.sort(chosen.star), np.sort(measured[:12]))
    assert chosen.exposure_names == ("a",)
    with pytest.raises(InputError, match="no exposure has 10 stars with a measured motion"):
        with_measured_motions(m.select(exposure == "b"), c)
    only = c.select(c.measured_motion)
    assert with_measured_motions(chosen, only) is chosen


def seen_table(t, rng):
    """Detections of the stars of a table, with errors of the centroids."""
    m = read(t, epoch=EPOCH)
    x, y = m.u / 0.05 + rng.normal(0, 0.02, len(m)), m.v / 0.05 + rng.normal(0, 0.02, len(m))
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], POINT
    wcs.wcs.crpix, wcs.wcs.cdelt = [0.0, 0.0], [0.05 / 3600] * 2
    detections = Table({"x": x, "y": y})
    detections["x_err"] = detections["y_err"] = 0.02
    return detections, wcs


def test_match_gives_them_errors_unless_errors_of_the_matches_are_given(rng):
    t, _ = field()
    gone = third(len(t))
    detections, wcs = seen_table(t, rng)
    options = {"radius": 0.5, "wcs": wcs, "epoch": EPOCH}
    m = bd.match(detections, masked(t, gone), **options)
    assert gone[m.star].sum() > 0.9 * gone.sum()
    size = np.median(m.sigma_u[gone[m.star]])
    assert size > 10 * np.median(m.sigma_u[~gone[m.star]])
    for how in ({"sigma": 0.01}, {"whole": True}):
        seen = detections.copy()
        if how.pop("whole", False):
            seen["sigma_u"] = seen["sigma_v"] = 0.001
        assert not gone[bd.match(seen, masked(t, gone), **options, **how).star].any()
    wide = bd.match(detections, masked(t, gone), **options, motion_prior=30.0)
    assert wide.sigma_u[gone[wide.star]] == pytest.approx(YEARS * 0.030, rel=0.01)


def test_match_treats_assumed_motions_of_a_catalogue_like_missing_ones_of_a_table(rng):
    t, _ = field(900)
    gone = third(len(t))
    detections, wcs = seen_table(t, rng)
    table = masked(t, gone)
    c = catalog_from_table(table, tangent_point=POINT)
    assert c.assumed_motion.sum() == 300
    options = {"radius": 0.5, "wcs": wcs, "epoch": EPOCH}
    seen = detections.copy()
    seen["mag"] = t["phot_g_mean_mag"]
    whole = detections.copy()
    whole["sigma_u"] = whole["sigma_v"] = 0.001
    without_errors = {"catalogue_columns": {"sigma_pm_ra": "", "sigma_pm_dec": ""}}
    for rows, how in ((detections, {"sigma": 0.01}), (seen, {"sigma": "by_magnitude"}),
                      (whole, {}), (detections, without_errors)):  # fmt: skip
        m, expected = (bd.match(rows, stars, **options, **how) for stars in (c, table))
        np.testing.assert_array_equal(m.star, expected.star)
        assert len(m) > 500 and not gone[m.star].any()
    for how in ({}, {"motion_prior": 30.0}):
        m, expected = (bd.match(detections, stars, **options, **how) for stars in (c, table))
        np.testing.assert_array_equal(m.star, expected.star)
        np.testing.assert_allclose(m.sigma_u, expected.sigma_u, rtol=1e-4)
    assert any("have no motion" in note for note in m.notes)
    given = catalog_from_table(table, tangent_point=POINT, motion_prior=40.0)
    m = bd.match(detections, given, **options)
    assert m.sigma_u[gone[m.star]] == pytest.approx(YEARS * 0.040, rel=0.01)
    assert any("300 of 900 stars of the catalogue have a motion that is not" in n for n in m.notes)


def test_match_table_leaves_them_out(rng):
    _, gone, c = two_thirds()
    then = c.at(EPOCH)
    seen = bd.Matches(then.u * 20, then.v * 20, then.u + 1.0, then.v, unit="arcsec",
                      epoch=np.full(len(c), EPOCH))  # fmt: skip
    assert not gone[bd.match_table(seen, c).star].any()


@pytest.mark.parametrize("how", ["masked", "zeros"])
def test_tables_on_disk_give_the_matches_of_tables_in_memory(how, tmp_path):
    t, _ = field(700)
    gone = third(700)
    stored = masked(t, gone)
    if how == "zeros":
        stored = t.copy()
        stored["pmra"][gone] = stored["pmdec"][gone] = 0.0
    stored["ruwe"] = np.where(np.arange(700) < 5, 2.0, 1.0)
    # NaN becomes null
    pq.write_table(pyarrow.Table.from_pandas(stored.to_pandas()), tmp_path / "stars.parquet")
    options = {"epoch": EPOCH, "tangent_point": POINT}
    memory = bd.read_matches(tmp_path / "stars.parquet", **options)
    disk = bd.open_matches(tmp_path / "stars.parquet", **options)
    for batch in disk.batches():
        for name in ("u", "v", "sigma_u", "sigma_v", "rho_uv"):
            np.testing.assert_array_equal(getattr(batch, name), getattr(memory, name))
    said = [note for note in memory.notes if "ruwe" in note or "no motion" in note]
    assert len(said) == 2 and set(said) <= set(disk.notes)
    wide = bd.open_matches(tmp_path / "stars.parquet", **options, motion_prior=40.0)
    sigma = np.concatenate([batch.sigma_u for batch in wide.batches()])
    assert sigma[gone] == pytest.approx(YEARS * 0.040, rel=0.01)


@pytest.mark.plugins
def test_a_prior_without_errors_that_grow_is_refused():
    t, _ = field(60)
    with pytest.raises(InputError, match=r"motion_prior is given, and sigma is 0\.01"):
        read(t, epoch=EPOCH, motion_prior=5.0, sigma=0.01)
    gone = third(60)
    assert read(masked(t, gone), epoch=EPOCH, sigma=0.01).rejected == {"no proper motion": 20}
    run = {"order": 1, "size": (1000, 1000), "settings": {"data": {"epoch": EPOCH}}}
    now = read(t, epoch=EPOCH)
    noise = np.random.default_rng(1).normal(0, 0.1, (2, len(t)))
    t["x"], t["y"] = 3 * np.stack([now.u, now.v]) + 500 + noise
    assert len(bd.calibrate(masked(t, gone), sigma=0.01, **run).matches) == 40


@pytest.mark.parametrize("how", ["read for it", "read with errors", "read from a written table"])
def test_errors_by_magnitude_come_from_measured_stars(how):
    """With 45 % of the stars without a motion, against the scatter that was drawn."""
    n, rng = 6000 if FULL else 3000, np.random.default_rng(12)
    t, _ = field(n)
    gone = rng.random(n) < 0.45
    sky = read(t, epoch=EPOCH)  # without errors of the centroids
    scale = np.ptp(sky.u) / 3000.0  # arcsec per pixel
    true = 0.05 * scale * 10 ** (0.1 * (np.asarray(t["phot_g_mean_mag"]) - 15.0))
    for axis, place in (("x", sky.u), ("y", sky.v)):
        t[axis] = 2500.0 + (place + true * rng.normal(size=n)) / scale
    t = masked(t, gone)
    sigma = "by_magnitude" if how == "read for it" else "columns"
    stars = read(t, epoch=EPOCH, sigma=sigma)
    assert stars.motion_is_assumed.sum() == (0 if how == "read for it" else gone.sum())
    if how == "read from a written table":
        stars = bd.Matches.from_table(stars.to_table())
    model = bd.build_model(stars, order=1, size=(5000, 5000))
    _, used, errors = bd.fit_by_magnitude(stars, model)
    assert len(used) == np.count_nonzero(~gone)
    assert used.rejected == {"no proper motion": np.count_nonzero(gone)}
    catalogue = 0.05e-3 * np.hypot(1.0, YEARS)
    for sigma in (errors.sigma_u, errors.sigma_v):
        expected = np.hypot(0.05 * scale * 10 ** (0.1 * (errors.mag - 15.0)), catalogue)
        assert np.sqrt(np.mean((sigma / expected) ** 2)) == pytest.approx(1.0, abs=0.05)
        np.testing.assert_allclose(sigma / expected, 1.0, atol=0.12)
    if how == "read with errors":
        run = bd.calibrate(stars, order=1, size=(5000, 5000), sigma="by_magnitude", seed=1)
        assert run.fit.n_rows + len(run.held_stars or ()) == np.count_nonzero(~gone)


def test_matches_with_assumed_motions_are_marked_wherever_they_come_from(rng, tmp_path):
    t, _ = field(900)
    gone = third(900)
    detections, wcs = seen_table(t, rng)
    t = masked(t, gone)
    options = {"radius": 0.5, "wcs": wcs, "epoch": EPOCH}
    for catalogue_ in (t, catalog_from_table(t, tangent_point=POINT)):
        m = bd.match(detections, catalogue_, **options)
        np.testing.assert_array_equal(m.motion_is_assumed, gone[m.star])
    stars = read(t, epoch=EPOCH)
    np.testing.assert_array_equal(stars.motion_is_assumed, gone)
    measured = read(field(50, 9)[0], epoch=EPOCH)
    assert measured.assumed_motion is None and measured.without_assumed_motions() is measured
    both = bd.Matches.concatenate([stars, measured])
    np.testing.assert_array_equal(both.motion_is_assumed, [*gone, *np.zeros(50, bool)])
    pq.write_table(pyarrow.Table.from_pandas(t.to_pandas()), tmp_path / "stars.parquet")
    stored = bd.open_matches(tmp_path / "stars.parquet", epoch=EPOCH, tangent_point=POINT)
    np.testing.assert_array_equal(stored.load().motion_is_assumed, gone)
    with pytest.raises(InputError, match="the stars are on disk"):
        bd.fit_by_magnitude(stored, bd.build_model(stored.load(), order=1, size=(1000, 1000)))
    with pytest.raises(InputError, match="no star has a measured motion"):
        stars.select(gone).without_assumed_motions()


@pytest.mark.parametrize("n", [5, 12])
def test_a_match_that_fails_for_too_few_motions_says_so(n, rng):
    t, _ = field()
    detections, wcs = seen_table(t, rng)
    few = masked(t, np.arange(600) >= n)
    options = {"radius": 0.5, "wcs": wcs, "epoch": EPOCH}
    words = f"{600 - n} of 600 catalogue stars are left out, as they have no proper motion"
    with pytest.raises(InputError, match=words) as error:
        bd.match(detections, few, **options)
    assert "motion_prior" in error.value.do
    assert len(bd.match(detections, few, **options, motion_prior=10.0)) > 500
    with pytest.raises(InputError) as error:  # of another field
        bd.match(detections, t[:5], **options)
    assert "motion" not in str(error.value)
