"""Budget of a position, validity period and plan, through the command line, on pairs that drift."""

import json
import re

import numpy as np
import pytest
from astropy.table import Table

from tests.app.support import cli, good, one_sentence, refused, write_config, write_job
from tests.reduced import only_in_full

pytestmark = pytest.mark.usefixtures("figures_made")

SIZE = (512, 256)
N, EPOCHS = 250, np.linspace(2004.0, 2012.0, 6)
SIGMA, DRIFT = 0.02, 2e-5

BUDGET = [
    {"name": "catalogue", "kind": "random", "sigma_u": 0.004, "sigma_v": 0.004,
     "included_in_scatter": True, "source": "a paper"},
    {"name": "proper motions", "kind": "random", "sigma_u": 0.0, "sigma_v": 0.0,
     "source": "stars at rest in the simulation"},
    {"name": "aberration", "kind": "scale", "sigma": 4e-6},
]  # fmt: skip
CONFIG = {
    "data": {"matches": "stars.parquet", "unit": "pix"},
    "detector": {"name": "chip", "size": SIZE, "scale_mas": 50.0},
    "model": {"order": 2, "reference_pixel": (256.0, 128.0)},
    "model.tdd": {"epoch0": 2008.0, "terms": [["u", 1, 0], ["v", 1, 0]]},
    "sampler": {"target_ess": 200},
    "assess": {"epoch": 2008.0, "grid": (9, 5), "draws": 2000, "years_ahead": 20.0},
    "budget": BUDGET,
    "requirement": [{"name": "edge", "statistic": "max", "limit": 0.02, "region": "inner 100 %"}],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drift")
    rng = np.random.default_rng(1)
    epoch = np.repeat(EPOCHS, N)
    x, y = rng.uniform(1, SIZE[0], epoch.size), rng.uniform(1, SIZE[1], epoch.size)
    dx = x - 256.0
    mag = rng.uniform(14, 18, epoch.size)
    table = Table(
        {
            "x": x,
            "y": y,
            "u": dx + DRIFT * dx * (epoch - 2008) + rng.normal(0, SIGMA, epoch.size),
            "v": y - 128.0 + rng.normal(0, SIGMA, epoch.size),
            "sigma_u": np.full(epoch.size, SIGMA),
            "sigma_v": np.full(epoch.size, SIGMA),
            "epoch": epoch,
            "mag": mag,
        }
    )
    config = write_job(folder, table, stars="stars.parquet", **CONFIG)
    good("run", config, "-o", folder / "run", "-q")
    return folder / "run"


def rows_of(text):
    """The printed table: numbers of each term."""
    out = {}
    for line in text.splitlines():
        words = re.sub(r"\b(random|systematic|local)\b", " ", line).split()
        numbers = [k for k, word in enumerate(words) if re.fullmatch(r"[\d.]+(e-\d+)?", word)]
        if len(numbers) > 2 and numbers[0] > 0:  # a row begins with the name of its term
            out[" ".join(words[: numbers[0]])] = tuple(float(words[k]) for k in numbers[:2])
    return out


def test_the_budget_of_a_position_names_every_term_and_its_source(run):
    text = good("budget", run, "--at", 512, 128, "--magnitude", 16).out
    rows = rows_of(text)
    assert set(rows) == {
        *("coefficients", "time dependence", "aberration", "catalogue", "proper motions"),
        *("unmodelled structure in coefficients", "unmodelled structure", "centroid", "total"),
        "unmodelled exposure-to-exposure variation",
        "unmodelled fields of exposures in coefficients",
    }
    assert rows["aberration"][0] == pytest.approx(4e-6 * 256, rel=5 / np.sqrt(2 * 2000))
    # the scatter holds the catalogue: what is left is the centroid's, to some 5 % in bins of 60
    assert rows["centroid"][0] == pytest.approx(np.sqrt(SIGMA**2 - 0.004**2), rel=0.2)
    assert "a paper" in text and "given by the user" in text and "measured in this run" in text
    # at the reference date the drift adds nothing, ten years later it does
    assert rows["time dependence"][0] == 0
    later = rows_of(good("budget", run, "--at", 512, 128, "--epoch", 2018).out)
    fit = json.loads((run / "summary.json").read_text())
    assert later["time dependence"][0] > 0
    assert "centroid" not in later
    assert fit["budget"][-1]["name"] == "total"


def test_a_table_of_positions_has_the_budget_of_each(run):
    """Aberration grows with the distance from the reference pixel, (256, 128)."""
    path = run.parent / "places.csv"
    path.write_text("name,xcentroid,ycentroid\na,511,127\nb,255,127\nc,127,127\n")  # from 0
    options = ("--at-table", path, "--columns", "xcentroid", "ycentroid", "--magnitude", 16)
    said = json.loads(good("budget", run, *options, "--json").out)
    assert [(row["x"], row["y"]) for row in said["positions"]] == [
        (512, 128),
        (256, 128),
        (128, 128),
    ]
    assert (said["unit"], said["pixel_origin_of_table"], said["magnitude"]) == ("pix", 0, 16)
    sizes = [{t["name"]: t["u"] for t in row["terms"]} for row in said["positions"]]
    for row, x in zip(sizes, (512, 256, 128), strict=True):
        expected = 4e-6 * abs(x - 256)
        assert row["aberration"] == pytest.approx(expected, rel=5 / np.sqrt(2 * 2000), abs=1e-12)
        assert row["catalogue"] == pytest.approx(0.004)
    text = good("budget", run, *options).out
    first = text.splitlines()[2].split()
    assert first[:3] == ["512", "128", "1"] and "the first pixel is 0" in text
    assert float(first[3]) == pytest.approx(sizes[0]["total"], rel=1e-3)
    for arguments, words in (((), "no position is given"), (("--at", 1, 1, *options), "twice")):
        result = cli("budget", run, *arguments)
        assert result.code == 1 and words in result.err


def test_the_budget_of_a_difference_leaves_out_what_both_share(run):
    near = rows_of(good("budget", run, "--at", 300, 128, "--to", 310, 128).out)
    far = rows_of(good("budget", run, "--at", 1, 128, "--to", 512, 128).out)
    assert near["aberration"][0] == pytest.approx(4e-6 * 10, rel=0.1)
    assert far["aberration"][0] == pytest.approx(4e-6 * 511, rel=0.1)
    assert near["catalogue"][0] == pytest.approx(np.sqrt(2) * 0.004, rel=1e-3)
    assert near["coefficients"][0] < far["coefficients"][0]


def test_the_validity_period_is_said_written_and_drawn(run, full):
    [row] = json.loads((run / "summary.json").read_text())["validity_periods"]
    table = Table.read(run / "validity_periods.ecsv")
    assert len(table) == (40 if full else 10)
    assert table["epoch"][0] == pytest.approx(2012.0) and table["epoch"][-1] == 2032.0
    below = np.flatnonzero(table["probability"] < 0.95)
    assert below.size and below[0] > 0
    low, high = table["epoch"][below[0] - 1], table["epoch"][below[0]]
    assert low <= row["date"] <= high
    assert row["interval"][0] <= row["date"] <= row["interval"][1]
    assert "recalibrate before" in row["sentence"]
    assert (run / "figures" / "validity_period.svg").exists()
    text = (run / "report.html").read_text()
    assert row["sentence"] in text and "How long the requirements are met" in text
    # an independent judgement on both sides of the date
    early, late = row["interval"][0] - 2.0, row["interval"][1] + 2.0
    for epoch, verdict, code in ((early, "met", 0), (late, "not shown", 5)):
        req = run.parent / "edge.toml"
        req.write_text(
            f'[[requirement]]\nname = "edge"\nstatistic = "max"\nlimit = 0.02\nepoch = {epoch}\n'
        )
        out = cli("requirements", run, "--requirements", req, "-q")
        assert out.code == code
        assert verdict in out.out


def test_a_plan_says_what_more_exposures_do_not_make_smaller(run):
    req = run.parent / "late.toml"
    req.write_text(
        '[[requirement]]\nname = "late"\nstatistic = "max"\nlimit = 0.02\nepoch = 2025.0\n'
    )
    cli("requirements", run, "--requirements", req, "-q")
    text = good("plan", run, "--epochs", "2009,2013,2020").out
    # a bend of the drift is no smaller for more exposures of one date
    still = "with 4096 more exposures the probability of meeting the limit is 0"
    assert f"at 2020.00: {still}" in text and f"at 2013.00: {still}" in text
    assert "what more data do not make smaller is too large" in text
    assert "evenly from 2012.00 to 2025.00" in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--at", 600, 10), ["x = 600", "not on chip"]),
        (("--at", 10, 10, "--chip", 4), ["chip 4"]),
        (("--at", 10, 10, "--epoch", "inf"), ["epoch"]),
    ],
)
def test_a_budget_that_cannot_be_given_is_refused_in_one_sentence(run, arguments, words):
    result = cli("budget", run, *arguments)
    assert result.code == 1
    one_sentence(result.err, *words)


