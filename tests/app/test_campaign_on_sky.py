"""A campaign whose catalogue has right ascension and declination, seen by astropy's own WCS.

The stars move and have parallaxes; each exposure is a TAN-SIP header at its own direction and roll,
of a detector that sees the sky as it is or mirrored.  Nothing of the package makes these data.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from astropy import units as apu
from astropy.coordinates import SkyCoord, get_body_barycentric
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from astropy.wcs import WCS
from scipy import stats

from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches, read_matches
from bayesdist.infer import load_fit, load_posterior, residuals
from bayesdist.infer.solution.transforms import without_frames
from tests.app.support import (
    carried_out,
    cli,
    good,
    one_sentence,
    refused,
    summary_of,
    write_config,
)
from tests.reduced import case_in_full

SIDE, PIXEL = 1024, 0.05  # pixels, arcsec
MIDDLE = (SIDE + 1) / 2
FIELD = (150.3, -47.2)
DATES = (2009.2, 2011.7, 2013.5, 2014.9, 2016.4)
CATALOGUE = 2016.0
CENTROID = 0.02  # px
ERROR, MOTION = 0.3, 0.1  # mas, mas a year, which the catalogue states
# of the SIP polynomials, at half a side in pixels
TERMS = {(2, 0): (3.1, -1.4), (1, 1): (-2.2, 2.6), (0, 2): (1.2, 3.4), (3, 0): (0.4, -0.2),
         (1, 2): (-0.3, 0.5), (2, 1): (0.2, 0.3), (0, 3): (-0.1, 0.4)}  # fmt: skip


def bent(x, y, left=0.0):
    """Pixels from the middle after the SIP polynomials, in error by a part of these."""
    x, y = np.asarray(x, float) - MIDDLE, np.asarray(y, float) - MIDDLE
    half = SIDE / 2
    powers = {k: (x / half) ** k[0] * (y / half) ** k[1] for k in TERMS}
    return tuple(
        (1 - left) * sum(c[axis] * powers[k] for k, c in TERMS.items()) + at
        for axis, at in enumerate((x, y))
    )


def largest_distortion():
    """Largest deviation of `bent` from its best linear map over the chip, pixels."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(0.5, SIDE + 0.5, 21)] * 2))
    design = np.column_stack([np.ones_like(x), x, y])
    plane = np.column_stack(bent(x, y))
    best = np.linalg.lstsq(design, plane, rcond=None)[0]
    return np.hypot(*(plane - design @ best).T).max() / np.sqrt(abs(np.linalg.det(best[1:])))


