"""Sky positions that are compared with an earlier calibration are on its tangent plane."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table

import bayesdist as bd
from bayesdist.data.formats import write_matches
from bayesdist.errors import InputError
from tests.app.support import good, refused, write_config, write_job

SIZE, CENTRE, SCALE = (1000, 800), (500.5, 400.5), 0.2  # pixels, pixels, arcsec per pixel
POINTING = SkyCoord(150.0, 60.0, unit="deg")
SIGMA = 0.004  # arcsec, 0.02 pixels
N = 600
READING = {"sigma": SIGMA, "same_position": "one_star"}
DATA = {"matches": "stars.ecsv", "sigma": SIGMA}


def stars(seed: int, bend: float = 0.0, pointing: SkyCoord = POINTING) -> Table:
    """Stars of one camera, more of them at low x or, for odd seeds, at high x."""
    rng = np.random.default_rng(seed)
    # the mean direction is far from the centre
    x = 1.0 + 998.0 * rng.beta(1.0 + seed % 2, 2.0 - seed % 2, N)
    y = rng.uniform(1.0, 799.0, N)
    sky = sky_of(x, y, rng.normal(0.0, SIGMA, (2, N)), bend, pointing)
    return Table({"x": x, "y": y, "ra": sky.ra.deg, "dec": sky.dec.deg})


def sky_of(x, y, error=0.0, bend: float = 0.0, pointing: SkyCoord = POINTING) -> SkyCoord:
    """Sky positions by astropy's rotation; `error` is in arcsec, and `bend` pixels of x^2 in u."""
    X, Y = (x - CENTRE[0]) / 500.0, (y - CENTRE[1]) / 400.0
    u = x - CENTRE[0] + 1.5 * X**2 - 0.7 * X * Y + bend * X**2
    v = y - CENTRE[1] + 0.9 * Y**2 - 1.1 * X**2
    u, v = SCALE * np.array([u, v]) + error
    # the gnomonic projection in the frame whose origin is the pointing
    xi, eta = np.radians(-u / 3600.0), np.radians(v / 3600.0)
    offset = SkyCoord(
        np.arctan(xi), np.arctan(eta * np.cos(np.arctan(xi))), unit="rad",
        frame=pointing.skyoffset_frame(),
    )  # fmt: skip
    return offset.transform_to("icrs")


def detector(**sections):
    detector = {"name": "A", "size": SIZE, "scale_mas": 1000.0 * SCALE}
    return {"detector": detector, "data": DATA} | sections


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """Run of stars at one side of the detector, with the default tangent point."""
    folder = tmp_path_factory.mktemp("release")
    config = write_job(folder / "input", stars(1), **detector())
    good("run", config, "-o", folder / "run")
    return folder / "run"


def monitored(release, table, folder, **data):
    """monitor.json of a table that is read by default or by a section [data]."""
    table.write(folder / "new.ecsv")
    new = folder / "new.ecsv"
    if data:
        data = DATA | {"matches": "new.ecsv"} | data
        new = write_config(folder / "new.toml", **detector(data=data))
    result = good("monitor", release, new, "-o", folder / "out")
    return result, json.loads((folder / "out" / "monitor.json").read_text())


def point_of(release) -> list[float]:
    return json.loads((release / "summary.json").read_text())["data"]["tangent_point"]


def test_other_stars_of_the_same_field_show_no_change(release, tmp_path) -> None:
    new = stars(2)
    result, found = monitored(release, new, tmp_path)
    own = Table.read(tmp_path / "new.ecsv")
    default = np.array([own["ra"].mean(), own["dec"].mean()])
    apart = SkyCoord(*default, unit="deg").separation(SkyCoord(*point_of(release), unit="deg"))
    assert apart.arcsec > 20.0  # 100 pixels: the mean directions would be no common origin
    assert found["new"]["tangent_point"] == point_of(release)
    assert "tangent point" not in result.out
    assert found["changed"] is False and found["p_value"] > 0.01
    assert found["size"]["max"] < 4 * found["size"]["sigma_of_max"]


def test_a_change_of_the_distortion_is_found(release, tmp_path) -> None:
    _, found = monitored(release, stars(4, bend=0.06), tmp_path)
    size = found["size"]
    assert found["changed"] is True and found["p_value"] < 1e-6
    assert size["max"] == pytest.approx(0.06, abs=4 * size["sigma_of_max"])


def test_the_stated_point_may_be_that_of_the_release(release, tmp_path) -> None:
    _, found = monitored(release, stars(2), tmp_path, tangent_point=point_of(release))
    assert found["changed"] is False


def test_another_stated_point_is_refused(release, tmp_path) -> None:
    stars(2).write(tmp_path / "new.ecsv")
    data = DATA | {"matches": "new.ecsv", "tangent_point": [150.01, 60.0]}
    config = write_config(tmp_path / "new.toml", **detector(data=data))
    words = ["[150.01, 60.0]", str(point_of(release)), "tangent point"]
    refused(tmp_path, "monitor", release, config, words=words)


def test_a_point_that_a_file_states_is_refused_if_it_is_another(release, tmp_path) -> None:
    matches = bd.Matches.from_table(stars(2), **READING)
    write_matches(tmp_path / "new.h5", matches)
    words = [str(list(matches.tangent_point)), str(point_of(release))]
    refused(tmp_path, "monitor", release, tmp_path / "new.h5", words=words)


