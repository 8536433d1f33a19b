"""Inputs that a new user gets wrong: `check` names the cause of each of them."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table
from astropy.wcs import WCS

from .support import cli, write_job

SIZE = (1000, 800)


def camera() -> WCS:
    """Camera with square pixels of 150 mas, north up and east to the left."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], [202.5, 47.2]
    wcs.wcs.crpix, wcs.wcs.cd = [500.5, 400.5], [[-0.15 / 3600, 0], [0, 0.15 / 3600]]
    return wcs


def sound() -> Table:
    """200 stars with centroid errors of 0.05 pixels."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(1, 1000, 200), rng.uniform(1, 800, 200)
    ra, dec = camera().all_pix2world(x, y, 1)
    dx, dy = rng.normal(0, 0.05, (2, 200))
    return Table({"x": np.clip(x + dx, 0.5, 1000.5), "y": y + dy, "ra": ra, "dec": dec})


@pytest.mark.parametrize("frames", ["none", "shift", "affine"])
@pytest.mark.parametrize(
    "plane",
    [lambda u: (0 * u, 0 * u), lambda u: (u, u), lambda u: (u, -2 * u), lambda u: (0 * u, u)],
)
def test_positions_in_one_point_or_on_a_line(tmp_path, frames, plane):
    rng = np.random.default_rng(2)
    x, y = rng.uniform(1, 1000, 200), rng.uniform(1, 800, 200)
    u, v = plane(x + 0.3 * y)
    exposure = np.array(["a", "b"])[np.arange(200) % 2]
    table = Table({"x": x, "y": y, "u": u, "v": v, "exposure": exposure})
    data = {"matches": "stars.ecsv", "unit": "pix", "sigma": 0.05}
    model = {"order": 2, "reference_pixel": (500.5, 400.5), "frames": frames}
    result = cli("check", write_job(tmp_path, table, data=data, model=model))
    assert result.code == 1 and "of chip 1 lie on a line or in one point" in result.err, result.err


def change(**columns):
    """Function that replaces columns of a table by functions of the table."""

    def changed(table: Table) -> None:
        values = {name: function(table) for name, function in columns.items()}
        for name, value in values.items():
            table[name] = value

    return changed


def detected_twice(table: Table) -> None:
    for k in range(5):
        table.add_row(table[k])
        table["x"][-1] = (table["x"][k] + 300) % 1000


def shuffled(table: Table) -> None:
    rows = np.random.default_rng(3).permutation(len(table))
    table["ra"], table["dec"] = table["ra"][rows], table["dec"][rows]


def copied(table: Table) -> None:
    table["ra"], table["dec"] = camera().all_pix2world(table["x"], table["y"], 1)


def with_nan(table: Table) -> None:
    table["x"][3] = np.nan


def seconds_of_time(table: Table) -> list[str]:
    return [f"13:30:{value % 60:.3f}h?" for value in range(len(table))]


NOTHING = change()
CHIPS = [
    {"number": n, "name": f"CCD{n}", "size": SIZE, "reference_pixel": (500.5, 400.5)}
    for n in (1, 2)
]
CASES = [
    ("hours", change(ra=lambda t: t["ra"] / 15), {}, "right ascensions in hours"),
    (
        "radians",
        change(ra=lambda t: np.radians(t["ra"]), dec=lambda t: np.radians(t["dec"])),
        {},
        "both are in radians",
    ),
    ("pixels swapped", change(x=lambda t: t["y"], y=lambda t: t["x"]), {}, "are swapped"),
    (
        "sky swapped",
        change(ra=lambda t: t["dec"], dec=lambda t: t["ra"]),
        {},
        "declination is 202",
    ),
    ("mirrored", change(x=lambda t: 1001 - t["x"]), {}, "counted from the wrong side"),
    ("sign of declination", change(dec=lambda t: -t["dec"]), {}, "shows the sky mirrored"),
    ("turns", change(ra=lambda t: t["ra"] + 1e204), {}, "right ascension is 1e+204 degrees"),
    ("pole", change(dec=lambda t: t["dec"] + 50), {}, "declination is 97.2"),
    ("wrong pairs", shuffled, {}, "another field, wrong pairs"),
    ("from the pixels", copied, {}, "computed from the pixels by a WCS"),
    ("one NaN", with_nan, {}, 'leave out 1 of 200 with data.not_finite = "reject"'),
    ("all NaN", change(x=lambda t: t["x"] * np.nan), {}, "no value in column 'x' (200 rows)"),
    ("sexagesimal with letters", change(ra=seconds_of_time), {}, "column 'ra'"),
    ("units in cells", change(x=lambda t: [f"{v:.2f}px" for v in t["x"]]), {}, "is not a number"),
    ("repeated rows", lambda t: t.add_row(t[0]), {}, "keep each row once"),
    ("two detections", detected_twice, {}, "several detections in one exposure"),
    ("binned", change(x=lambda t: t["x"] / 2, y=lambda t: t["y"] / 2), {}, "span 2"),
    ("arcsec as pixels", change(x=lambda t: t["x"] * 15), {}, "outside the 1000 x 800"),
    ("one column", change(x=lambda t: 0 * t["x"] + 500), {}, "all stars lie on a line"),
    ("quadrant", lambda t: t.remove_rows(t["x"] > 300), {}, "the polynomial is extrapolated"),
    ("no column", lambda t: t.remove_column("x"), {}, "no column for 'x'"),
    ("few stars", lambda t: t.remove_rows(slice(5, None)), {}, "fewer than the 12 parameters"),
    ("no stars", lambda t: t.remove_rows(slice(0, None)), {}, "holds no rows"),
    (
        "errors of zero",
        change(sigma_u=lambda _: 0.0, sigma_v=lambda _: 0.0),
        {},
        "sigma is 0 in all rows",
    ),
    ("negative errors", change(sigma_u=lambda _: -1.0, sigma_v=lambda _: 1.0), {}, "sigma is -1"),
    (
        "errors in mas",
        change(sigma_u=lambda _: 7.5, sigma_v=lambda _: 7.5),
        {},
        "quoted errors are too large",
    ),
    ("dates in MJD", change(epoch=lambda _: 58000.0), {}, "MJD with the unit 'd'"),
    ("wrong century", change(epoch=lambda _: 1921.0), {}, "check that they are decimal years"),
    (
        "wrong scale",
        NOTHING,
        {"detector": {"size": SIZE, "scale_mas": 400.0}},
        "that of the fit is 150",
    ),
    ("wrong size", NOTHING, {"detector": {"size": (4000, 4000)}}, "span 5 % of the detector"),
    ("small size", NOTHING, {"detector": {"size": (500, 400)}}, "outside the 500 x 400"),
    ("wrong unit", NOTHING, {"data": {"unit": "pix"}}, "set the unit to arcsec"),
    (
        "a chip is missing",
        change(chip=lambda _: 1),
        {"chip": CHIPS, "detector": None, "model": {"order": 2}},
        "CCD2",
    ),
]


@pytest.mark.parametrize(("name", "spoil", "sections", "words"), CASES, ids=[c[0] for c in CASES])
def test_check_names_the_cause(tmp_path, name, spoil, sections, words):
    table = sound()
    spoil(table)
    data = {"matches": "stars.ecsv"} | ({} if "sigma_u" in table.colnames else {"sigma": 0.0075})
    known = {
        "detector": {"size": SIZE},
        "budget": None,
    }
    known |= {key: value for key, value in sections.items() if key != "data"}
    path = write_job(tmp_path, table, data=data | sections.get("data", {}), **known)
    done = cli("check", path)
    said = " ".join((done.out + done.err).split())
    assert words in said
    assert done.code == (0 if "WARNING" in said or "geometry" in said else 1)


def test_check_has_nothing_to_say_of_sound_stars(tmp_path):
    path = write_job(
        tmp_path,
        sound(),
        data={"matches": "stars.ecsv", "sigma": 0.0075},
        detector={"size": SIZE},
    )
    done = cli("check", path)
    assert done.code == 0
    said = [line for line in done.out.splitlines() if line.startswith("WARNING")]
    assert [line for line in said if "reference catalogue" not in line] == []