def header(direction, roll, parity, factor):
    """The WCS of an exposure; parity -1 as the sky is seen, with east to the left of north."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN-SIP", "DEC--TAN-SIP"]
    wcs.wcs.crpix, wcs.wcs.crval = [MIDDLE, MIDDLE], direction
    a = np.radians(roll)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    # positions over VAFACTOR are those of the catalogue
    wcs.wcs.cd = factor * PIXEL / 3600 * turn @ np.diag([parity, 1.0])
    A, B = np.zeros((4, 4)), np.zeros((4, 4))
    for (i, j), (a, b) in TERMS.items():
        A[i, j], B[i, j] = np.array([a, b]) / (SIDE / 2) ** (i + j)
    cards = fits.Header(wcs.to_header())
    for name, matrix in (("A", A), ("B", B)):
        cards[f"{name}_ORDER"] = 3
        for i, j in TERMS:
            cards[f"{name}_{i}_{j}"] = matrix[i, j]
    cards["CTYPE1"], cards["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
    return WCS(cards)


@dataclass
class Sky:
    """Stars as they are."""

    ra: np.ndarray
    dec: np.ndarray
    pm: np.ndarray  # mas a year, with the factor cos(dec)
    parallax: np.ndarray  # mas
    mag: np.ndarray

    def seen(self, year):
        """Directions (N, 2) at a date, from the Earth: vectors from the one to the other."""
        stars = SkyCoord(
            self.ra * apu.deg,
            self.dec * apu.deg,
            distance=1000 / self.parallax * apu.pc,
            pm_ra_cosdec=self.pm[0] * apu.mas / apu.yr,
            pm_dec=self.pm[1] * apu.mas / apu.yr,
            radial_velocity=np.zeros(len(self.ra)) * apu.km / apu.s,
            obstime=Time(CATALOGUE, format="jyear", scale="tdb"),
        )
        now = Time(year, format="jyear", scale="tdb")
        there = stars.apply_space_motion(new_obstime=now).cartesian.xyz.to_value("au")
        earth = get_body_barycentric("earth", now).xyz.to_value("au")
        x, y, z = there - earth[:, None]
        return np.column_stack(
            [np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))]
        )


def sky(rng, n=900):
    reach = 0.9 * SIDE * PIXEL / 3600
    east, north = rng.uniform(-reach, reach, (2, n))
    return Sky(
        FIELD[0] + east / np.cos(np.radians(FIELD[1])),
        FIELD[1] + north,
        rng.normal([[-6.0], [4.0]], 3.0, (2, n)),
        rng.uniform(0.2, 4.0, n),
        rng.uniform(15, 20, n),
    )


# of the errors of ra, dec, pmra and pmdec, where they are correlated
CORRELATIONS = np.array(
    [[1.0, 0.8, -0.3, -0.2], [0.8, 1.0, -0.2, -0.2], [-0.3, -0.2, 1.0, 0.7], [-0.2, -0.2, 0.7, 1.0]]
)
# centroids of trailed images: errors on x and y, px, and their correlation
TRAILED, RHO = (0.035, 0.02), 0.9


def gaia(rng, stars, correlations=None):
    """The catalogue as the archive writes it: no units in the file."""
    n = len(stars.ra)
    normal = rng.standard_normal((4, n))
    if correlations is not None:
        normal = np.linalg.cholesky(correlations) @ normal
    off = ERROR / 3.6e6 * normal[:2]
    pm = stars.pm + MOTION * normal[2:]
    table = Table({"source_id": 4_000_000_000_000_000_000 + 7 * np.arange(n)})
    table["ra"] = stars.ra + off[0] / np.cos(np.radians(stars.dec))
    table["ra_error"] = np.full(n, ERROR)
    table["dec"] = stars.dec + off[1]
    table["dec_error"] = np.full(n, ERROR)
    table["parallax"] = stars.parallax + 0.1 * rng.standard_normal(n)
    table["parallax_error"] = np.full(n, 0.1)
    table["pmra"], table["pmdec"] = pm
    table["pmra_error"] = table["pmdec_error"] = np.full(n, MOTION)
    table["ref_epoch"] = np.full(n, CATALOGUE)
    table["phot_g_mean_mag"] = stars.mag
    names = ("ra", "dec", "pmra", "pmdec")
    for i, j in combinations(range(4), 2) if correlations is not None else ():
        table[f"{names[i]}_{names[j]}_corr"] = np.full(n, correlations[i, j])
    return table


def write(folder: Path, sense: int, *, seed=1, change=None, tilted=False, **campaign) -> Path:
    """Catalogue, log, lists, known distortion and configuration; the path of the last.

    If `tilted`, errors of the catalogue and of the centroids are correlated.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    stars = sky(rng)
    table = gaia(rng, stars, CORRELATIONS if tilted else None)
    table = table if change is None else change(table)
    table.write(folder / "catalog.csv")
    log = Table(
        names=("exposure", "epoch", "vafactor", "ra", "dec"), dtype=("U8", *"f8 f8 f8 f8".split())
    )
    (folder / "lists").mkdir()
    for k, date in enumerate(DATES):
        ra, dec = FIELD + rng.uniform(-8, 8, 2) / 3600
        factor = 1 + 5e-5 * np.sin(2 * np.pi * date)
        wcs = header((ra, dec), 70.0 * k + 11, sense, factor)
        x, y = wcs.all_world2pix(stars.seen(date), 1).T
        on = (x > 1) & (x < SIDE) & (y > 1) & (y < SIDE)
        errors = CENTROID * np.eye(2)
        if tilted:
            mixed = RHO * np.multiply(*TRAILED)
            errors = np.linalg.cholesky([[TRAILED[0] ** 2, mixed], [mixed, TRAILED[1] ** 2]])
        x, y = np.stack([x[on], y[on]]) + errors @ rng.standard_normal((2, on.sum()))
        mag = stars.mag[on] - 27.0 + 0.02 * rng.standard_normal(on.sum())
        false = rng.uniform(1, SIDE, (2, 15))
        columns = {
            "x": np.append(x, false[0]),
            "y": np.append(y, false[1]),
            "mag": np.append(mag, rng.uniform(-12, -7, 15)),
        }
        if tilted:
            columns |= {"x_err": TRAILED[0], "y_err": TRAILED[1], "rho_xy": RHO}
        Table({name: np.broadcast_to(v, len(columns["x"])) for name, v in columns.items()}).write(
            folder / "lists" / f"e{k}.parquet"
        )
        log.add_row((f"e{k}", date, factor, ra, dec))
    log["filter"] = "F606W"
    log.write(folder / "exposures.ecsv")
    _start(folder / "start_idc.fits")
    files = {"catalog": "catalog.csv", "exposures": "exposures.ecsv", "lists": "lists"}
    return write_config(
        folder / "config.toml",
        data=None,
        campaign=files | {"initial_distortion": "start_idc.fits"} | campaign,
        tables={"method": "none"},
        detector={"scale_mas": 1000 * PIXEL},
        chip=[
            {"number": 1, "name": "WFC", "size": (SIDE, SIDE), "reference_pixel": (MIDDLE, MIDDLE)}
        ],
        model={"order": 3},
        assess={"grid": (9, 9), "draws": 400, "epoch": 2012.0},
    )


