"""Two tables and a match radius: pairs against the truth of simulated fields, and astropy's own."""

from __future__ import annotations

import re

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord, match_coordinates_sky
from astropy.table import QTable, Table
from astropy.time import Time
from astropy.wcs import WCS

from bayesdist.data import Matches, catalog_from_table, match
from bayesdist.errors import InputError

SIZE = 2048
SCALE = 0.2  # arcsec
CENTRE = (150.0, 40.0)
RADIUS = 1.0 * u.arcsec


def tan_wcs(crval=CENTRE, shift=(0.0, 0.0), roll=0.0, scale=SCALE, order=("RA---TAN", "DEC--TAN")):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = order, crval if order[0][0] == "R" else crval[::-1]
    wcs.wcs.crpix = np.array([SIZE / 2 + 0.5, SIZE / 2 + 0.5]) + shift
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    matrix = scale / 3600 * np.array([[-c, s], [s, c]])
    wcs.wcs.cd = matrix if order[0][0] == "R" else matrix[::-1]
    wcs.wcs.set()
    return wcs


ROUGH = {"shift": (3.0, -4.0), "roll": 0.3}  # 5 pixels and 0.3 degrees off


def field(n=700, background=400, missing=0.2, noise=0.05, seed=1, bend=0.0):
    """Detections, catalogue, and the catalogue row of each detection (-1 without counterpart)."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(1, SIZE, (2, n))
    sky = tan_wcs().pixel_to_world(x - 1, y - 1)
    mag = rng.uniform(15, 21, n)
    listed = rng.uniform(size=n) > missing
    lon, lat = rng.uniform(-1, 1, (2, background)) * SIZE * SCALE / 3600 / 2
    ra = np.concatenate([sky.ra.deg[listed], CENTRE[0] + lon / np.cos(np.radians(CENTRE[1]))])
    dec = np.concatenate([sky.dec.deg[listed], CENTRE[1] + lat])
    catalogue = QTable(
        {
            "ra": ra * u.deg,
            "dec": dec * u.deg,
            "phot_g_mean_mag": np.concatenate([mag[listed], rng.uniform(15, 21, background)]),
            "ra_error": np.full(len(ra), 0.2) * u.mas,
            "dec_error": np.full(len(ra), 0.3) * u.mas,
        }
    )
    t = (x - SIZE / 2) / (SIZE / 2), (y - SIZE / 2) / (SIZE / 2)
    seen = {
        "x": x + rng.normal(0, noise, n) + bend * t[0] ** 3,
        "y": y + rng.normal(0, noise, n) + bend * t[0] * t[1] ** 2,
        "mag": mag - 25.0,
        "exposure": np.full(n, "j8xi0x"),
    }
    truth = np.full(n, -1)
    truth[listed] = np.arange(listed.sum())
    return seen, catalogue, truth


def counted(matches, truth):
    """Recovered pairs, and false ones."""
    right = truth[matches.row] == matches.star
    return int(right.sum()), int((~right).sum())


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_rough_wcs_recovers_the_pairs_that_the_true_one_gives(seed):
    seen, catalogue, truth = field(seed=seed)
    matches = match(seen, catalogue, radius=RADIUS, wcs=tan_wcs(**ROUGH))
    recovered, false = counted(matches, truth)
    # judge: astropy's nearest neighbours by the true WCS, and within the radius
    sky = tan_wcs().pixel_to_world(seen["x"] - 1, seen["y"] - 1)
    star, away, _ = match_coordinates_sky(sky, SkyCoord(catalogue["ra"], catalogue["dec"]))
    judged = int((truth[(near := away < RADIUS)] == star[near]).sum())
    assert recovered >= judged - 1 and recovered > 0.98 * (truth >= 0).sum()
    # free catalogue stars within the radius of a detection without counterpart
    area = (SIZE * SCALE) ** 2
    expected = (truth < 0).sum() * 400 / area * np.pi
    assert false <= expected + 5 * np.sqrt(expected + 1)
    assert len(np.unique(matches.star)) == len(matches) == len(np.unique(matches.row))
    assert matches.match_radius == 1.0
    assert np.hypot(matches.u - matches.u_nominal, matches.v - matches.v_nominal).max() <= 1.0
    assert matches.rejected == {"no counterpart in the catalogue": len(truth) - len(matches)}
    assert matches.n_rows == len(truth)
    # what the rough WCS lacks is said
    assert f"{len(matches)} of 700 were matched" in matches.notes[0]
    said = re.search(r"refined by (.*) arcsec, (.*) degrees and a scale of (.*)$", matches.notes[0])
    shift, turn, scale = map(float, said.groups())
    assert abs(turn) == pytest.approx(0.3, abs=0.002) and scale == pytest.approx(1.0, abs=5e-5)
    assert shift == pytest.approx(5 * SCALE, abs=0.1)


def test_without_the_refinement_half_of_the_pairs_are_lost():
    seen, catalogue, truth = field()
    sky = tan_wcs(**ROUGH).pixel_to_world(seen["x"] - 1, seen["y"] - 1)
    star, away, _ = match_coordinates_sky(sky, SkyCoord(catalogue["ra"], catalogue["dec"]))
    near = away < RADIUS
    assert (truth[near] == star[near]).sum() < 0.5 * (truth >= 0).sum()
    assert counted(match(seen, catalogue, radius=RADIUS, wcs=tan_wcs(**ROUGH)), truth)[0] > 500


def test_the_matches_are_those_of_a_table():
    seen, catalogue, truth = field(noise=0.01)
    matches = match(seen, catalogue, radius=RADIUS, wcs=tan_wcs(**ROUGH), tangent_point=CENTRE)
    joined = QTable(
        {
            "x": seen["x"][matches.row],
            "y": seen["y"][matches.row],
            "ra": catalogue["ra"][matches.star],
            "dec": catalogue["dec"][matches.star],
            "ra_error": catalogue["ra_error"][matches.star],
            "dec_error": catalogue["dec_error"][matches.star],
        }
    )
    table = Matches.from_table(
        joined,
        tangent_point=CENTRE,
        columns={"sigma_ra": "ra_error", "sigma_dec": "dec_error"},
    )
    for name in ("x", "y", "u", "v", "sigma_u", "sigma_v"):
        np.testing.assert_array_equal(getattr(matches, name), getattr(table, name), name)
    np.testing.assert_array_equal(matches.mag, seen["mag"][matches.row])
    assert matches.exposure_names == ("j8xi0x",)
    # the true WCS brings x, y to u, v
    scale = np.column_stack([-(matches.x - 1024.5), matches.y - 1024.5]) * SCALE
    right = truth[matches.row] == matches.star
    off = np.hypot(*(scale - np.column_stack([matches.u, matches.v])).T)[right]
    assert np.median(off) < 0.01 * SCALE * 2


def with_ellipses(seen, catalogue, seed=3):
    """Detections with SExtractor's errors, and a catalogue with motions and correlated errors."""
    rng = np.random.default_rng(seed)
    n, m = len(seen["x"]), len(catalogue)
    for name, low in (("ERRX2WIN_IMAGE", 1e-4), ("ERRY2WIN_IMAGE", 4e-4)):
        seen[name] = low * rng.uniform(1, 2, n)
    product = seen["ERRX2WIN_IMAGE"] * seen["ERRY2WIN_IMAGE"]
    seen["ERRXYWIN_IMAGE"] = rng.uniform(-0.8, 0.8, n) * np.sqrt(product)
    catalogue["parallax"], catalogue["parallax_error"] = [1.0, 0.2] * u.mas
    catalogue["pmra"], catalogue["pmdec"] = rng.normal(0, 5, (2, m)) * u.mas / u.yr
    for name in ("pmra_error", "pmdec_error"):
        catalogue[name] = rng.uniform(0.1, 0.3, m) * u.mas / u.yr
    catalogue["ref_epoch"] = 2016.0
    names = ("ra", "dec", "parallax", "pmra", "pmdec")
    root = rng.standard_normal((m, 5, 5))
    C = root @ np.swapaxes(root, 1, 2)
    size = np.sqrt(np.einsum("nii->ni", C))
    for j in range(5):
        for i in range(j):
            catalogue[f"{names[i]}_{names[j]}_corr"] = C[:, i, j] / (size[:, i] * size[:, j])
    return seen, catalogue


