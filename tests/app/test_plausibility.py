"""What cannot be meant is refused, what is odd is said: scale, errors, dates, breaks, numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from astropy.wcs import WCS, Sip
from numpy.polynomial import legendre

import bayesdist as bd
from bayesdist.app.config import parse_config
from bayesdist.app.plausibility import (
    doubts_on_stars,
    refuse_empty_segments,
    scatter_about_polynomials,
)
from bayesdist.data import Matches, read_matches, write_partitioned
from bayesdist.errors import ConfigError, DegenerateError, InputError
from bayesdist.model import Chip, DistortionModel, TimeDependence

from .support import cli, write_job

TEXT = """
[data]
matches = "stars.ecsv"
{data}
[detector]
size = [1000, 800]
{detector}
[model]
order = 2
{more}
"""


def config(data="", detector="", more=""):
    return parse_config(TEXT.format(data=data, detector=detector, more=more), "c.toml")


def stars(rng, scale=1.0, unit="pix", sigma=0.01, n=200, **columns):
    """Stars of a detector without distortion, whose pixels have a size."""
    x, y = rng.uniform(1, 1000, n), rng.uniform(1, 800, n)
    u, v = scale * (np.array([x, y]) + rng.normal(0, 0.01, (2, n)))
    return Matches(
        x=x, y=y, u=u, v=v, sigma_u=np.full(n, sigma), sigma_v=np.full(n, sigma),
        unit=unit, sources=("stars.ecsv",), **columns,
    )  # fmt: skip


def model(unit="pix"):
    return DistortionModel(1, (Chip(1, "A", (1000.0, 800.0), (500.5, 400.5)),), unit=unit)


def doubts(found, **settings):
    return doubts_on_stars(found, model(found.unit), config(**settings))


@pytest.mark.parametrize(("apart", "named"), [(0.0, False), (0.1, True)])
def test_pointings_that_share_few_errors_of_the_catalogue_are_named(rng, apart, named):
    """Errors of 2MASS are correlated over 0.15 degrees; pointings are 2 `apart` from each other."""
    exposure = np.repeat([0, 1], 100)
    seen = stars(rng, 0.05, "arcsec", exposure=exposure, exposure_names=("a", "b"))
    shift = 2 * apart * 3600 * 2 * (exposure - 0.5)
    seen = replace(seen, u=seen.u + shift, v=seen.v)
    for more in ('[catalogue]\nname = "2MASS"', ""):
        text = " ".join(doubts(seen, more=more))
        assert ("exposures are up to 0.2 degrees from their mean" in text) == (named and bool(more))


def dots(rng, order, noise=0.02, false=0.0, n=1200):
    """Positions that follow Legendre terms of one order, 3 px large, and false matches."""
    x, y = rng.uniform(1, 1000, n), rng.uniform(1, 800, n)
    X, Y = (x - 500.5) / 500, (y - 400.5) / 400
    top = legendre.Legendre.basis(order)
    u, v = (z + 3 * top(Z) + rng.normal(0, noise, n) for z, Z in ((x, X), (y, Y)))
    wrong = rng.random(n) < false
    u[wrong] += rng.uniform(-20, 20, wrong.sum())
    sigma = np.full(n, 0.02)
    return Matches(x=x, y=y, u=u, v=v, sigma_u=sigma, sigma_v=sigma, unit="pix")


@pytest.mark.parametrize("false", [0.0, 0.3])
@pytest.mark.parametrize("order", [2, 5, 9])
def test_an_order_that_is_too_low_is_named_before_sampling(rng, order, false):
    """Not that of the true order, with the same false matches."""
    found = dots(rng, order, false=false)
    asked = (1, order - 1, order)
    chip = model().chips[0]
    texts = [
        " ".join(doubts_on_stars(found, DistortionModel(n, (chip,), unit="pix"), config()))
        for n in asked
    ]
    for text in texts[:2]:
        assert f"px about one of order {order}: the order is too low" in text
        assert "raise model.order" in text
    assert "too low" not in texts[2]


@pytest.mark.parametrize("false", [0.1, 0.6])
def test_false_matches_alone_are_no_order_that_is_too_low(rng, false):
    assert "too low" not in " ".join(doubts(dots(rng, 1, false=false)))


@pytest.mark.parametrize("share", [0.15, 1 / 3, 0.5])
@pytest.mark.parametrize("shift", [0.16, 0.4, 2.0])
def test_stars_that_are_displaced_as_a_whole_are_no_order_that_is_too_low(share, shift):
    """By 8 to 100 errors.  A fit of high order may reject them where one of low order does not."""
    for seed in range(5):
        rng = np.random.default_rng([23, seed])
        found = dots(rng, 1, n=800)
        moved = shift * (rng.random(800) < share)
        found = replace(found, u=found.u + moved)
        assert "too low" not in " ".join(doubts(found))


@pytest.mark.parametrize("noise", [0.0, 1e-10])
def test_positions_that_were_computed_are_refused_with_a_way_out(rng, noise):
    """Those of a design on a grid, and those with as few digits as a table has, which are not."""
    found = dots(rng, 3, noise=noise)
    words = "or are those of a design, and without the noise of measured positions"
    with pytest.raises(InputError, match=words) as caught:
        doubts(found)
    assert "bayesdist.fit_linear" in str(caught.value)
    written = replace(found, u=found.u.round(6), v=found.v.round(6))
    with pytest.raises(InputError, match="computed from the pixels by a WCS"):
        doubts(written)


# -- too few stars ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "named"), [(8, True), (9, False)])
def test_fewer_than_three_stars_for_each_term_are_named(rng, n, named):
    said = doubts(stars(rng, n=n))  # order 1: three terms on each axis
    assert any(f"{n} stars for 3 terms on each axis" in text for text in said) == named


# -- positions made from the pixels ---------------------------------------------------------------


@pytest.mark.parametrize("decimals", [7, 5])
@pytest.mark.parametrize("quoted", [True, False])
def test_positions_that_a_wcs_made_from_the_pixels_are_named(rng, decimals, quoted):
    """Five decimals are 0.009 px, which is doubted unless the quoted errors are as small."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [150, 30], [500, 400]
    wcs.wcs.cdelt = [-4e-4, 4e-4]  # degrees, so that 7 decimals are 0.0001 px
    x, y = rng.uniform(1, 1000, 200), rng.uniform(1, 800, 200)
    ra, dec = wcs.all_pix2world(x, y, 1)
    table = Table({"x": x, "y": y, "ra": np.round(ra, decimals), "dec": np.round(dec, decimals)})
    table["mag"] = 12 + x / 100
    stars = read_matches(table, sigma=0.05 if quoted else "by_magnitude")
    if decimals == 5:
        texts = [text for text in doubts(stars) if "been computed from the pixels" in text]
        assert len(texts) == (not quoted)
        assert all("(5 of ra, 5 of dec) alone explain this scatter" in text for text in texts)
        return
    with pytest.raises(InputError, match=r"computed from the pixels by a WCS.*'bayesdist convert"):
        doubts(stars)


