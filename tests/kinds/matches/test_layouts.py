"""Tables as other programs write them go from `init` to `check` and `run` without an edit."""

from __future__ import annotations

import tomllib
import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

from bayesdist.data import read_matches, tangent_plane
from bayesdist.infer import load_posterior
from bayesdist.kinds.campaign.config import CampaignBlock
from tests.app.support import good, refused
from tests.kinds.matches.layouts import (
    LAYOUTS,
    POINT,
    SCALE,
    SIGMA,
    field_of,
    gaia_table,
    plane_of,
    sky_of,
)
from tests.reduced import case_in_full

BY_NAME = {layout.name: layout for layout in LAYOUTS}
RUN = (
    "detpos.fits",
    *(
        case_in_full(name, instead="one layout is run, and all are begun")
        for name in ("photutils.ecsv", "ascii_head.cat", "gaia.csv", "wise.txt")
    ),
)


def begun(name, folder):
    """The field, and the configuration that `init` has written for it."""
    layout, field = BY_NAME[name], field_of()
    layout.write(field, folder / name)
    config = folder / "my.toml"
    if layout.options:  # what has to be given is named, beside the candidates
        assert "incomplete draft" in good("init", config, "--matches", folder / name).out
        assert "--columns x=NAME,y=NAME" in config.read_text()
        assert "col_px (" in config.read_text() and "row_px (" in config.read_text()
    good("init", config, "--matches", folder / name, "--force", *layout.options)
    return layout, field, config


@pytest.mark.parametrize("name", BY_NAME)
def test_a_layout_goes_from_init_to_check(tmp_path, name):
    layout, field, config = begun(name, tmp_path)
    data = tomllib.loads(config.read_text())["data"]
    without_errors = {k: v for k, v in layout.taken.items() if not k.startswith("sigma_")}
    taken = layout.taken if data["sigma"] == "columns" else without_errors
    assert taken.items() <= data["columns"].items()
    assert data["pixel_origin"] == layout.origin
    chips = [chip["name"] for chip in tomllib.loads(config.read_text()).get("chip", [])]
    assert chips == list(layout.chips)
    lines = good("check", config).out.splitlines()
    assert any(line.startswith("rank") for line in lines)
    # what is read is what was written: detector positions from 1, sky positions on the plane
    m = read_matches(
        tmp_path / name,
        columns={k: v for k, v in data["columns"].items() if not k.startswith("sigma_")},
        sigma=1.0,
        unit=data.get("unit"),
        pixel_origin=data["pixel_origin"],
    )
    if m.tangent_point is None:
        u, v = field.xi, field.eta
    else:
        dec = field.dec + (0.2 * (np.arange(len(field.x)) % 2) if layout.chips else 0.0)
        u, v = tangent_plane(field.ra, dec, m.tangent_point)
    precision = 5e-4 if name == "allstar.als" else 1e-6
    np.testing.assert_allclose(m.x, field.x[m.row], atol=precision)
    np.testing.assert_allclose(m.y, field.y[m.row], atol=precision)
    np.testing.assert_allclose(m.u, np.asarray(u)[m.row], atol=2e-4)  # arcsec; texts have 1e-8 deg
    np.testing.assert_allclose(m.v, np.asarray(v)[m.row], atol=2e-4)


@pytest.mark.slow
@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("name", RUN)
def test_a_layout_runs(tmp_path, name):
    """Calibrated positions agree with the truth that no file holds."""
    _, _, config = begun(name, tmp_path)
    good("run", config, "-o", tmp_path / "run")
    posterior = load_posterior(tmp_path / "run")
    if len(posterior.model.chips) > 1:
        return
    point = read_matches(
        tmp_path / name, sigma=1.0, pixel_origin=BY_NAME[name].origin
    ).tangent_point
    rng = np.random.default_rng(5)
    x, y = rng.uniform(100, 1900, 50), rng.uniform(100, 900, 50)
    true = np.array(tangent_plane(*sky_of(*plane_of(x, y)), point)).T
    draws = posterior.model.predict(posterior.flat[::10], x, y)
    pull = (draws.mean(axis=0) - true) / draws.std(axis=0)
    assert np.abs(pull).max() < 5 and 0.3 < pull.std() < 2.2
    assert np.abs(draws.mean(axis=0) - true).max() < SIGMA * SCALE