@pytest.mark.parametrize("centre", [CENTRE, (150.0, 70.0)])
def test_a_reference_catalogue_gives_the_covariances_of_its_table(centre):
    """Also about another tangent point, close to the pole, where the axes are turned."""
    seen, catalogue, _ = field(n=400)
    seen, catalogue = with_ellipses(seen, catalogue)
    away = (catalogue["ra"].value - CENTRE[0]) * np.cos(np.radians(CENTRE[1]))
    catalogue["ra"] = (centre[0] + away / np.cos(np.radians(centre[1]))) * u.deg
    catalogue["dec"] = catalogue["dec"] + (centre[1] - CENTRE[1]) * u.deg
    options = {"radius": RADIUS, "wcs": tan_wcs(centre), "epoch": 2024.6, "tangent_point": centre}
    of_table = match(seen, catalogue, **options)
    reference = catalog_from_table(catalogue, tangent_point=(centre[0] + 1.5, centre[1] - 0.5))
    of_reference = match(seen, reference, **options)
    assert len(of_table) > 250
    np.testing.assert_array_equal(of_reference.star, of_table.star)
    C = of_table.covariances()
    np.testing.assert_allclose(of_reference.covariances(), C, atol=1e-4 * np.abs(C).max())
    assert np.abs(of_table.rho_uv).max() > 0.5
    # what the centroids add: their covariance by the WCS, with x to the west
    bare = {name: v for name, v in seen.items() if not name.startswith("ERR")}
    alone = match(bare, catalogue, **options).covariances()
    rows = of_table.row
    xx, yy, xy = (seen[f"ERR{key}WIN_IMAGE"][rows] for key in ("X2", "Y2", "XY"))
    centroids = SCALE**2 * np.moveaxis(np.array([[xx, -xy], [-xy, yy]]), 2, 0)
    np.testing.assert_allclose(C - alone, centroids, atol=3e-3 * centroids.max())