def _start(path: Path) -> None:
    """The known distortion, in error by a twentieth."""
    powers = [(i, j) for i in range(1, 4) for j in range(i + 1)]  # x^j y^(i-j)
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(1, SIDE, 20)] * 2))
    design = np.stack([(x - MIDDLE) ** j * (y - MIDDLE) ** (i - j) for i, j in powers], axis=1)
    size = np.abs(design).max(axis=0)
    row = {"DETCHIP": [1], "DIRECTION": ["FORWARD"], "XSIZE": [SIDE], "YSIZE": [SIDE]}
    row |= {"XREF": [MIDDLE], "YREF": [MIDDLE], "V2REF": [0.0], "V3REF": [0.0], "SCALE": [PIXEL]}
    for name, values in zip(("CX", "CY"), bent(x, y, left=0.05), strict=True):
        c = np.linalg.lstsq(design / size, PIXEL * values, rcond=None)[0] / size
        row |= {f"{name}{i}{j}": [c[k]] for k, (i, j) in enumerate(powers)}
    primary = fits.PrimaryHDU()
    primary.header.update({"INSTRUME": "ACS", "DETECTOR": "WFC", "NORDER": 3, "PARITY": -1})
    fits.HDUList([primary, fits.BinTableHDU(Table(row))]).writeto(path)


def in_place(config: Path) -> str:
    """A configuration whose files are named from anywhere."""
    text = config.read_text(encoding="utf-8")
    for name in ("catalog.csv", "exposures.ecsv", "start_idc.fits", "lists"):
        text = text.replace(f'"{name}"', f'"{config.parent / name}"')
    return text


def staged(config: Path, *stages: str) -> Path:
    """A run of which these stages are made."""
    run = config.parent / "run"
    run.mkdir()
    (run / "config.toml").write_text(in_place(config), encoding="utf-8")
    return carried_out(run, *stages)