def test_init_names_integer_columns_that_may_be_chips(tmp_path):
    field = field_of()
    table = Table({"x": field.x, "y": field.y, "ra": field.ra, "dec": field.dec, "mag": field.mag,
                   "amplifier": np.arange(len(field.x)) % 4, "flags": np.zeros(len(field.x), int),
                   "number": np.arange(len(field.x))})  # fmt: skip
    table.write(tmp_path / "s.csv")
    good("init", tmp_path / "a.toml", "--matches", tmp_path / "s.csv")
    text = (tmp_path / "a.toml").read_text()
    assert 'column amplifier has 4 values; if these are chips, add chip = "amplifier"' in text
    assert "column flags" not in text and "column number" not in text
    good("init", tmp_path / "b.toml", "--matches", tmp_path / "s.csv", "--columns",
         "chip=amplifier,mag=", "--size", 2048, 1024)  # fmt: skip
    config = tomllib.loads((tmp_path / "b.toml").read_text())
    assert config["data"]["columns"]["chip"] == "amplifier"
    assert config["data"]["columns"]["mag"] == ""
    assert [chip["number"] for chip in config["chip"]] == [0, 1, 2, 3]
    assert all(chip["size"] == [2048, 1024] for chip in config["chip"])
    # the scatter is measured where neither errors nor magnitudes are there
    assert config["data"]["sigma"] == pytest.approx(SIGMA * SCALE, rel=0.15)
    assert "GUESSED" in (tmp_path / "b.toml").read_text()
    arguments = ("--matches", tmp_path / "s.csv", "--columns", "chip")
    refused(tmp_path, "init", tmp_path / "c.toml", *arguments, words=["'chip' is not KEY=NAME"])


def als(field, path):
    """A list of DAOPHOT's ALLSTAR."""
    head = " NL   NX   NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD\n"
    head += "  1  2048  1024    10.0 60000.0   10.0    3.0    1.5   5.0  4.0\n\n"
    rest = "   0.010   100.00      4.     1.00    0.010\n"
    rows = zip(range(1, 1 + len(field.x)), field.x, field.y, field.mag, strict=True)
    path.write_text(head + "".join(f"{k:7d} {x:8.3f} {y:8.3f} {m:8.3f}{rest}"
                                   for k, x, y, m in rows))  # fmt: skip


def xymq(field, path):
    """A list of hst1pass by its suffix alone."""
    np.savetxt(path, np.column_stack([field.x, field.y, field.mag, 0 * field.x]), fmt="%.4f")


@pytest.mark.parametrize(("name", "write"), [("phot.als", als), ("phot.xymq", xymq)])
def test_a_star_list_becomes_a_draft_that_can_be_used(tmp_path, name, write):
    """A self-calibration as it stands; the comments have all that a campaign needs."""
    field, rng = field_of(), np.random.default_rng(4)
    for k, (dx, dy) in enumerate(((0, 0), (31, 7), (-9, 23))):
        x, y = (z + d + rng.normal(0, SIGMA, len(z)) for z, d in ((field.x, dx), (field.y, dy)))
        inside = (x > 0.5) & (y > 0.5) & (x < 2048.5) & (y < 1024.5)
        one = replace(field, x=x[inside], y=y[inside], mag=field.mag[inside])
        write(one, tmp_path / f"{k}{name}")
    config = tmp_path / "my.toml"
    out = good("init", config, "--matches", tmp_path / f"0{name}").out
    assert "incomplete draft: no columns are known as reference positions" in out
    text = config.read_text()
    assert "size = [2048, 1024]" in text
    refused(tmp_path, "check", config, words=["there is only one exposure"])
    config.write_text(text.replace(f'lists = "0{name}"', f'lists = "?{name}"'))
    out = good("check", config).out
    assert "exposures    3" in out and "stars        " in out
    commented = text.partition("# [campaign]")[2].partition("# 3.")[0]
    keys = {line.partition("=")[0].strip("# ") for line in commented.splitlines() if "=" in line}
    assert keys == {k for k, one in CampaignBlock.model_fields.items() if one.is_required()}


def test_positions_that_the_image_itself_gives_are_pointed_out(tmp_path):
    _, _, config = begun("ascii_head.cat", tmp_path)
    assert "LOOK: ALPHA_J2000 is often made from the pixels by the image's own WCS" in (
        config.read_text()
    )


# -- Gaia cross-matches ---------------------------------------------------------------------------

YEARS = -9.9  # from the catalogue's epoch to the exposure