def test_a_distortion_larger_than_the_radius_loses_no_corner():
    seen, catalogue, truth = field(n=2000, bend=12.0)  # 2.4 arcsec in the corners
    matches = match(seen, catalogue, radius=RADIUS, wcs=tan_wcs(**ROUGH))
    recovered, _ = counted(matches, truth)
    assert recovered > 0.97 * (truth >= 0).sum()


def test_all_forms_of_the_input_give_the_same_pairs(tmp_path):
    gwcs = pytest.importorskip("gwcs")
    seen, catalogue, _ = field()
    rough = tan_wcs(**ROUGH)
    pairs = match(seen, catalogue, radius=RADIUS, wcs=rough)
    sky = rough.pixel_to_world(seen["x"] - 1, seen["y"] - 1)

    def same(*arguments, **keywords):
        other = match(*arguments, radius=RADIUS, **keywords)
        np.testing.assert_array_equal(other.row, pairs.row)
        np.testing.assert_array_equal(other.star, pairs.star)
        return other

    same(seen, catalogue, wcs=tan_wcs(**ROUGH, order=("DEC--TAN", "RA---TAN")))
    same(Table(seen | {"ra": sky.ra, "dec": sky.dec}), catalogue)
    same(QTable(seen | {"position": sky}), catalogue)
    same(QTable(seen | {"position": sky.galactic}), catalogue)
    coordinates = SkyCoord(catalogue["ra"], catalogue["dec"])
    same(seen, coordinates, wcs=rough, sigma=0.01)
    same(seen, coordinates.fk5, wcs=rough, sigma=0.01)
    same(seen, catalog_from_table(catalogue), wcs=rough)
    zero = {"xcentroid": seen["x"] - 1, "ycentroid": seen["y"] - 1, "mag": seen["mag"]}
    counted_from_zero = same(zero, catalogue, wcs=rough)
    np.testing.assert_allclose(counted_from_zero.x, pairs.x, rtol=1e-14)
    same(seen, catalogue, wcs={"j8xi0x": rough})
    Table(seen).write(tmp_path / "seen.ecsv")
    catalogue.write(tmp_path / "catalogue.ecsv")
    same(tmp_path / "seen.ecsv", str(tmp_path / "catalogue.ecsv"), wcs=rough)
    from astropy.modeling.models import AffineTransformation2D, Pix2Sky_TAN, RotateNative2Celestial
    from gwcs import coordinate_frames as frames

    shift = -rough.wcs.cd @ (rough.wcs.crpix - 1)
    forward = (
        AffineTransformation2D(rough.wcs.cd, shift)
        | Pix2Sky_TAN()
        | RotateNative2Celestial(*CENTRE, 180.0)
    )
    from astropy.coordinates import ICRS

    output = frames.CelestialFrame(reference_frame=ICRS(), unit=(u.deg, u.deg))
    same(seen, catalogue, wcs=gwcs.WCS(forward, frames.Frame2D(unit=(u.pix, u.pix)), output))


