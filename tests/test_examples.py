"""The examples run as they stand, and say what their texts say."""

from __future__ import annotations

import contextlib
import io
import re
import runpy
import shutil
import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from bayesdist.app.cli import main
from bayesdist.simulate import camera
from tests.reduced import only_in_full

from .docs_blocks import run_page

ROOT = Path(__file__).resolve().parents[1]


def printed(name: str | Path, cwd: Path, *arguments: object) -> str:
    """What an example prints, in a folder of its own."""
    script = ROOT / "examples" / name
    out = io.StringIO()
    with (
        contextlib.chdir(cwd),
        contextlib.redirect_stdout(out),
        patch.object(sys, "argv", [str(script), *map(str, arguments)]),
    ):
        runpy.run_path(str(script), run_name="__main__")
    return out.getvalue()


def test_steps_of_a_mask_of_pinholes_fix_the_scale(tmp_path, monkeypatch, capsys):
    """As well as a step over their lever arm; only where the mask is stays a convention."""
    assert "mask.toml" in printed("pinhole_mask.py", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["check", "mask/mask.toml"]) == 0
    out = capsys.readouterr().out
    assert "null space   4 directions are free, 2 of them held by convention" in out
    assert "zero_point_u: held" in out and "zero_point_v: held" in out
    assert "WARNING" not in out  # what the gauge settles is a note
    stage = Table.read("mask/stage.ecsv")
    arm = np.hypot(*(np.std(stage[key]) for key in ("du", "dv"))) * len(stage) ** 0.5
    for what in ("scale", "rotation"):
        sigma = float(re.search(rf"{what}: fixed by commanded offsets, sigma (\S+)", out)[1])
        assert sigma == pytest.approx(0.002 / arm, rel=0.1)


@pytest.mark.slow
@only_in_full("tests/missions/wise/test_bringup does")
def test_the_bring_up_ends_at_the_truth_from_every_start(tmp_path):
    """A sigma of a corner is 0.023 px: that of 5700 pairs of 0.14 px and 15 terms of an axis.

    At a corner each of 15 Legendre products P_i P_j is 1, with variance (2 i + 1)(2 j + 1) / n.
    """
    out = printed("wise_bringup.py", tmp_path)
    starts = out.split("\n\n")[1:]
    assert [re.match("from [a-z ]+", one).group() for one in starts] == [
        "from nothing",
        "from the optical model as delivered",
        "from the optical model",
    ]
    assert "turned by 270 degrees" in starts[2]
    terms = [(i, j) for i in range(5) for j in range(5 - i)]
    ends = []
    for one in starts:
        first, *_, last = (line.split() for line in re.findall(r"^ +\d.*$", one, re.MULTILINE))
        pairs, rms = int(last[2]), float(last[4])
        sigma = rms * sum((2 * i + 1) * (2 * j + 1) for i, j in terms) ** 0.5 / pairs**0.5
        off = float(re.search(r"([\d.]+) px off", one).group(1))
        # the largest of eight numbers, four corners of two axes each
        assert float(last[5]) < 4 * sigma < 0.1 * off
        assert last[3] == "100.0%" and float(first[3].rstrip("%")) < 95
        assert "The calibration converged in" in one
        ends.append(last[5])
    # not the start decides, but the pairs
    assert len(set(ends)) == 1
    # as delivered the optical model is worse than none, turned it is not
    off = [float(re.search(r"([\d.]+) px off", one).group(1)) for one in starts]
    pairs = [int(re.search(r"^ +1 +2 +(\d+)", one, re.MULTILINE).group(1)) for one in starts]
    assert off[1] > 1.5 * off[0] and pairs[1] < pairs[0] and pairs[1] < pairs[2]


def test_every_example_is_run_here():
    """Scripts of the folder itself are those that the tests of this file go through."""
    tested = set(re.findall(r'printed\("(\w+\.py)"', Path(__file__).read_text(encoding="utf-8")))
    assert {p.name for p in (ROOT / "examples").glob("*.py")} == tested


def test_the_python_example_finds_the_mixture_wider_than_the_formal_errors(tmp_path):
    """Formal errors know neither the jitter of 0.03 px nor the false matches."""
    out = printed("python_api.py", tmp_path)
    assert "MET: field-wide" in out
    formal, posterior = (float(re.search(rf"{k}: +([\d.]+)", out).group(1))
                         for k in ("formal", "posterior"))  # fmt: skip
    assert formal < posterior < 2 * formal
    header = fits.Header.fromtextfile(tmp_path / "w2.hdr")
    assert header["A_ORDER"] == header["B_ORDER"] == 4
    assert (tmp_path / "w2-run" / "summary.json").is_file()


@pytest.mark.parametrize("name", ["hst1pass_uvis", "anet"])
def test_the_examples_of_real_data_are_read(name, tmp_path, data_dir, capsys):
    """Their configurations are sound: nothing is degenerate, few rows are left out."""
    folder = tmp_path / name
    shutil.copytree(ROOT / "examples" / name, folder)
    if name == "anet":
        shutil.copy(data_dir / "anet_pairs" / "Harry695_corr.fits", folder / "corr.fits")
    else:
        printed(folder / "match.py", tmp_path, data_dir / name)
    assert main(["check", str(folder / "config.toml")]) == 0
    assert "nothing is degenerate" in capsys.readouterr().out


@pytest.mark.slow
def test_the_quickstart_of_the_readme_runs(tmp_path, monkeypatch, capsys, full):
    """The simulated camera has the truth in its WCS: the header maps pixels as it does.

    4000 stars of 0.06 px at the median and 15 coefficients of an axis leave 0.06 (15 / 4000)^0.5
    px rms, 0.004 px; corners have several times that.
    """
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "camera"]) == 0
    assert capsys.readouterr().out == "camera_gaia.csv: 4000 matched stars\n"
    if not full:
        run_page(ROOT / "README.md", languages={"toml"})
        assert main(["check", "camera.toml"]) == 0
        pytest.skip("its input is right; half a minute for the run: set BAYESDIST_FULL=1")
    run_page(ROOT / "README.md", languages={"toml", "console"})
    truth = camera()
    found = WCS(fits.Header.fromtextfile(tmp_path / "camera-run" / "sip.hdr"))
    x, y = np.meshgrid(np.linspace(50.0, 1999.0, 14), np.linspace(50.0, 1999.0, 14))
    apart = found.pixel_to_world(x, y).separation(truth.pixel_to_world(x, y)).arcsec / 0.2
    assert np.sqrt(np.mean(apart**2)) < 0.02
    assert Path("camera-run/report.html").is_file()