def early_field(folder, **changes):
    """A Gaia cross-match of an exposure taken before the catalogue's epoch, with fast stars."""
    field = field_of(n=1500)
    table = gaia_table(field, epoch=None)
    rng = np.random.default_rng(8)
    for name in ("pmra", "pmdec"):
        table[name] = rng.normal(0, 12, len(table))  # mas / yr
    step = YEARS / 3600e3
    table["ra"] = field.ra - step * table["pmra"] / np.cos(np.radians(field.dec))
    table["dec"] = field.dec - step * table["pmdec"]
    for name, value in changes.items():
        table[name] = value
    table.write(folder / "gaia.csv")
    good("init", folder / "my.toml", "--matches", folder / "gaia.csv")
    return folder / "my.toml"


def rms_of(out):
    line = next(line for line in out.splitlines() if line.startswith("linear fit"))
    return [float(word.strip(",")) for word in line.split()[3:5]]


def test_an_epoch_shift_is_found_and_named(tmp_path):
    config = early_field(tmp_path)
    text = config.read_text()
    assert "# epoch = 2012.5" in text  # asked for
    out = good("check", config).out
    assert "proper motions are not used: the epoch of the exposures is not given" in out
    (line,) = (line for line in out.splitlines() if "go with the proper motions" in line)
    words = line.split()
    years, sigma = float(words[words.index("taken") + 1]), float(words[words.index("+-") + 1])
    assert abs(years + YEARS) < 4 * sigma < 0.5 and "before the epoch" in line
    # and what init asks for makes it go away
    config.write_text(text.replace("# epoch = 2012.5", f"epoch = {2016 + YEARS}"))
    moved = good("check", config).out
    assert "positions of 2016.00 were moved to 2006.10 by proper motions and parallaxes" in moved
    assert "go with the proper motions" not in moved
    assert max(rms_of(moved)) < 1.2 * SIGMA * SCALE < 0.2 * min(rms_of(out))


def test_a_run_tells_in_its_log_that_positions_were_moved(tmp_path):
    config = early_field(tmp_path, mjd=53772.0)  # 2006.1
    assert "# epoch = 2012.5" not in config.read_text()
    run = tmp_path / "run"
    run.mkdir()
    text = config.read_text().replace('"gaia.csv"', f'"{tmp_path / "gaia.csv"}"')
    (run / "config.toml").write_text(text)
    good("stage", "fit", run)
    log = (run / "bayesdist.log").read_text()
    assert "positions of 2016.00 were moved to 2006.10" in log
    assert "go with the proper motions" not in log


def test_rows_left_out_in_reading_are_counted(tmp_path):
    _, _, config = begun("gaia.csv", tmp_path)
    assert "left out     8 rows: no proper motion" in good("check", config).out


def test_tables_in_memory_are_matches():
    import pandas

    field = field_of()
    columns = {"x": field.x, "y": field.y, "ra": field.ra, "dec": field.dec, "mag": field.mag}
    frame = pandas.DataFrame(columns)
    frame.loc[3, "mag"] = np.nan  # a missing value of pandas
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of_frame = read_matches(frame, sigma="by_magnitude", tangent_point=POINT)
    of_table = read_matches(Table(columns), sigma=0.1, tangent_point=POINT)
    of_arrays = read_matches(columns, sigma=0.1, tangent_point=POINT)
    assert of_frame.rejected == {"no value in column 'mag'": 1} and len(of_frame) == 399
    np.testing.assert_array_equal(of_frame.u, np.delete(of_table.u, 3))
    np.testing.assert_array_equal(of_arrays.v, of_table.v)
    np.testing.assert_allclose(of_table.u, field.xi, atol=1e-6)


def test_the_way_to_use_stars_without_motions_is_named_and_works(tmp_path):
    config = early_field(tmp_path, mjd=53772.0)
    table = Table.read(tmp_path / "gaia.csv")
    for name in ("pmra", "pmra_error", "pmdec", "pmdec_error", "parallax", "parallax_error"):
        table[name] = MaskedColumn(table[name], mask=np.arange(len(table)) % 3 == 0)
    table.write(tmp_path / "gaia.csv", overwrite=True)
    text = config.read_text()
    out = good("check", config).out
    words = "left out     500 rows: no proper motion; to use them, set data.sigma to 'columns'"
    assert words in out and "data.motion_prior if fewer than 30 stars have a motion" in out
    text = text.replace('sigma = "by_magnitude"', 'sigma = "columns"')
    named = "{sigma_ra = 'ra_error', sigma_dec = 'dec_error', "
    config.write_text(text.replace("columns = {", f"columns = {named}"))
    out = good("check", config).out
    assert "left out" not in out and "1500 of 1500 rows" in out
    assert "500 of 1500 rows have no motion; they were given that of the others" in out