def test_matched_positions_are_matched_anew_from_matches():
    seen, catalogue, truth = field()
    first = match(seen, catalogue, radius=RADIUS, wcs=tan_wcs(**ROUGH))
    again = match(first, catalogue, radius=0.3)
    (recovered, false), before = counted(again, truth[first.row]), counted(first, truth)
    assert recovered == before[0] and false <= before[1]


def moving_field(years=8.0):
    seen, catalogue, truth = field(noise=0.01)
    rng = np.random.default_rng(7)
    pm = rng.normal(0, 200, (2, len(catalogue))) * u.mas / u.yr
    catalogue["pmra"], catalogue["pmdec"] = pm
    catalogue["ref_epoch"] = np.full(len(catalogue), 2016.0)
    row = truth[truth >= 0]
    sky = SkyCoord(catalogue["ra"], catalogue["dec"])[row]
    later = sky.directional_offset_by(
        np.arctan2(pm[0, row], pm[1, row]), years * u.yr * np.hypot(*pm[:, row])
    )
    x, y = tan_wcs().world_to_pixel(later)
    seen["x"][truth >= 0], seen["y"][truth >= 0] = x + 1, y + 1
    return seen, catalogue, truth


def test_stars_are_matched_where_they_are_at_the_epoch():
    seen, catalogue, truth = moving_field()
    options = {"radius": 0.2 * u.arcsec, "wcs": tan_wcs(**ROUGH)}
    matches = match(seen, catalogue, **options, epoch=Time(2024.0, format="decimalyear"))
    recovered, false = counted(matches, truth)
    assert recovered > 0.98 * (truth >= 0).sum() and false < 10
    assert any("were moved to 2024.00 by proper motions" in note for note in matches.notes)
    dated = match(seen | {"epoch": np.full(len(truth), 2024.0)}, catalogue, **options)
    np.testing.assert_array_equal(dated.star, matches.star)
    np.testing.assert_allclose(dated.u, matches.u, atol=1e-9)
    # at the catalogue's epoch the same stars are elsewhere
    with pytest.raises(InputError, match="does not match the catalogue"):
        match(seen, catalogue, **options, epoch=1900.0)


def test_chips_and_exposures_have_a_wcs_of_their_own():
    first, catalogue, truth = field(seed=1)
    second, other, truth2 = field(seed=2)
    both = {name: np.concatenate([first[name], second[name]]) for name in ("x", "y", "mag")}
    chip = np.repeat([1, 2], 700)
    sky = SkyCoord(other["ra"], other["dec"]).directional_offset_by(90 * u.deg, 0.3 * u.deg)
    other["ra"], other["dec"] = sky.ra, sky.dec
    from astropy.table import vstack

    joint = vstack([catalogue, other])
    east = tan_wcs((CENTRE[0] + 0.3 / np.cos(np.radians(CENTRE[1])), CENTRE[1]), **ROUGH)
    wcs = {1: tan_wcs(**ROUGH), 2: east}
    matches = match(both | {"chip": chip}, joint, radius=RADIUS, wcs=wcs)
    truths = np.concatenate([truth, np.where(truth2 < 0, -1, truth2 + len(catalogue))])
    recovered, _ = counted(matches, truths)
    assert recovered > 0.98 * (truths >= 0).sum() and matches.chip_numbers == (1, 2)
    named = both | {"exposure": np.repeat(["a", "b"], 700)}
    by_exposure = match(named, joint, radius=RADIUS, wcs={"a": wcs[1], "b": wcs[2]})
    np.testing.assert_array_equal(by_exposure.star, matches.star)
    with pytest.raises(
        InputError, match="has 2 chips, but only one WCS is given; give wcs as a mapp"
    ):
        match(both | {"chip": chip}, joint, radius=RADIUS, wcs=wcs[1])
    with pytest.raises(InputError, match="wcs has no key for chip 2"):
        match(both | {"chip": chip}, joint, radius=RADIUS, wcs={1: wcs[1]})
    with pytest.raises(InputError, match="wcs has the keys x, which are neither exposures nor ch"):
        match(both, joint, radius=RADIUS, wcs={"x": wcs[1]})


