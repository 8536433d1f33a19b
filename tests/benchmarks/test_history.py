"""Ratios of a run are kept by release, and a fifth less than before is found."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from PIL import Image

from tests.benchmarks import __main__ as program
from tests.benchmarks.history import (
    HISTORY,
    ratios_of,
    read_history,
    regressions,
    with_run,
    write_history,
)
from tests.benchmarks.markdown import to_markdown

KERNEL = "kernel, fraction of its roofline, order 5"
EMCEE = "rate, bayesdist / stock emcee, 5,000 stars"


def bench(ns: float, ratio: float, revision: str = "aaaaaaa") -> dict:
    """A run of two parts, whose kernel takes `ns` where 2.5 can be reached."""
    machine = {"revision": revision, "date": "2026-11-27 12:00 UTC", "cpu": "a processor"}
    samplers = [{"sampler": "stock emcee", "n_stars": 5000, "ratio_total": ratio}]
    kernel = [{"order": 5, "n_stars": 50_000, "ns_1": ns, "floor_1": 2.5}]
    return {
        "quick": False,
        "machine": machine,
        "parts": {"samplers": {"rows": samplers}, "kernel": {"rows": kernel}},
    }


def test_ratios_are_what_was_measured_side_by_side():
    assert ratios_of(bench(5.0, 4000.0)) == pytest.approx({EMCEE: 4000.0, KERNEL: 0.5})


@pytest.mark.parametrize(
    ("ns", "ratio", "worse"),
    [
        (5.0, 4000.0, []),
        (6.0, 3300.0, []),  # 17 % less each
        (6.5, 4000.0, [KERNEL]),
        (5.0, 3100.0, [EMCEE]),
        (2.5, 9000.0, []),
    ],
)
def test_a_fifth_less_is_a_regression(ns, ratio, worse):
    history = with_run([], bench(5.0, 4000.0), "1.0")
    found = regressions(history, bench(ns, ratio))
    assert [one.split(":")[0] for one in found] == worse


def test_a_ratio_that_is_gone_is_a_regression():
    now = bench(5.0, 4000.0)
    del now["parts"]["kernel"]
    (sentence,) = regressions(with_run([], bench(5.0, 4000.0), "1.0"), now)
    assert sentence.startswith(KERNEL) and "was not measured" in sentence


@pytest.mark.parametrize(("ns", "code"), [(5.5, 0), (6.5, 1)])
def test_the_program_fails_for_it(ns, code, tmp_path, monkeypatch, capsys):
    """What the workflow calls weekly: a kernel that takes `ns` in place of 5 at the release."""
    row = {"order": 5, "n_stars": 50_000, "batch": 32, "ns_1": ns, "floor_1": 2.5}
    roofline = {"fma_per_ns": 40.0, "bytes_per_ns": 60.0}
    part = {"rows": [row], "roofline": roofline, "mixture_ops": 45}
    likelihood = SimpleNamespace(FULL=None, run=lambda sizes: part)
    monkeypatch.setattr(program, "PARTS", {"kernel": likelihood})
    before = bench(5.0, 4000.0)
    del before["parts"]["samplers"]
    write_history(with_run([], before, "1.0"), tmp_path)
    output = str(tmp_path / "build")
    assert program.main(["--output", output, "--against", str(tmp_path / HISTORY)]) == code
    said = capsys.readouterr().err
    assert (f"{KERNEL}: 0.385, 23 % less than 0.5 at 1.0" in said) == bool(code)
    assert ("1.0 was measured on a processor, this on" in said) == bool(code)


@pytest.mark.parametrize("part", [["--quick"], ["--only", "kernel"]])
def test_a_part_is_not_compared(part, tmp_path):
    """The ratios that it lacks would count as lost."""
    with pytest.raises(SystemExit):
        program.main([*part, "--output", str(tmp_path), "--against", str(tmp_path / HISTORY)])
    assert list(tmp_path.iterdir()) == []


def test_releases_are_kept_once_and_drawn(tmp_path):
    history = with_run([], bench(5.0, 4000.0), "1.0")
    history = with_run(history, bench(4.0, 4000.0, "bbbbbbb"), "1.1")
    history = with_run(history, bench(3.0, 5000.0, "ccccccc"), "1.1")
    write_history(history, tmp_path)
    assert [one["revision"] for one in read_history(tmp_path / HISTORY)] == ["aaaaaaa", "ccccccc"]
    with Image.open(tmp_path / "figures" / "benchmark_history.png") as image:
        assert image.width > 500
    # the latest counts
    assert regressions(history, bench(4.0, 5000.0)) == [
        f"{KERNEL}: 0.625, 25 % less than 0.833 at 1.1"
    ]


def test_the_page_has_a_column_for_each_release():
    run = bench(5.0, 4000.0) | {"parts": {}}
    run["machine"] |= dict.fromkeys(("flags", "ram_gib", "cores", "os", "python", "load"))
    run["machine"]["libraries"] = {}
    history = with_run(with_run([], bench(5.0, 4000.0), "1.0"), bench(4.0, 4400.0), "1.1")
    page = to_markdown(run, history)
    assert f"| {KERNEL} | 0.500 | 0.625 |" in page and "1.1 (aaaaaaa)" in page