def too_large(run, folder):
    """The same job with a catalogue that is said to be worse than the residuals scatter."""
    data = CONFIG["data"] | {"matches": str(run.parent / "stars.parquet")}
    worse = [BUDGET[0] | {"sigma_u": 0.04}, *BUDGET[1:]]
    folder.mkdir()
    write_config(folder / "config.toml", **CONFIG | {"data": data, "budget": worse})
    return folder / "config.toml"


def test_errors_larger_than_the_residuals_are_refused_before_anything_is_sampled(run, tmp_path):
    config = too_large(run, tmp_path / "job")
    words = [
        "budget term 'catalogue'",
        "errors of 0.04",
        "that scatter by 0.0",
        "included_in_scatter",
    ]
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=words)
    refused(tmp_path, "check", config, words=words)


@pytest.mark.slow
@only_in_full("the fit refuses them")
def test_errors_larger_than_the_residuals_are_told_by_assess(run, tmp_path, monkeypatch):
    """As where the posterior takes more stars for false matches than the linear fit rejects."""
    folder = too_large(run, tmp_path / "run").parent
    with monkeypatch.context() as patch:
        patch.setattr("bayesdist.app.pipeline._check_residuals", lambda *_: None)
        good("stage", "fit", folder, "-q")
    for stage in ("sample", "assess"):
        good("stage", stage, folder, "-q")
    [told] = [
        w for w in json.loads((folder / "summary.json").read_text())["warnings"] if "'catal" in w
    ]
    assert told.startswith("Budget term 'catalogue': errors of 0.04 are declared part of residuals")
    assert told in (folder / "bayesdist.log").read_text()


def test_a_plan_without_the_requirement_is_refused(run):
    result = cli("plan", run, "--requirement", "none such")
    assert result.code == 1
    one_sentence(result.err, "no requirement 'none such'")