def made_by_a_sip_wcs(rng, noise, n=300):
    """Table as of SExtractor; positions by astropy's SIP, 0.2 arcsec per pixel, with some noise."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN-SIP", "DEC--TAN-SIP"], [150, 40]
    wcs.wcs.crpix, wcs.wcs.cdelt = [500.5, 400.5], [-0.2 / 3600, 0.2 / 3600]
    a, b = np.zeros((2, 3, 3))
    a[2, 0], a[1, 1], b[0, 2] = 2e-6, 1e-6, 1.6e-6
    wcs.sip = Sip(a, b, None, None, wcs.wcs.crpix)
    x, y = rng.uniform(1, 1000, n), rng.uniform(1, 800, n)
    ra, dec = wcs.all_pix2world(x, y, 1)
    east, north = rng.normal(0, noise * 0.2 / 3600, (2, n))
    ra, dec = ra + east / np.cos(np.radians(dec)), dec + north
    return Table({"x": x, "y": y, "ra": ra, "dec": dec, "mag": rng.uniform(14, 20, n)})


@pytest.mark.parametrize(
    ("noise", "decimals", "words"),
    [
        (5e-4, None, "far better than detectors measure: they were probably computed"),
        (0.0, (4, 7), "(4 of x, 4 of y, 7 of ra, 7 of dec) alone explain this scatter"),
        (0.0, (3, 6), "(3 of x, 3 of y, 6 of ra, 6 of dec) alone explain this scatter"),
        (0.02, (3, 6), ""),
        (0.02, None, ""),
    ],
)
def test_positions_made_by_a_wcs_are_doubted_with_errors_by_magnitude(rng, noise, decimals, words):
    """Errors by magnitude are estimated from the scatter, and so is a number equal to it."""
    table = made_by_a_sip_wcs(rng, noise)
    if decimals is not None:
        for name, n in zip(("x", "y", "ra", "dec"), np.repeat(decimals, 2), strict=True):
            table[name] = table[name].round(n)
    run = bd.calibrate(
        table,
        order=3,
        size=(1000, 800),
        sigma="by_magnitude",
        terms=[bd.UserTerm("reference catalogue", "systematic", 0.0, 0.0, "arcsec", "none")],
        requirements=bd.Requirement("field-wide", "p95", 0.1, unit="arcsec"),
    )
    [margin] = run.margins
    doubted = "computed from the pixels by a WCS" in margin.reason
    assert doubted == bool(words) and words in margin.reason
    assert margin.verdict == ("undecided" if doubted else "met")
    scatter = scatter_about_polynomials(run.matches)
    for sigma, named in ((scatter, doubted), (8 * scatter, False)):
        of_number = doubts(run.matches.with_errors(sigma))
        assert any("computed from the pixels by a WCS" in text for text in of_number) == named


def test_errors_by_magnitude_count_as_unquoted_in_the_commands(rng, tmp_path):
    data = {"matches": "stars.ecsv", "sigma": "by_magnitude"}
    sections = {"data": data, "detector": {"name": "A", "size": (1000, 800)}, "model": {"order": 3}}
    doubtful = write_job(tmp_path / "doubtful", made_by_a_sip_wcs(rng, 5e-4), **sections)
    said = cli("check", doubtful)
    assert said.code == 0, said.err
    assert said.out.lower().count("the reference positions follow a polynomial") == 1
    made = write_job(tmp_path / "made", made_by_a_sip_wcs(rng, 0.0), **sections)
    said = cli("check", made)
    assert said.code == 1 and "with --sample if it has no distortion" in said.err


def test_positions_on_whole_pixels_of_a_design_are_not_taken_for_rounded(rng):
    """Holes of a mask at whole numbers, measured to 0.02 px: far less than their last decimal."""
    found = stars(rng)
    x, y = np.round(found.x), np.round(found.y)
    noise = rng.normal(0, 0.02, (2, len(found)))
    found = replace(found, x=x, y=y, u=x + noise[0], v=y + noise[1])
    assert doubts(found.without("sigma_u", "sigma_v")) == []


def test_a_scatter_that_a_mask_may_have_is_only_doubted_without_quoted_errors(rng):
    """Of 0.0004 px, with no errors to compare it with."""
    found = stars(rng, sigma=1e-4)
    noise = rng.normal(0, 4e-4, (2, 200))
    found = replace(found, u=found.x + noise[0], v=found.y + noise[1], sigma_u=None, sigma_v=None)
    found = replace(found, mag=12 + found.x / 100)
    assert any("probably computed from the pixels by a WCS" in text for text in doubts(found))


def sip(rng, order, n, chips=1, exposures=1):
    """Positions by SIP polynomials of one order, without noise; each exposure has a WCS."""
    parts = []
    for exposure, chip in np.ndindex(exposures, chips):
        x, y = rng.uniform(1, 1000, n), rng.uniform(1, 800, n)
        X, Y = (x - 500.5) / 500, (y - 400.5) / 400
        roll, tops = 0.1 * exposure, np.array([X**order, Y**order])
        turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
        bent = np.array([x + 1100 * chip, y]) + (1 + chip) * tops
        parts.append(np.vstack([x, y, turn @ bent, np.full((2, n), 0.02), [[chip + 1] * n]]))
    x, y, u, v, sigma_u, sigma_v, chip = np.concatenate(parts, axis=1)
    names = tuple(f"e{k}" for k in range(exposures))
    return Matches(
        x=x, y=y, u=u, v=v, sigma_u=sigma_u, sigma_v=sigma_v, chip=chip.astype(int) - 1,
        chip_numbers=tuple(range(1, chips + 1)), unit="pix",
        exposure=np.repeat(np.arange(exposures), chips * n), exposure_names=names,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("order", "n", "chips", "exposures"),
    [(1, 15, 1, 1), (2, 40, 2, 1), (1, 13, 1, 9), (4, 70, 3, 4), (7, 300, 2, 2), (9, 250, 1, 1)],
)
def test_computed_positions_are_found_with_few_stars_many_chips_and_high_orders(
    rng, order, n, chips, exposures
):
    found = sip(rng, order, n, chips, exposures)
    for decimals in (12, 4):
        written = replace(found, u=found.u.round(decimals), v=found.v.round(decimals))
        with pytest.raises(InputError, match="computed from the pixels by a WCS"):
            doubts(written)
    noise = rng.normal(0, 0.01, (2, len(found)))
    measured = replace(found, u=found.u + noise[0], v=found.v + noise[1])
    assert not any("computed from the pixels" in text for text in doubts(measured))


def test_rounded_positions_far_below_the_quoted_errors_are_named(rng):
    """Seven decimals of a right ascension are 0.003 px of 0.03 arcsec."""
    found = sip(rng, 1, 200)
    for sigma, named in ((0.05, True), (0.01, False)):
        quoted = np.full(200, sigma)
        rounded = replace(
            found,
            u=found.u + rng.uniform(-5e-3, 5e-3, 200),
            v=found.v + rng.uniform(-5e-3, 5e-3, 200),
            sigma_u=quoted,
            sigma_v=quoted,
        )
        texts = doubts(rounded)
        assert any("probably computed from the pixels by a WCS" in t for t in texts) == named


def test_computed_positions_are_refused_in_python_and_on_disk(rng, tmp_path):
    found = sip(rng, 2, 200)
    with pytest.raises(InputError, match="computed from the pixels by a WCS"):
        bd.calibrate(found, order=2, size=(1000, 800))
    write_partitioned([found], tmp_path / "stars")
    with pytest.raises(InputError, match="computed from the pixels by a WCS"):
        bd.calibrate(tmp_path / "stars", order=2, size=(1000, 800), scale_mas=50.0)
    # the way out of a design
    fit = bd.fit_linear(found.with_errors(1.0), bd.build_model(found, order=2, size=(1000, 800)))
    assert fit.rms_u < 1e-9


def test_small_errors_that_are_quoted_are_believed(rng):
    """Unless all are equal to the scatter, as in a draft of init."""
    sigma = rng.uniform(0.5e-4, 1.5e-4, 200)
    found = replace(stars(rng), sigma_u=sigma, sigma_v=sigma)
    noise = sigma * rng.normal(size=(2, 200))
    found = replace(found, u=found.x + noise[0], v=found.y + noise[1])
    assert doubts(found) == []


# -- scale ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_pixels_that_are_pixels(rng, scale):
    assert doubts(stars(rng, scale)) == []


@pytest.mark.parametrize("scale", [1 / 5, 5.0])
def test_a_scale_that_is_odd_is_said(rng, scale):
    [text] = doubts(stars(rng, scale, sigma=0.01))
    assert f"u and v, in pix, span {scale:.3g} times what pixels say" in text


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_a_scale_that_cannot_be_meant(rng, scale):
    with pytest.raises(InputError, match=r"stars\.ecsv: u and v, in pix, span .* correct data"):
        doubts(stars(rng, scale))


def job(folder, rng, hours=False, scale_mas=None, stretch=1.0):
    """Configuration of a camera with 150 mas pixels, turned by 30 degrees, by its own sky."""
    x, y = rng.uniform(1, 1000, 200), rng.uniform(1, 800, 200)
    plane = WCS(naxis=2)
    plane.wcs.ctype, plane.wcs.crval = ["RA---TAN", "DEC--TAN"], [202.5, 47.2]
    c, s = 0.15 / 3600 * np.cos(np.radians(30)), 0.15 / 3600 * np.sin(np.radians(30))
    plane.wcs.crpix, plane.wcs.cd = [500.5, 400.5], [[-c * stretch, s], [s * stretch, c]]
    ra, dec = plane.all_pix2world(x, y, 1)
    dx, dy = rng.normal(0, 4e-3, (2, 200))  # pixels: measured, if by a very good camera
    table = Table({"x": x + dx, "y": y + dy, "ra": ra / 15 if hours else ra, "dec": dec})
    detector = {"name": "A", "size": (1000, 800)}
    detector |= {} if scale_mas is None else {"scale_mas": scale_mas}
    data = {"matches": "stars.ecsv", "sigma": 0.01}
    return write_job(folder, table, data=data, detector=detector, budget=None)


def test_a_field_too_wide_for_a_tangent_plane_is_named(rng):
    """120 degrees: tan(60 degrees) = 1.73 rad on either side of the tangent point."""
    angle = np.radians(np.linspace(-60, 60, 50))
    u, v = np.degrees(np.tan(angle)), np.degrees(np.tan(rng.permutation(angle))) / 2
    x, y = rng.uniform(1, 1000, 50), rng.uniform(1, 800, 50)
    table = Matches(
        x=x, y=y, u=u, v=v, unit="deg", sources=("stars.ecsv",), tangent_point=(10.0, 20.0)
    )
    with pytest.raises(InputError, match=r"some 120 degrees wide.*198\.5 degrees.*in parts"):
        doubts(table)
    own = replace(table, tangent_point=None)
    with pytest.raises(InputError, match=r"span 198\.5 degrees if they are in deg; correct data"):
        doubts(own)


def test_right_ascensions_in_hours_are_named(rng, tmp_path):
    done = cli("check", job(tmp_path / "hours", rng, hours=True))
    assert done.code == 1 and "right ascensions in hours" in done.err
    assert "multiply ra by 15" in done.err


def test_a_stated_scale_that_is_not_that_of_the_fit_is_refused(rng, tmp_path):
    done = cli("check", job(tmp_path / "wrong", rng, scale_mas=400.0))
    assert done.code == 1 and "detector.scale_mas" in done.err
    assert "given as 400 mas, but that of the fit is 150.0" in done.err


def test_check_says_the_geometry(rng, tmp_path):
    done = cli("check", job(tmp_path / "right", rng, scale_mas=150.5))
    assert done.code == 0, done.err
    said = next(line for line in done.out.splitlines() if line.startswith("geometry"))
    assert "chip 1: scale 150.000 x 150.000 mas/px" in said and "parity -1" in said
    assert "+y at 30.00 degrees" in said and "the pixel is" not in done.out


@pytest.mark.parametrize("mirrored", [True, False])
def test_mirrored_pixels_are_named(rng, tmp_path, mirrored):
    path = job(tmp_path / "parity", rng)
    if mirrored:
        table = Table.read(path.parent / "stars.ecsv")
        table["x"] = 1001 - table["x"]
        table.write(path.parent / "stars.ecsv", overwrite=True)
    said = cli("check", path)
    assert said.code == 0, said.err
    assert ("chip 1 shows the sky mirrored" in said.out) == mirrored


def test_swapped_pixels_are_named(rng, tmp_path):
    path = job(tmp_path / "swapped", rng)
    table = Table.read(path.parent / "stars.ecsv")
    table["x"], table["y"] = table["y"].copy(), table["x"].copy()
    table.write(path.parent / "stars.ecsv", overwrite=True)
    said = cli("check", path)
    assert said.code == 1
    assert "if x and y, or the size, are swapped" in said.err


def test_pixels_that_are_not_square_are_a_warning(rng, tmp_path):
    done = cli("check", job(tmp_path / "oblong", rng, stretch=1.1))
    assert done.code == 0, done.err
    assert "WARNING      the pixel is 165.000 x 150.000 mas/px (chip 1)" in done.out


def test_pixels_that_are_called_an_angle(rng):
    with pytest.raises(InputError, match=r"span 9\d\d degrees if they are in deg"):
        doubts(stars(rng, unit="deg"))
    # an arcsecond in a pixel may be meant, unless the configuration says otherwise
    assert doubts(stars(rng, unit="arcsec")) == []
    [text] = doubts(stars(rng, unit="arcsec"), detector="scale_mas = 50.0")
    assert "span 20 times what pixels and detector.scale_mas = 50 say" in text
    with pytest.raises(InputError, match="span 2e\\+04 times"):
        doubts(stars(rng, unit="arcsec"), detector="scale_mas = 0.05")
    assert doubts(stars(rng, 0.05, "arcsec", 1e-3), detector="scale_mas = 50.0") == []


def test_the_scale_of_a_mosaic_is_that_of_its_chips(rng):
    """Chips side by side span many times the pixels of one."""
    n = 1600
    chip = rng.integers(0, 64, n)
    found = stars(rng, n=n, chip=chip, chip_numbers=tuple(range(1, 65)))
    beside = replace(found, u=found.u + 1100 * (chip % 8), v=found.v + 900 * (chip // 8))
    assert doubts(beside) == []
    [text] = doubts(replace(beside, u=5 * found.u, v=5 * found.v))
    assert "span 5 times what pixels say" in text


# -- errors and dates -----------------------------------------------------------------------------


def test_errors_that_no_detector_reaches(rng):
    with pytest.raises(InputError, match="half of the errors are below 1e-09 px"):
        doubts(stars(rng, sigma=1e-9))
    some = np.full(200, 0.01)
    some[3] = 1e-8
    found = replace(stars(rng), sigma_u=some)
    assert doubts(found) == ["the smallest of the quoted errors is 1e-08 px: check such rows"]


def test_dates_that_are_no_decimal_years(rng):
    with pytest.raises(InputError, match=r"an epoch is 55197\.5, and epochs are decimal years"):
        doubts(stars(rng, epoch=np.full(200, 55197.5)))
    [text] = doubts(stars(rng, epoch=np.full(200, 1920.0)))
    assert "between 1920.0 and 1920.0" in text
    assert doubts(stars(rng, epoch=np.full(200, 2004.5))) == []


def test_breaks_have_data_on_both_sides():
    dates = np.array([2002.5, 2004.0, 2010.0])

    def drift(*breaks):
        return TimeDependence((("u", 1, 0),), (2005.0,), breaks)

    for breaks in ((), (2003.0,), (2003.0, 2007.0)):
        refuse_empty_segments(dates, drift(*breaks))
    refuse_empty_segments(dates, None)
    for breaks, words in (
        ((2001.0,), "no data before the break at 2001"),
        ((2011.0,), "no data after the break at 2011"),
        ((2005.0, 2006.0), "no data after the break at 2005 and before that at 2006"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            refuse_empty_segments(dates, drift(*breaks))
        assert "2002.50 to 2010.00" in str(caught.value)


# -- configurations -------------------------------------------------------------------------------

REQUIREMENT = '[[requirement]]\nname = "a"\nstatistic = "max"\nlimit = 1\nregion = '
DEEP = "[" * 3000 + "]" * 3000


def requirement(more: str) -> str:
    return f'[[requirement]]\nname = "a"\nstatistic = "p95"\nlimit = 1.0\n{more}'


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"data": f"x = {DEEP}"}, "brackets"),
        ({"data": "epoch = " + "1" * 100_000}, "thousands of digits"),
        ({"data": "epoch = 1e300"}, "data.epoch: 1e+300 is not a plausible number"),
        ({"data": "sigma = 1e-300"}, "data.sigma: 1e-300 is not a plausible number"),
        ({"data": "epoch = 55197.5"}, "data.epoch: 55197.5 does not fit"),
        ({"data": "tangent_point = [0.0, 91.0]"}, "less than or equal to 90"),
        ({"data": "tangent_point = [1e9, 1e9]"}, "less than or equal to 360"),
        ({"more": "[model.tdd]\nterms = []\nepoch0 = 1e300"}, "model.tdd.epoch0: 1e+300 is no"),
        ({"more": "[model.tdd]\nterms = []\nepoch0 = 53000.0"}, "model.tdd.epoch0"),
        ({"more": "[fit]\nclip_chi2 = 1e300"}, "fit.clip_chi2: 1e+300 is not a plausible number"),
        ({"more": "[fit]\nclip_abs = 1e12"}, "fit.clip_abs: 1000000000000.0 does not fit"),
        ({"more": "[assess]\ngrid = [100000, 100000]"}, "assess.grid[1]: 100000 does not fit"),
        ({"more": "[assess]\ndraws = 1000000000"}, "assess.draws: 1000000000 does not fit"),
        (
            {"more": requirement("region = [[1, 1], [nan, 1], [5, 5]]")},
            "requirement[1].region[2][1]: nan does not fit; give a finite number",
        ),
        ({"more": "[sampler]\nensembles = 1000000"}, "sampler.ensembles: 1000000 does not fit"),
        (
            {"detector": "field = [[1, 1], [nan, 9], [9, 9]]"},
            "field[2][1]: nan does not fit; give a fi",
        ),
        (
            {"detector": "field = [[1, 1], [9, 9, 9]]"},
            "field[2]: [9, 9, 9] does not fit; give at most 2",
        ),
        (
            {"detector": "field = [[1, 1], [9, 9]]"},
            "c.toml: detector.field: a polygon of 2 corners",
        ),
        (
            {"detector": "field = {centre = [nan, 9], radius = 9}"},
            "field.centre[1]: nan does not fit; ",
        ),
        (
            {"more": f"{REQUIREMENT}[[1, 1], [9, inf]]"},
            "region[2][2]: inf does not fit; give a finite",
        ),
        (
            {"more": f"{REQUIREMENT}{{radius = nan}}"},
            "requirement[1].region.centre: this value is m",
        ),
        ({"more": 2 * '[[prior]]\nparameter = "u_1_0"\nmean = 1\nsigma = 1\n'}, "two [[prior]]"),
    ],
)
def test_settings_that_cannot_be_meant(settings, words):
    with pytest.raises(ConfigError) as caught:
        config(**settings)
    assert words in str(caught.value) and "c.toml" in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("way", [(10, 0), (7, 7)])
def test_displaced_stars_are_named_if_they_leave_the_jitter_open(way):
    """A fifth of the stars, ten errors from the others, in whichever direction."""
    rng, n, sigma = np.random.default_rng(5), 900, 0.02
    x, y = rng.uniform(1, 2048, (2, n))
    hit = rng.uniform(size=n) < 0.2
    u, v = (at + sigma * (rng.normal(size=n) + d * hit) for at, d in zip((x, y), way, strict=True))
    stars = bd.Matches.from_table(dict(x=x, y=y, u=u, v=v), sigma=sigma, unit="pix")
    with pytest.raises(DegenerateError, match="do not bound the additional scatter") as raised:
        bd.calibrate(stars, order=3, size=(2048, 2048))
    message = str(raised.value)
    assert "a likely cause is that" in message and "displaced from the others" in message
    assert "give the exposure of each star" in message and "check the unit" not in message