def unmatched(config: Path, *words: str) -> str:
    """The sentence, with these words, by which star lists are refused when they are matched."""
    run = config.parent / "run"
    run.mkdir()
    (run / "config.toml").write_text(in_place(config), encoding="utf-8")
    result = cli("stage", "match", run, "-q")
    assert result.code == 1
    one_sentence(result.err, *words)
    return result.err


def off_truth(run: Path) -> tuple[float, int]:
    """Chi-square of predicted less true positions over the detector, and its degrees of freedom.

    Shift, roll and scale are the frames', and are taken out of both; a mirror image is not.
    """
    fit = without_frames(load_fit(run / "fit.nc"))
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(30, SIDE - 30, 15)] * 2))
    true = np.array([1, 1j]) @ bent(x, y)
    design = np.column_stack([true, np.ones(len(true))])

    def left(theta):
        z = fit.model.predict(theta, x, y) @ [1, 1j]
        z = z - (design @ np.linalg.lstsq(design, z.T, rcond=None)[0]).T
        return np.concatenate([z.real, z.imag], axis=-1)

    # predictions are linear in the parameters: the columns are their derivatives
    moved = left(fit.mean + np.diag(np.sqrt(np.diag(fit.cov)))) - left(fit.mean)
    cov = (moved / np.sqrt(np.diag(fit.cov))[:, None]).T
    cov = cov @ fit.cov @ cov.T
    value, axes = np.linalg.eigh(cov)
    free = value > 1e-6 * value.max()
    off = axes.T[free] @ left(fit.mean)
    return float((off**2 / value[free]).sum()), int(free.sum())


def pulls_of_pairs(run: Path, parity: int) -> np.ndarray:
    """Pairs' positions less those that the Earth saw, over the stated errors (2, n)."""
    pairs = read_matches(run / "pairs", unit="arcsec")
    off = np.stack([pairs.u, pairs.v]) - positions_seen(run, parity, pairs).T
    return off / np.stack([pairs.sigma_u, pairs.sigma_v])


def positions_seen(run: Path, parity: int, pairs: Matches) -> np.ndarray:
    """Positions (N, 2) of the pairs' stars that the Earth saw, over the factor of aberration.

    On the plane that the run says, by astropy's TAN; u to the west where it is mirrored.
    """
    matching = summary_of(run)["matching"]
    plane = WCS(naxis=2)
    plane.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    plane.wcs.crval, plane.wcs.cdelt = matching["tangent_point"], [1 / 3600, 1 / 3600]
    stars = sky(np.random.default_rng(1))  # the first that the seed of `write` makes
    log = Table.read(run.parent / "exposures.ecsv")
    out = np.empty((len(pairs), 2))
    for row in log:
        here = pairs.exposure == pairs.exposure_names.index(row["exposure"])
        xi, eta = plane.all_world2pix(stars.seen(row["epoch"])[pairs.star[here]], 1).T
        out[here] = np.stack([-xi if parity < 0 else xi, eta], axis=1) / row["vafactor"]
    return out


BOTH = pytest.mark.parametrize(
    "parity",
    [
        case_in_full(-1, instead="the mirrored one is run", id="as the sky is seen"),
        pytest.param(1, id="mirrored"),
    ],
)