def test_ambiguous_matches_are_counted():
    seen, catalogue, _ = field(background=0, missing=0.0)
    near = SkyCoord(catalogue["ra"], catalogue["dec"])[:30]
    near = near.directional_offset_by(30 * u.deg, 0.7 * u.arcsec)
    from astropy.table import vstack

    double = catalogue[:30]
    double["ra"], double["dec"] = near.ra, near.dec
    plain = match(seen, catalogue, radius=RADIUS, wcs=tan_wcs(**ROUGH))
    doubled = match(seen, vstack([catalogue, double]), radius=RADIUS, wcs=tan_wcs(**ROUGH))

    def ambiguous(matches):
        return int(matches.notes[0].split(" matches are ambiguous")[0].split()[-1])

    assert ambiguous(doubled) - ambiguous(plain) >= 28
    assert (doubled.star[np.isin(doubled.row, np.arange(30))] < len(catalogue)).all()


WRONG = {
    "no unit": ({"radius": 1 * u.dimensionless_unscaled}, "radius is given in no unit, which cann"),
    "wrong unit": ({"radius": 1 * u.pix}, "radius is given in pix, which cannot be converted to a"),
    "zero": ({"radius": 0.0}, "radius is 0.0; give a positive number of arcsec or an angle"),
    "negative": ({"radius": -1 * u.arcsec}, "radius is -1.0 arcsec; give a positive"),
    "no table": ({"detections": [1, 2]}, "detections: is a list, which is no table"),
    "no detections": ({"detections": {"x": [], "y": []}}, "detections: holds no rows; give a tab"),
    "empty": ({"catalogue": QTable({"ra": [], "dec": []})}, "catalogue: holds no rows; give a ta"),
    "no pixels": ({"detections": {"ra": [1.0], "dec": [2.0]}}, "detections: no column for 'x'"),
    "no sky": ({"catalogue": {"a": [1.0]}}, "catalogue: no column for 'ra' among a"),
    "no WCS": ({"wcs": None}, "has no columns of ra and dec, and no WCS is given; give wcs, for"),
    "header": ({"wcs": tan_wcs().to_header()}, "wcs: is a Header, which has no pixel_to_world; "),
    "axes": ({"wcs": WCS(naxis=3)}, "wcs: has 3 pixel axes; give its two celestial axes"),
    "linear": ({"wcs": WCS(naxis=2)}, "wcs: has no celestial axes; give a WCS that maps pixels"),
    "another field": (
        {"wcs": tan_wcs((153.0, 41.0))},
        r"0 catalogue stars lie in the field of the detections: the detections lie around RA "
        r"15[23]\.\d+, Dec \+4[01]\.\d+ by the rough WCS and the catalogue around RA 1.*, Dec "
        r".*, 2\.\d+ degrees away; give the WCS of this image, or a catalogue of its field\.",
    ),
    "another scale": ({"wcs": tan_wcs(scale=0.3)}, "does not match the catalogue: .* scale and"),
    "mirrored": ({"detections": "mirrored"}, "does not match the catalogue: .* parity are right"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence(case):
    change, says = WRONG[case]
    seen, catalogue, _ = field()
    given = {"detections": seen, "catalogue": catalogue, "radius": RADIUS, "wcs": tan_wcs()}
    given |= change
    if case == "mirrored":
        given["detections"] = seen | {"x": SIZE + 1 - seen["x"]}
    with pytest.raises(InputError, match=says):
        match(given.pop("detections"), given.pop("catalogue"), **given)


def test_motions_need_both_epochs():
    seen, catalogue, _ = moving_field()
    options = {"radius": RADIUS, "wcs": tan_wcs(**ROUGH)}
    with pytest.raises(InputError, match="has proper motions, but the epoch of the detections is"):
        match(seen, catalogue, **options)
    still = {"pm_ra": "", "pm_dec": ""}
    assert len(match(seen, catalogue, **options, catalogue_columns=still)) > 0
    catalogue.remove_column("ref_epoch")
    with pytest.raises(InputError, match="has proper motions, but the epoch of its positions is"):
        match(seen, catalogue, **options, epoch=2024.0)
    assert len(match(seen, catalogue, **options, epoch=2024.0, catalogue_epoch=2016.0)) > 0


def test_errors_of_the_catalogue_alone_are_named():
    """Detections without errors of their own: the errors of the match are larger than stated."""
    seen, catalogue, _ = field()
    seen = {key: seen[key] for key in ("x", "y", "mag")}
    alone = match(seen, catalogue, radius=RADIUS, wcs=tan_wcs())
    assert any("catalogue alone" in note and "by_magnitude" in note for note in alone.notes)
    estimated = match(seen, catalogue, radius=RADIUS, wcs=tan_wcs(), sigma="by_magnitude")
    assert not estimated.has_sigma and not any("alone" in note for note in estimated.notes)
