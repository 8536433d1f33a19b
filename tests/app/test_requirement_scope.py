"""Requirements with a scope, through the command line."""

import json

import pytest
from astropy.table import Table

from bayesdist.app.cli import main
from tests.app.support import edit
from tests.reduced import only_in_full

SCOPED = """
[[requirement]]
name = "inner"
statistic = "p95"
limit = 0.5
region = "inner 80 %"

[[requirement]]
name = "between two stars"
statistic = "rms"
limit = 0.0001
relative = true
separation = 200.0

[[requirement]]
name = "a corner"
statistic = "max"
limit = 0.5
region = [[1.0, 1.0], [300.0, 1.0], [1.0, 300.0]]
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scope")
    assert main(["simulate", "wise", "-o", str(folder), "--stars", "1500", "-q"]) == 0
    config = folder / "config.toml"
    edit(
        config,
        {
            "[sampler]": "[sampler]\ntarget_ess = 100\ntarget_rhat = 1.05",
            "grid = [33, 33]": "grid = [17, 17]\ndraws = 400",
        },
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bayesdist.app.stages.report", lambda results, pdf: [])
        assert main(["run", str(config), "-o", str(folder / "run"), "-q"]) == 0
    return folder / "run"


def validated(run, text, code):
    path = run.parent / "req.toml"
    path.write_text(text)
    assert main(["requirements", str(run), "--requirements", str(path), "-q"]) == code
    return json.loads((run / "summary.json").read_text())["margins"]


@pytest.mark.slow
@only_in_full("tests/assess/test_requirement_scope has the scopes")
def test_scopes_are_judged_and_kept(run, capsys):
    inner, pair, corner = validated(run, SCOPED, 4)
    assert [m["verdict"] for m in (inner, pair, corner)] == ["met", "missed", "met"]
    assert inner["region"] == "inner 80 %"
    assert pair["relative"] is True and pair["separation"] == 200.0
    assert corner["region"] == [[1.0, 1.0], [300.0, 1.0], [1.0, 300.0]]
    assert corner["worst"]["x"] < 300 and corner["worst"]["y"] < 300
    assert inner["margin_percent"] == pytest.approx(100 * inner["margin"] / 0.5)
    printed = capsys.readouterr().out
    # every term of a difference is far above the limit
    assert "between two stars: no term can do it alone" in printed
    rows = dict(zip(("inner", "pair", "corner"), printed.splitlines()[2:], strict=False))
    assert "over the inner 80 %" in rows["inner"]
    assert "between two positions up to 200 px apart" in rows["pair"]
    assert "over a polygon of 3 corners" in rows["corner"]
    table = Table.read(run / "margins.ecsv")
    assert list(table["scope"]) == [
        "over the inner 80 %",
        "between two positions up to 200 px apart",
        "over a polygon of 3 corners",
    ]


@pytest.mark.slow
@only_in_full("scopes are judged and kept")
def test_the_report_judges_them_again_as_they_were_asked(run):
    before = validated(run, SCOPED, 4)
    assert main(["stage", "report", str(run), "-q"]) == 0
    text = (run / "report.html").read_text()
    assert "between two positions up to 200 px apart" in text
    assert "no term can do it alone" in text
    assert json.loads((run / "summary.json").read_text())["margins"] == before


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('region = "middle"', "no region 'middle'"),
        ("region = [[1.0, 1.0], [2.0, 2.0], [3.0, 1.5]]", "holds 0 points"),
        ("epochs = [2010.0, 2012.0]", "does not depend on time"),
        ("separation = 5.0", "needs two positions"),
        ("magnitude = 99.0", "were not measured"),
    ],
)
def test_scopes_that_cannot_be_judged_are_refused_in_one_sentence(run, line, message, capsys):
    text = f'[[requirement]]\nname = "r"\nstatistic = "max"\nlimit = 1.0\n{line}\n'
    before = (run / "margins.ecsv").read_bytes()
    path = run.parent / "bad.toml"
    path.write_text(text)
    assert main(["requirements", str(run), "--requirements", str(path), "-q"]) == 1
    said = capsys.readouterr().err
    assert message in said and f"{path}: requirement 'r'" in said
    assert said.count("\n") == 1
    assert (run / "margins.ecsv").read_bytes() == before