@BOTH
def test_both_parities_match_and_agree_with_the_truth(tmp_path, parity):
    """A normal detector needs no word; one of the other parity than ACS/WFC is doubted."""
    config = write(tmp_path / "in", parity)
    said = good("check", config).out
    assert "the middle of the exposures" in said
    assert "geometry     chip 1 of campaign.initial_distortion: scale 50.0" in said
    run = staged(config, "match", "fit")
    found = summary_of(run)["matching"]
    assert found["parity"] == ("mirrored" if parity < 0 else "direct")
    assert found["n_exposures"] == len(DATES) and found["completeness"]["median"] > 0.98
    assert [("mirrored against" in w) for w in found["warnings"]] == [True] * (parity > 0)
    told = (run / "bayesdist.log").read_text(encoding="utf-8")
    assert ("u is taken with the opposite sign and grows to the west" in told) == (parity < 0)
    # motions over seven years and parallaxes are many times the errors
    pulls = pulls_of_pairs(run, parity)
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 * len(DATES) / pulls.size))
    [shape] = summary_of(run)["fit"]["geometry"]
    assert shape["unit"] == "arcsec" and shape["parity"] == 1  # u is as the detector sees it
    # the mean frame of the exposures leaves the axes of the truth, which are perpendicular
    assert (shape["scale_x"], shape["scale_y"]) == pytest.approx((PIXEL, PIXEL), rel=1e-3)
    assert shape["skew"] == pytest.approx(0.0, abs=1e-3)
    assert shape["distortion"] == pytest.approx(largest_distortion(), rel=0.01)
    value, free = off_truth(run)
    assert 1e-4 < stats.chi2.sf(value, free) < 1 - 1e-4


def whitened(residual, covariance):
    """Residuals (N, 2) in units of their errors, turned least, without false matches."""
    value, axes = np.linalg.eigh(covariance)
    root = axes / np.sqrt(value)[:, None] @ np.swapaxes(axes, 1, 2)
    z = np.einsum("nij,nj->ni", root, residual)
    return z[np.hypot(*z.T) < 5]


def is_of_unit_covariance(z):
    square, product = np.mean(z**2), np.mean(z[:, 0] * z[:, 1])
    error = 4 / np.sqrt(len(z) / len(DATES))  # stars are seen up to five times
    return abs(square - 1) < error and abs(product) < error


@BOTH
def test_correlated_errors_are_carried_from_the_lists_to_the_posterior(tmp_path, parity):
    """Ellipses of the catalogue turn with the mirror image, those of centroids with the roll."""
    config = write(tmp_path / "in", parity, tilted=True)
    run = staged(config, "match")
    pairs = read_matches(run / "pairs", unit="arcsec")
    true = positions_seen(run, parity, pairs)
    off = np.stack([pairs.u, pairs.v], axis=1) - true
    assert is_of_unit_covariance(whitened(off, pairs.covariances()))
    along = off / np.stack([pairs.sigma_u, pairs.sigma_v], axis=1)
    assert np.mean(np.sign(pairs.rho_uv) * along[:, 0] * along[:, 1]) > 0.4
    config = write(tmp_path / "columns", parity, tilted=True, sigma="columns")
    run = staged(config, "match", "fit", "sample")
    of_catalogue, pairs = pairs, read_matches(run / "pairs", unit="arcsec")
    fit = load_fit(run / "fit.nc")
    np.testing.assert_array_equal(pairs.star, of_catalogue.star)
    added = np.linalg.eigvalsh(pairs.covariances() - of_catalogue.covariances())
    mixed = RHO * np.multiply(*TRAILED)
    expected = np.linalg.eigvalsh([[TRAILED[0] ** 2, mixed], [mixed, TRAILED[1] ** 2]])
    # the distortion changes the size of pixels by some per cent
    np.testing.assert_allclose(added / PIXEL**2, np.tile(expected, (len(pairs), 1)), rtol=0.1)
    left = residuals(fit, pairs)
    # 4 of 5 exposures have frames of their own: 8 of 10 numbers of some 1700 positions
    assert is_of_unit_covariance(whitened(left, pairs.covariances()))
    value, free = off_truth(run)
    assert 1e-4 < stats.chi2.sf(value, free) < 1 - 1e-4
    posterior = load_posterior(run / "posterior.nc")
    jitter = posterior.hyper["j"].mean() / PIXEL
    assert jitter < 0.4 * TRAILED[1]  # nothing is left to be explained


def test_a_parity_that_is_given_is_the_only_one(tmp_path):
    config = write(tmp_path / "in", 1, parity="direct")
    found = summary_of(staged(config, "match"))["matching"]
    assert found["parity"] == "direct" and not found["warnings"]
    config = write(tmp_path / "other", 1, parity="mirrored")
    unmatched(config, "its mirror image does match", "campaign.parity = 'direct'")


