"""Pixels to the output frame and back: the handbook's four steps, stwcs, closed forms, draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from bayesdist.calibration.apply import (
    Application,
    OutputFrame,
    Subarray,
    frame_that_holds,
    subarray_at_corner,
    subarray_of_header,
    subarrays_of_image,
)
from bayesdist.calibration.calibration import calibration_of
from bayesdist.calibration.inverse import fitted_inverse
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.format import idctab_calibration

from .acs_offline import Pointing, corrected, to_sky
from .siaf_acs import ZERO, siaf_calibration
from .stwcs_offline import original_exposure, separation_mas, updated
from .support import (
    F606W,
    StandIn,
    random_pixels,
    some_covariance,
    some_solution,
    wfc_model,
    wfc_solution,
)

SIZE = (4096, 2048)
POINTING = Pointing("2009-10-03", (5.66, -72.07), 71.3, vafactor=1.00003)


def headers(path):
    with fits.open(path) as hdus:
        return [hdu.header for hdu in hdus]


@pytest.fixture(scope="module")
def table(data_dir):
    return data_dir / "hst_reference" / "0461802ej_idc.fits"


@pytest.fixture(scope="module")
def wfc(real) -> Application:
    chips = idctab_calibration(real, "F606W,CLEAR2L").in_frame()
    return Application(chips, OutputFrame(idctab_calibration(real, "F606W,CLEAR2L").pixel()[0]))


def mirrored() -> Application:
    """A chip of no telescope: turned, mirrored, strongly bent, with errors."""
    solution = some_solution(3, unit="mas", pixel=40.0, angle=2.1, flip=True, strength=8.0)
    return Application(
        calibration_of(solution, "made up").in_frame(), OutputFrame(35.0, (700.0, 400.0))
    )


# -- forward --------------------------------------------------------------------------------------


def test_four_steps_written_out_from_the_columns_of_the_table(table, wfc):
    """Offset, sum of CXnj x^j y^(n-j), division by SCALE, offset of V2REF and V3REF."""
    rows = fits.getdata(table, 1)
    x, y = random_pixels(SIZE, 200)

    def record(chip):
        named = (rows["FILTER1"] == "F606W") & (rows["FILTER2"] == "CLEAR2L")
        return rows[named & (rows["DETCHIP"] == chip)][0]

    base = record(2)
    for chip in (1, 2):
        r = record(chip)
        dx, dy = x - r["XREF"], y - r["YREF"]
        X, Y = (
            sum(
                r[f"C{axis}{n}{j}"] * dx**j * dy ** (n - j)
                for n in range(1, 6)
                for j in range(n + 1)
            )
            for axis in "XY"
        )
        # V2 runs with Xc and V3 against Yc
        X, Y = X + r["V2REF"] - base["V2REF"], Y - (r["V3REF"] - base["V3REF"])
        at = wfc.forward(x, y, chip=chip)
        assert_allclose(at.x, X / 0.05, atol=1e-8, rtol=0)
        assert_allclose(at.y, Y / 0.05, atol=1e-8, rtol=0)
        assert at.cov is None and np.isnan(at.sigma_x).all() and np.isnan(at.correlation).all()


def test_both_chips_lie_on_the_sky_where_stwcs_puts_them(table, real, tmp_path):
    """With drift and velocity aberration: 0.1 mas."""
    chips = idctab_calibration(real, "F606W,CLEAR2L").in_frame(POINTING.epoch)
    a = Application(chips, OutputFrame(0.05, (3.0, -8.0)))  # VAFACTOR is in `to_sky`
    record = real.rows[real.row(2, F606W)]
    v2v3 = float(record["V2REF"]), float(record["V3REF"])
    theirs = corrected(tmp_path, "full", POINTING, idctab=table)
    x, y = random_pixels(SIZE, 500)
    for chip, wcs in theirs.items():
        at = a.forward(x, y, chip=chip)
        ours = to_sky(0.05 * np.stack([at.x - 3.0, at.y + 8.0], axis=1), POINTING, v2v3)
        assert separation_mas(ours, wcs.all_pix2world(np.stack([x, y], axis=1), 1)).max() < 0.1


def test_velocity_aberration_stretches_the_frame_about_its_zero_point(wfc):
    frame = replace(wfc.frame, origin=(10.0, 20.0), vafactor=1.0001)
    x, y = random_pixels(SIZE, 50)
    plain, at = (replace(wfc, frame=f).forward(x, y, chip=1) for f in (wfc.frame, frame))
    assert_allclose(at.x, 10.0 + 1.0001 * plain.x, rtol=1e-14)
    assert_allclose(at.y, 20.0 + 1.0001 * plain.y, rtol=1e-14)
    back = replace(wfc, frame=frame).inverse(at.x, at.y, chip=1)
    assert_allclose([back.x, back.y], [x, y], atol=1e-8, rtol=0)


def test_the_frame_holds_every_pixel_and_nothing_less_would(wfc):
    frame, size = frame_that_holds(wfc.chips, 0.05)
    a = replace(wfc, frame=frame)
    edges = np.linspace(0.5, 4096.5, 4097), np.linspace(0.5, 2048.5, 2049)
    ends = []
    for chip in (1, 2):
        for y in (0.5, 2048.5):
            ends.append(a.forward(edges[0], np.full(4097, y), chip=chip))
        for x in (0.5, 4096.5):
            ends.append(a.forward(np.full(2049, x), edges[1], chip=chip))
    for axis, n in zip("xy", size, strict=True):
        values = np.concatenate([getattr(e, axis) for e in ends])
        assert 0.5 <= values.min() < 1.5 and n - 0.5 < values.max() <= n + 0.5


# -- errors ---------------------------------------------------------------------------------------


def test_errors_are_those_of_the_position_from_the_reference_zero_point(real):
    """By the model's own derivatives: D(x) - D(zero point of chip 2)."""
    s = wfc_solution(real)
    a = Application(calibration_of(s, "made up").in_frame(2011.0), OutputFrame(0.05))
    x, y = random_pixels(SIZE, 40)
    at_zero = s.model.jacobian(s.mean, [2048.0], [1024.0], epoch=2011.0, chip=2)[0]
    value = s.model.predict(s.mean, [2048.0], [1024.0], epoch=2011.0, chip=2)[0]
    for chip in (1, 2):
        by = s.model.jacobian(s.mean, x, y, epoch=2011.0, chip=chip) - at_zero
        uv = s.model.predict(s.mean, x, y, epoch=2011.0, chip=chip) - value
        at = a.forward(x, y, chip=chip)
        assert_allclose(np.stack([at.x, at.y], axis=1), uv / 0.05, atol=1e-8, rtol=0)
        wanted = by @ s.cov @ np.swapaxes(by, 1, 2) / 0.05**2
        assert_allclose(at.cov, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
        assert_allclose(at.sigma_x, np.sqrt(wanted[:, 0, 0]), rtol=1e-9)
        assert (np.abs(at.correlation) < 1).all()
    zero = a.forward([2048.0], [1024.0], chip=2)
    assert abs(zero.x[0]) < 1e-9 and zero.sigma_x[0] < 1e-9 * at.sigma_x.max()


@pytest.mark.parametrize("epoch", [2004.5, 2016.0])
def test_a_table_with_its_covariance_says_the_same_as_the_solution(real, epoch):
    """COVAR holds V2REF, V3REF of both chips, coefficients and rates."""
    s = wfc_solution(real)
    tab = idctab_from_solution(s, instrument="ACS", detector="WFC", v2ref=256.6, v3ref=302.3)
    frame = OutputFrame(0.05, (7.0, 8.0))
    of_table = Application(idctab_calibration(tab).in_frame(epoch), frame)
    of_solution = Application(calibration_of(s, "made up").in_frame(epoch), frame)
    x, y = random_pixels(SIZE, 40)
    for chip in (1, 2):
        a, b = (one.forward(x, y, chip=chip) for one in (of_table, of_solution))
        assert_allclose([a.x, a.y], [b.x, b.y], atol=1e-8, rtol=0)
        assert_allclose(a.cov, b.cov, rtol=1e-7, atol=1e-9 * np.abs(b.cov).max())
        assert a.sigma_x.min() > 0 and list(of_table.chips) == [2, 1]


def test_filters_have_their_own_errors():
    """Two solutions in one file: each row finds its numbers, those of the zero point included."""
    model = wfc_model(3, drift=False)
    rng = np.random.default_rng(4)
    frame = OutputFrame(0.05)
    solutions = {}
    for name in ("F606W", "F814W"):
        theta = np.zeros(model.n_params)
        for chip, gap in ((2, 0.0), (1, 104.0)):
            basis = model.basis(chip)
            for axis in (0, 1):
                c = rng.normal(size=basis.n_terms) * 1e-12
                c[0], c[1 + axis] = gap * axis + rng.normal(), 0.05
                theta[model.coefficient_slice(chip, axis)] = basis.from_monomials(c)
        solutions[name] = StandIn(model, theta, some_covariance(theta.size, 1e-3, rng))
    tab = idctab_from_solution(solutions, instrument="ACS", detector="WFC")
    x, y = random_pixels(SIZE, 20)
    for name, s in solutions.items():
        a = Application(idctab_calibration(tab, name).in_frame(), frame).forward(x, y, chip=1)
        b = Application(calibration_of(s, name).in_frame(), frame).forward(x, y, chip=1)
        assert_allclose([a.x, a.y], [b.x, b.y], atol=1e-8, rtol=0)
        assert_allclose(a.cov, b.cov, rtol=1e-7, atol=1e-9 * np.abs(b.cov).max())
    with pytest.raises(InputError, match="differ from filter to filter"):
        idctab_calibration(tab).in_frame()


# -- back -----------------------------------------------------------------------------------------


def test_newton_undoes_the_forward_map(wfc):
    for a in (wfc, mirrored()):
        for chip, c in a.chips.items():
            x, y = random_pixels(c.basis.size, 3000)
            at = a.forward(x, y, chip=chip)
            back = a.inverse(at.x, at.y, chip=chip)
            assert np.hypot(back.x - x, back.y - y).max() < 1e-8
            assert a.closure(chip) < 1e-8


def test_errors_of_pixels_are_those_of_the_frame_through_the_slope():
    """By finite differences of the inverse."""
    a = mirrored()
    x, y = random_pixels((1200.0, 900.0), 30)
    at = a.forward(x, y, chip=1)
    h = 1e-3
    slope = np.empty((30, 2, 2))
    for k, (dx, dy) in enumerate(((h, 0.0), (0.0, h))):
        high, low = (a.inverse(at.x + s * dx, at.y + s * dy, chip=1) for s in (1, -1))
        slope[:, 0, k], slope[:, 1, k] = (high.x - low.x) / (2 * h), (high.y - low.y) / (2 * h)
    back = a.inverse(at.x, at.y, chip=1)
    wanted = slope @ at.cov @ np.swapaxes(slope, 1, 2)
    assert_allclose(back.cov, wanted, rtol=1e-5, atol=1e-8 * np.abs(wanted).max())


def test_positions_find_their_chip_and_none_in_the_gap(wfc):
    x, y = random_pixels(SIZE, 300)
    for chip in (1, 2):
        at = wfc.forward(x, y, chip=chip)
        found = wfc.locate(at.x, at.y)
        assert (found.chip == chip).all()
        assert_allclose([found.x, found.y], [x, y], atol=1e-8, rtol=0)
    upper, lower = wfc.forward([2000.0], [0.0], chip=1), wfc.forward([2000.0], [2049.0], chip=2)
    between = [(upper.x[0] + lower.x[0]) / 2, 1e7, np.nan], [(upper.y[0] + lower.y[0]) / 2, 0, 0]
    found = wfc.locate(*between)
    assert (found.chip == 0).all() and np.isnan(found.x).all() and np.isnan(found.y).all()
    lost = mirrored().locate([1e9, np.nan], [0.0, 0.0])
    assert np.isnan(lost.cov).all() and np.isnan(lost.correlation).all()


@pytest.mark.parametrize("detector", ["HRC", "SBC"])
def test_hrc_and_sbc_by_their_aperture_file(detector):
    a = Application({1: siaf_calibration(detector)}, OutputFrame(0.025))
    zero = a.forward(*([v] for v in ZERO), chip=1)
    assert_allclose([zero.x[0], zero.y[0]], 0.0, atol=1e-10)
    assert a.closure(1) < 1e-8


def test_a_fitted_inverse_says_its_own_error(wfc):
    """On pixels that it was not judged on, and falling with the order."""
    rng = np.random.default_rng(3)
    for a, chip in ((wfc, 1), (mirrored(), 1)):
        one = a.chips[chip]
        x, y = (rng.uniform(1, n, 20_000) for n in one.basis.size)
        closures = []
        for order in (3, 4, 5, 6):
            fitted = fitted_inverse(one, order)
            closure, rms = fitted.misses(one)
            px, py = fitted.pixels(*one.at(x, y))
            miss = np.hypot(px - x, py - y)
            assert 0.3 * closure < miss.max() <= closure * (1 + 1e-6)
            assert np.sqrt(np.mean(miss**2)) == pytest.approx(rms, rel=0.1)
            closures.append(closure)
        assert np.all(np.diff(closures) < 0)
    # what plain least squares leaves on WFC1 at orders 4 to 7, pixels
    for order, left in ((4, 0.070), (5, 0.0067), (6, 7e-4), (7, 7e-5)):
        assert fitted_inverse(wfc.chips[1], order).misses(wfc.chips[1])[0] < left
    assert fitted_inverse(wfc.chips[1]).order == 6
    for order in (0, 13):
        with pytest.raises(InputError, match="order of the inverse"):
            fitted_inverse(wfc.chips[1], order)


def test_inverse_rows_close_as_the_file_says(real):
    s = wfc_solution(real)
    tab = idctab_from_solution(s, instrument="ACS", detector="WFC", inverse=True)
    found = idctab_calibration(tab)
    x, y = random_pixels(SIZE, 100)
    for chip, one in found.at(origin="chip").items():
        rows = found.inverses[chip]
        closure, _ = rows.misses(one)
        assert closure == pytest.approx(tab.header[f"BDCLOS_{chip}"], rel=1e-6)
        px, py = rows.pixels(*one.at(x, y))
        assert 0 < np.hypot(px - x, py - y).max() <= closure
    assert not idctab_calibration(real, "F606W").inverses


# -- subarrays ------------------------------------------------------------------------------------


def test_subarrays_lie_on_the_sky_where_stwcs_puts_them(table, real, tmp_path):
    """LTV of a header, followed by stwcs and by us."""
    hdus = original_exposure(table, POINTING.date, PA_V3=POINTING.pa_v3)
    corner = {2: (1001, 301), 1: (2049, 1101)}
    for hdu in hdus[1:]:
        x, y = corner[hdu.header["CCDCHIP"]]
        hdu.data = np.zeros((512, 1024), np.float32)
        hdu.header["LTV1"], hdu.header["LTV2"] = 1.0 - x, 1.0 - y
        hdu.header["CRPIX1"] += 1.0 - x
        hdu.header["CRPIX2"] += 1.0 - y
        hdu.header["CRVAL1"], hdu.header["CRVAL2"] = POINTING.crval
        hdu.header["VAFACTOR"] = POINTING.vafactor
    theirs = updated(hdus, tmp_path / "sub_flt.fits")
    images = subarrays_of_image(headers(tmp_path / "sub_flt.fits"), {1: SIZE, 2: SIZE})
    chips = idctab_calibration(real, "F606W,CLEAR2L").in_frame(POINTING.epoch)
    whole = Application(chips, OutputFrame(0.05))
    part = replace(whole, images=images)
    x, y = random_pixels((1024, 512), 100)
    record = real.rows[real.row(2, F606W)]
    v2v3 = float(record["V2REF"]), float(record["V3REF"])
    for chip, (x0, y0) in corner.items():
        at = part.forward(x, y, chip=chip)
        same = whole.forward(x + x0 - 1, y + y0 - 1, chip=chip)
        assert_allclose([at.x, at.y], [same.x, same.y], atol=1e-9, rtol=0)
        back = part.inverse(at.x, at.y, chip=chip)
        assert_allclose([back.x, back.y], [x, y], atol=1e-8, rtol=0)
        if chip == 2:  # real subarrays are of one chip: stwcs takes the first one's corner for both
            ours = to_sky(0.05 * np.stack([at.x, at.y], axis=1), POINTING, v2v3)
            sky = theirs[chip].all_pix2world(np.stack([x, y], axis=1), 1)
            assert separation_mas(ours, sky).max() < 0.1


def test_ways_to_say_where_a_subarray_lies():
    by_ltv = subarray_of_header({"NAXIS1": 512, "NAXIS2": 512, "LTV1": -1000.0, "LTV2": -30}, SIZE)
    assert by_ltv.to_chip(1.0, 1.0) == (1001.0, 31.0)
    assert subarray_at_corner(1001, 31).ltv == by_ltv.ltv
    binned = Subarray((0.25, 0.25), (0.5, 0.5))  # two pixels in one: centres at 1.5, 3.5, ...
    assert binned.to_chip([1.0, 2.0], [1.0, 2.0])[0].tolist() == [1.5, 3.5]
    assert binned.from_chip(1.5, 3.5) == (1.0, 2.0)
    # behind a polariser the distortion is for the image, wherever it lies on the chip
    pol = {"NAXIS1": 2048, "NAXIS2": 2046, "LTV1": -1024.0, "LTV2": 0.0}
    assert subarray_of_header(pol, (2048, 2046)).ltv == (0.0, 0.0)


def test_what_is_no_subarray_is_refused(tmp_path):
    with pytest.raises(InputError, match="has no LTV1"):
        subarray_of_header({"NAXIS1": 512, "NAXIS2": 512}, SIZE)
    with pytest.raises(InputError, match="positive LTM"):
        Subarray((0.0, 0.0), (0.0, 1.0))
    image = fits.ImageHDU(np.zeros((4, 4), np.float32), name="SCI")
    image.header["CCDCHIP"] = 7
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(tmp_path / "a.fits")
    with pytest.raises(InputError, match="chip 7"):
        subarrays_of_image(headers(tmp_path / "a.fits"), {1: SIZE})
    image.header["CCDCHIP"] = 1
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(tmp_path / "b.fits")
    with pytest.raises(InputError, match="chip 1: has no LTV1"):
        subarrays_of_image(headers(tmp_path / "b.fits"), {1: SIZE})
    fits.PrimaryHDU().writeto(tmp_path / "c.fits")
    with pytest.raises(FormatError, match="no SCI extension"):
        subarrays_of_image(headers(tmp_path / "c.fits"), {1: SIZE})


def test_what_cannot_be_applied_is_refused(real, wfc):
    with pytest.raises(InputError, match="the scale is 0"):
        OutputFrame(0.0)
    with pytest.raises(InputError, match="aberration factor is -1"):
        OutputFrame(0.05, vafactor=-1.0)
    with pytest.raises(InputError, match="the origin"):
        OutputFrame(0.05, (np.nan, 0.0))
    with pytest.raises(InputError, match="no chip 3"):
        wfc.forward([1.0], [1.0], chip=3)
    s = wfc_solution(real)
    with pytest.raises(InputError, match="depends on time"):
        calibration_of(s, "made up").in_frame()
    flat = wfc.chips[2].coefficients * np.array([[1.0], [0.0]])
    folded = replace(wfc, chips={2: replace(wfc.chips[2], coefficients=flat)})
    with pytest.raises(InputError, match="singular linear part"):
        folded.inverse([0.0], [0.0], chip=2)


def test_every_filter_has_the_errors_of_the_drift(real):
    """The rates stand in COVAR once, with the first filter's numbers."""
    s = wfc_solution(real)
    other = replace(s, mean=s.mean + np.where(np.arange(s.mean.size) == 0, 1e-3, 0.0))
    both = {"F606W": s, "F814W": other}
    tab = idctab_from_solution(both, instrument="ACS", detector="WFC")
    a, b = (
        Application(idctab_calibration(tab, name).in_frame(2020.0), OutputFrame(0.05)).forward(
            [1.0, 4000.0], [1.0, 300.0], chip=1
        )
        for name in both
    )
    then = Application(idctab_calibration(tab, "F814W").in_frame(), OutputFrame(0.05))
    # what 15 years add is there in both, though their correlation with the rest differs
    for one in (a, b):
        ratio = one.sigma_x / then.forward([1.0, 4000.0], [1.0, 300.0], chip=1).sigma_x
        assert (ratio > 1.5).all()