def test_a_point_that_a_file_states_may_be_that_of_the_release(release, tmp_path) -> None:
    point = tuple(point_of(release))
    matches = bd.Matches.from_table(stars(2), tangent_point=point, **READING)
    write_matches(tmp_path / "new.h5", matches)
    assert "still describes" in good("monitor", release, tmp_path / "new.h5").out


def test_positions_without_a_point_are_said_to_be_those_of_the_plane(release, tmp_path) -> None:
    point = tuple(point_of(release))
    matches = bd.Matches.from_table(stars(2), tangent_point=point, **READING)
    table = Table({name: matches.column(name) for name in ("x", "y", "u", "v")})
    table["u"].unit = table["v"].unit = "arcsec"
    result, found = monitored(release, table, tmp_path)
    assert "u and v of the new matches state no tangent point" in result.out
    assert found["new"]["tangent_point"] is None and found["changed"] is False


def test_another_field_is_refused_in_one_frame(release, tmp_path) -> None:
    stars(2, pointing=SkyCoord(160.0, 60.0, unit="deg")).write(tmp_path / "new.ecsv")
    words = ["degrees from those of", "model.frames"]
    refused(tmp_path, "monitor", release, tmp_path / "new.ecsv", words=words)


def test_another_field_has_another_plane_if_exposures_have_frames(tmp_path) -> None:
    config = write_job(
        tmp_path / "input",
        exposures(stars(1)),
        **detector(model={"order": 2, "frames": "shift_rotation"}),
    )
    good("run", config, "-o", tmp_path / "run")
    new = exposures(stars(2, pointing=SkyCoord(190.0, 60.0, unit="deg")))
    result, found = monitored(tmp_path / "run", new, tmp_path)
    assert found["changed"] is False and found["p_value"] > 0.01
    assert "the tangent point of the new matches is [1" in result.out
    near, found = monitored(tmp_path / "run", exposures(stars(4)), folder(tmp_path / "near"))
    assert found["changed"] is False and "tangent point" not in near.out


def exposures(table: Table) -> Table:
    table["exposure"] = np.arange(len(table)) % 3
    return table


def folder(path):
    path.mkdir()
    return path


def test_a_release_without_a_point_needs_one(release, tmp_path) -> None:
    point = tuple(point_of(release))
    matches = bd.Matches.from_table(stars(1), tangent_point=point, **READING)
    table = Table({name: matches.column(name) for name in ("x", "y", "u", "v")})
    table["u"].unit = table["v"].unit = "arcsec"
    config = write_job(tmp_path / "input", table, **detector())
    run = tmp_path / "run"
    good("run", config, "-o", run)
    stars(2).write(tmp_path / "sky.ecsv")
    words = ["state no tangent point", "data.tangent_point"]
    refused(tmp_path, "monitor", run, tmp_path / "sky.ecsv", words=words)
    result, found = monitored(run, stars(2), tmp_path, tangent_point=list(point))
    assert "u and v of the release state no tangent point" in result.out
    assert found["changed"] is False


def test_a_prior_calibration_gives_the_plane(release, tmp_path) -> None:
    prior = {"source": str(release)}
    config = write_job(tmp_path / "input", stars(2), **detector(prior_calibration=prior))
    good("run", config, "-o", tmp_path / "run")
    assert point_of(tmp_path / "run") == point_of(release)
    x, y = (axis.ravel() for axis in np.meshgrid([1.0, *CENTRE[:1], 1000.0], [1.0, 800.0]))
    truth = sky_of(x, y)
    with bd.open_run(tmp_path / "run") as run:
        sky = run.to_sky(Table({"x": x, "y": y}))
    apart = SkyCoord(sky["ra"], sky["dec"]).separation(truth).arcsec / SCALE
    assert apart.max() < 0.02  # pixels: 1200 stars with errors of 0.02, and 6 terms


def test_stars_on_another_plane_than_the_prior_are_refused(release) -> None:
    matches = bd.Matches.from_table(stars(2), **READING)
    with pytest.raises(InputError, match=r"tangent_point\"\] = \[1"):
        bd.calibrate(
            matches,
            order=2,
            size=SIZE,
            sigma="columns",
            settings={"prior_calibration": {"source": str(release)}},
        )


def test_compare_says_that_tangent_points_differ(release, tmp_path) -> None:
    """The shift that is taken out is that between the tangent points, for pixels along the axes."""
    config = write_job(tmp_path / "input", stars(2), **detector())
    good("run", config, "-o", tmp_path / "run")
    points = [SkyCoord(*point_of(run), unit="deg") for run in (release, tmp_path / "run")]
    apart = points[0].separation(points[1]).arcsec
    said = good("compare", release, tmp_path / "run").out
    assert said.startswith("No significant difference")
    assert f"the tangent points of A and B are {apart:.4g} arcsec apart" in said
    shift = [float(x) for x in re.findall(r"shift in [xy]\s+([-+.\d]+)", said)]
    # the planes are also rotated, so that the shift depends on its point between both
    turn = np.radians(points[1].ra.deg - points[0].ra.deg) * np.sin(points[0].dec.rad)
    bound = abs(turn) * apart + 0.01 * SCALE
    assert np.hypot(*shift) * SCALE == pytest.approx(apart, abs=bound)
    rotation = float(re.findall(r"rotation\s+([-+.\d]+)", said)[0])
    assert abs(rotation) == pytest.approx(abs(np.degrees(turn)), abs=0.002)
    assert "tangent points" not in good("compare", release, release).out