def test_another_field_is_refused_in_both_parities(tmp_path):
    def elsewhere(table):
        rng = np.random.default_rng(5)
        for name in ("ra", "dec"):
            table[name] = rng.permutation(np.asarray(table[name]))
        return table

    config = write(tmp_path / "in", -1, change=elsewhere)
    said = unmatched(config, "does not match", "the mirror image does not match either")
    assert "parity" not in said  # both were tried


def vizier(table):
    """The same as VizieR names it; positions are those of an epoch that the table does not have."""
    names = {"ra": "RA_ICRS", "dec": "DE_ICRS", "ra_error": "e_RA_ICRS", "dec_error": "e_DE_ICRS",
             "parallax": "Plx", "parallax_error": "e_Plx", "pmra": "pmRA", "pmdec": "pmDE",
             "pmra_error": "e_pmRA", "pmdec_error": "e_pmDE", "phot_g_mean_mag": "Gmag",
             "source_id": "Source"}  # fmt: skip
    for old, new in names.items():
        table.rename_column(old, new)
    table.remove_column("ref_epoch")
    return table


def test_usual_names_and_an_epoch_from_the_configuration(tmp_path):
    config = write(tmp_path / "in", -1, change=vizier)
    refused(tmp_path, "check", config, words=["no epoch", "campaign.catalogue_epoch"])
    config = write(tmp_path / "given", -1, change=vizier, catalogue_epoch=CATALOGUE)
    run = staged(config, "match")
    pulls = pulls_of_pairs(run, -1)
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 * len(DATES) / pulls.size))


def without_motions(which):
    """Change of a catalogue in which the motions and parallaxes of some stars are missing."""

    def change(table):
        for name in ("pmra", "pmdec", "pmra_error", "pmdec_error", "parallax", "parallax_error"):
            table[name] = np.ma.masked_array(table[name], which(np.arange(len(table))))
        table["parallax"][40:50] = np.ma.masked  # a parallax that is not known is none
        return table

    return change


def test_stars_without_a_motion_have_that_of_the_others_with_its_error(tmp_path):
    """A third of them, at dates of up to seven years from the catalogue."""
    config = write(tmp_path / "in", -1, change=without_motions(lambda row: row % 3 == 0))
    text = good("check", config).out
    assert "900 of 900 stars" in text and "300 of 900 rows have no motion" in text
    run = staged(config, "match")
    pairs, pulls = read_matches(run / "pairs", unit="arcsec"), pulls_of_pairs(run, -1)
    assumed = pairs.star % 3 == 0
    assert assumed.sum() > 0.28 * len(pairs)
    assert np.median(pairs.sigma_u[assumed]) > 3 * np.median(pairs.sigma_u[~assumed])
    # a star has one motion in all exposures: some 300 independent errors on each axis
    assert np.sqrt(np.mean(pulls[:, assumed] ** 2)) == pytest.approx(1.0, abs=0.15)
    prior = write(tmp_path / "given", -1, change=without_motions(lambda row: row % 3 == 0),
                  motion_prior=40.0)  # fmt: skip
    wide = read_matches(staged(prior, "match") / "pairs", unit="arcsec")
    years = np.abs(wide.epoch - CATALOGUE)[wide.star % 3 == 0]
    np.testing.assert_allclose(wide.sigma_u[wide.star % 3 == 0], 0.040 * years, rtol=0.05)


