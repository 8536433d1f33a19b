"""What a person sees in the terminal, and what it costs to begin."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from bayesdist.app.result_files import margins_text
from bayesdist.app.screen import number, table_text


def test_table_text_aligns_text_left_and_numbers_right():
    rows = [
        {"name": "shift", "value": 1.23456, "n": 12},
        {"name": "x", "value": None, "n": 3},
    ]
    assert table_text(rows, 3).splitlines() == [
        " name value  n",
        "----- ----- ---",
        "shift  1.23  12",
        "x         -   3",
    ]
    assert table_text([]) == "(none)"


def test_probabilities_have_the_digits_of_their_error():
    """A counted probability is never certain, and its error never none."""
    row = {"name": "corner", "statistic": "max", "value": 0.01, "limit": 0.02, "unit": "pix"}
    row |= {"probability": 0.95, "verdict": "met", "n_effective": 2000.0}
    for p, error, text in ((1.0, 0.000177, "> 0.9995"), (0.91, 0.0061, "0.9100 +- 0.006")):
        assert text in margins_text([row | {"probability_met": p, "mc_error": error}])


def test_numbers_that_are_none():
    assert [number(value) for value in (None, float("nan"), float("inf"))] == ["-", "-", "-"]
    assert [number(1), number(True), number(0.123456), number("a")] == ["1", "True", "0.1235", "a"]


@pytest.mark.parametrize("name", ["data", "infer", "assess", "products"])
def test_a_room_loads_nothing_before_it_is_asked(name):
    heavy = ("numpy", "numba", "scipy", "astropy", "matplotlib", "pydantic")
    code = f"import sys, bayesdist.{name}; print([m for m in {heavy!r} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_help_loads_nothing_heavy():
    heavy = ("numpy", "numba", "scipy", "astropy", "matplotlib", "pydantic")
    code = f"""
import sys
from bayesdist.app.cli import main
assert main(["--help"]) == main(["run", "--help"]) == 0
print([m for m in {heavy!r} if m in sys.modules], file=sys.stderr)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stderr.strip() == "[]"
    assert "Exit codes: 0 success; 1 invalid input" in run.stdout


def test_a_file_is_inspected_without_what_only_other_files_need(tmp_path):
    path = tmp_path / "sip.hdr"
    path.write_text(
        "CTYPE1  = 'RA---TAN-SIP'\nCTYPE2  = 'DEC--TAN-SIP'\nCRPIX1  = 512\nCRPIX2  = 512\n"
        "CRVAL1  = 10\nCRVAL2  = 20\nA_ORDER = 2\nB_ORDER = 2\nA_2_0   = 1E-6\nB_0_2   = 1E-6\n"
    )
    heavy = ("numba", "scipy.optimize", "scipy.stats", "astropy.table", "matplotlib", "xarray")
    code = f"""
import sys
from bayesdist.products.registry import open_document
document = open_document({str(path)!r})
assert document.format.key == "sip" and document.lint() is not None
print([m for m in {heavy!r} if m in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_a_run_begins_without_what_only_a_stage_or_a_few_runs_need():
    """The sampler's libraries take a second each, those of the sky and of pictures half of one."""
    heavy = (
        *("arviz_stats", "astropy.coordinates", "astropy.wcs", "corner", "dask", "distributed"),
        *("emcee", "jinja2", "matplotlib", "pandas", "pyarrow", "scipy.stats", "xarray"),
    )
    code = f"""
import sys, bayesdist.app.stages, bayesdist.app.commands.check
print([m for m in {heavy!r} if m in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("words", "proposed"),
    [
        ("bayesdist re", {"plain,report", "plain,requirements", "plain,release"}),
        ("bayesdist run --re", {"plain,--resume"}),
        ("bayesdist simulate ", {"plain,camera", "plain,acs", "plain,wise"}),
        ("bayesdist stage sa", {"plain,sample"}),
        ("bayesdist run cam", {"file,cam"}),
        ("bayesdist run c.toml -o ", {"file,"}),
    ],
)
def test_a_shell_completes_commands_options_and_files(words, proposed):
    variables = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    run = subprocess.run(
        [sys.executable, "-m", "bayesdist"],
        env=os.environ | variables | {"_BAYESDIST_COMPLETE": "bash_complete"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(run.stdout.splitlines()) == proposed


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_for_a_shell(shell):
    run = subprocess.run(
        [sys.executable, "-m", "bayesdist"],
        env=os.environ | {"_BAYESDIST_COMPLETE": f"{shell}_source"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"_BAYESDIST_COMPLETE={shell}_complete" in run.stdout