@pytest.mark.parametrize("tenths", [3, 4.5, 7])
def test_stars_without_a_motion_leave_the_centroid_errors_as_they_are(tmp_path, tenths):
    """Errors by magnitude are those of the centroids; all stars together agree with their errors.

    The errors of the catalogue are 0.3 mas with a motion, and tens of mas without one.
    """
    change = without_motions(lambda row: row % 20 < 2 * tenths)
    run = staged(write(tmp_path / "in", -1, change=change), "match", "fit")
    with Run.of(RunDirectory.open(run)) as opened:
        errors, pairs = opened.errors, opened.matches
    law = errors.by_magnitude
    true = CENTROID * PIXEL
    # 400 residuals or more on each axis: 3 per cent for one law, more for each bin
    for sigma in law.at(pairs.mag):
        assert np.sqrt(np.mean(sigma**2)) == pytest.approx(true, rel=0.1)
        assert np.abs(sigma / true - 1).max() < 0.2
    pulls = residuals(load_fit(run / "fit.nc"), pairs) / np.stack([pairs.sigma_u, pairs.sigma_v], 1)
    for group in (pairs.star % 20 < 2 * tenths, pairs.star % 20 >= 2 * tenths):
        pull = pulls[group][np.hypot(*pulls[group].T) < 5]
        assert np.sqrt(np.mean(pull**2)) == pytest.approx(1.0, abs=0.15)


def test_stars_without_a_motion_are_left_out_and_counted_if_others_are_few(tmp_path):
    config = write(tmp_path / "in", -1, change=without_motions(lambda row: row >= 25))
    assert "875 stars are left out: no proper motion" in good("check", config).out


def on_a_plane(unit):
    """The catalogue as xi, eta by astropy's TAN, in a file without units."""

    def change(table):
        plane = WCS(naxis=2)
        plane.wcs.ctype, plane.wcs.crval = ["RA---TAN", "DEC--TAN"], FIELD
        plane.wcs.cdelt = [1 / 3600, 1 / 3600] if unit == "arcsec" else [1 / 3.6e6, 1 / 3.6e6]
        xi, eta = plane.all_world2pix(table["ra"], table["dec"], 1)
        per = 1e-3 if unit == "arcsec" else 1.0  # the errors are in mas
        out = Table({"xi": xi, "eta": eta, "ref_epoch": table["ref_epoch"]})
        for axis, name in (("u", "ra"), ("v", "dec")):
            out[f"s{axis}"] = per * np.asarray(table[f"{name}_error"])
            out[f"pm_{axis}"] = per * np.asarray(table[f"pm{name}"])
            out[f"sigma_pm_{axis}"] = per * np.asarray(table[f"pm{name}_error"])
        out["mag"] = table["phot_g_mean_mag"]
        return out

    return change


@pytest.mark.parametrize("unit", [case_in_full("arcsec", instead="mas are run"), "mas"])
def test_a_catalogue_without_units_gets_its_unit_from_the_configuration(tmp_path, unit):
    """The message names the key, and so does the one that says that axes are mirrored."""
    config = write(tmp_path / "bare", -1, change=on_a_plane(unit))
    refused(tmp_path, "check", config, words=["has no unit", "campaign.unit"])
    config = write(tmp_path / "in", -1, change=on_a_plane(unit), unit=unit)
    assert f"900 of 900 stars, in {unit}" in good("check", config).out
    unmatched(config, "its mirror image does match", "campaign.parity = 'mirrored'")
    config = write(tmp_path / "all", -1, change=on_a_plane(unit), unit=unit, parity="mirrored")
    found = summary_of(staged(config, "match"))["matching"]
    assert found["parity"] == "mirrored" and found["completeness"]["median"] > 0.95


def test_columns_of_catalogue_and_lists_have_keys_of_their_own(tmp_path):
    def change(table):
        table.rename_column("ra", "lon")
        return table

    config = write(tmp_path / "in", -1, change=change)
    refused(tmp_path, "check", config, words=["no columns", "campaign.catalog_columns"])
    config = write(
        tmp_path / "named",
        -1,
        change=change,
        catalog_columns={"ra": "lon", "parallax": "", "sigma_ra": "ra_error"},
        columns={"q": "", "mag": "mag"},
    )
    assert "tangent plane" in good("check", config).out
