"""`bayesdist plan-dither`: the files it writes, what it refuses, and its documentation."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.kinds.selfcal.patterns.command import PlanConfig, load_plan
from tests.app.support import REPOSITORY, good, refused
from tests.docs_blocks import blocks
from tests.test_docs import _configured

PAGE = REPOSITORY / "docs" / "planning.md"

SMALL = """
[detector]
name = "small"
size = [512, 512]
scale_mas = 50

[model]
order = 2

[gauge]
offset_sigma = 0.1

[stars]
per_detector = 200
sigma = 0.02
false = 0.05

[[pattern]]
name = "no rolls"
grid = {n = [3, 2], step = 0.25}
unit = "detector"

[[pattern]]
name = "listed"
offsets = [[0, 0], [128, 0, 60], [0, 128, 130], [128, 128], [-100, 60, 60], [40, -110, 130]]

[[pattern]]
name = "not moved"
offsets = [[7, 7]]
exposures = 4
"""


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    file = folder / "patterns.toml"
    file.write_text(SMALL, encoding="utf-8")
    return file, folder / "out", good("plan-dither", file, "-o", folder / "out").out


def _constant(text):
    raise AssertionError(f"{text} in a JSON file")


def test_files_say_the_same_as_the_screen(job):
    _, out, printed = job
    table = Table.read(out / "patterns.ecsv")
    record = json.loads((out / "plan.json").read_text("utf-8"), parse_constant=_constant)
    assert list(table["pattern"]) == [p["name"] for p in record["patterns"]]
    assert list(table["pattern"]) == ["listed", "no rolls", "not moved"]
    assert record["schema"] == 1 and record["unit"] == "pix"
    for row, p in zip(table, record["patterns"], strict=True):
        for kind in ("gauge_free", "shape", "absolute"):
            for what in ("rms", "max"):
                value = p[kind][what]
                assert row[f"{kind}_{what}"] == (np.inf if value is None else value)
        assert row["free"] == p["n_free"] and row["exposures"] == len(p["offsets"])
        lacks = "" if np.ma.is_masked(row["lacks"]) else row["lacks"]  # as ECSV has it
        assert lacks == "; ".join(p["lacks"])
        assert all(sentence in printed for sentence in (*p["lacks"], *p["sentences"]))
    assert table["shape_rms"].unit == "pix"
    last = record["patterns"][-1]
    # nothing is dithered: all 12 coefficients are free, and no error of them is known
    assert last["n_free"] == 12 and last["shape"] == {"rms": None, "max": None}
    assert last["lacks"][1] == "no offsets: the polynomials are free"
    shape = record["patterns"][0]["shape"]
    assert printed.splitlines()[-1] == (
        f"Best: listed, shape known per axis to {shape['rms']:.2g} pix rms, "
        f"{shape['max']:.2g} at worst "
        f"({50 * shape['rms']:.2g} and {50 * shape['max']:.2g} mas)"
    )
    line = next(text for text in printed.splitlines() if text.startswith("not moved"))
    assert line.split()[-4:] == ["-"] * 4
    assert (out / "figures" / "patterns.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_seed_gives_the_same_plan(job, tmp_path):
    file, _, printed = job
    assert good("plan-dither", file).out == printed
    other = tmp_path / "other.toml"
    other.write_text(SMALL.replace("[stars]", "[stars]\nseed = 2"), "utf-8")
    assert good("plan-dither", other).out != printed


def test_generated_patterns_are_what_the_file_says(tmp_path):
    file = tmp_path / "p.toml"
    file.write_text(
        SMALL
        + """
[[pattern]]
name = "grid"
grid = {n = [2, 3], step = [5, 7]}
rolls = [10, 100]

[[pattern]]
name = "scales"
scales = {least = 5, largest = 0.5}
exposures = 40

[[pattern]]
name = "scales, rolls"
scales = {least = 5, largest = 0.5}
exposures = 40
rolls = [0, 90]
""",
        encoding="utf-8",
    )
    found = {p.name: p for p in load_plan(file).patterns()}
    assert found["no rolls"].offsets.round(6).tolist() == [
        [x, y] for y in (0, 128) for x in (0, 128, 256)
    ]
    assert np.degrees(found["listed"].rolls) == pytest.approx([0, 60, 130, 0, 60, 130])
    # every offset at every roll, against the first exposure
    grid = {(x, y, round(np.degrees(r))) for (x, y), r in
            zip(found["grid"].offsets.tolist(), found["grid"].rolls, strict=True)}  # fmt: skip
    assert grid == {(x, y, r) for x in (0, 5) for y in (0, 7, 14) for r in (0, 90)}
    scales = found["scales"]
    length = np.hypot(*scales.offsets[1:].T)
    assert length.min() >= 5 and length.max() <= 256 and length.max() > 12 * length.min()
    # patterns that differ in their rolls alone have the same offsets
    assert (found["scales, rolls"].offsets == scales.offsets).all() and scales.rolls.max() == 0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "listed"', 'name = "no rolls"', ["two [[pattern]] blocks", "'no rolls'"]),
        ("[128, 0, 60]", "[128000, 0, 60]", ["'listed'", "2 groups", "1, 3, 4, 5, 6 | 2"]),
        ("exposures = 4", "exposures = 1", ["'not moved' has one exposure", "at least two"]),
        ("offsets = [[7, 7]]", "offsets = []", ["'not moved'", "empty list of offsets"]),
        ("offsets = [[7, 7]]", "", ["'not moved'", "one of the three"]),
        ("exposures = 4", "scales = {}", ["'not moved'", "one of the three"]),
        ("offsets = [[7, 7]]\nexposures = 4", "scales = {}", ["'not moved'", "number of exp"]),
        ("offsets = [[7, 7]]\n", 'scales = {}\nunit = "detector"\n', ["leave out the unit"]),
        ("[-100, 60, 60]", "[-100, 60, 60, 1]", ["pattern[2].offsets[5]"]),
        ("130]]", "130]]\nrolls = [0, 90]", ["'listed'", "give one of the two"]),
        ("[model]", '[selfcal]\nframes = "shift"\n\n[model]', ["'listed' has rolls", "'shift'"]),
        ("offset_sigma = 0.1", "exposure_scale_sigma = 1e-5", ["shift_rotation_scale"]),
        ("offset_sigma", "offset_sigmas", ["unknown key 'offset_sigmas'", "'offset_sigma'"]),
        ("false = 0.05", "false = 1.0", ["stars.false", "less than 1"]),
        ("size = [512, 512]", "", ["detector.size is missing"]),
        ("per_detector = 200", "per_detector = 0.5", ["groups that share no stars"]),
        ("per_detector = 200", "per_detector = 1e9", ["stars.per_detector", "fewer stars"]),
    ],
)  # fmt: skip
def test_wrong_input_is_said_in_one_sentence(old, new, words, tmp_path):
    assert old in SMALL
    file = tmp_path / "patterns.toml"
    file.write_text(SMALL.replace(old, new), encoding="utf-8")
    refused(tmp_path, "plan-dither", file, "-o", tmp_path / "out", words=words)


def test_no_pattern_at_all(tmp_path):
    file = tmp_path / "patterns.toml"
    file.write_text(SMALL.partition("[[pattern]]")[0], encoding="utf-8")
    refused(tmp_path, "plan-dither", file, words=["there is no pattern", "[[pattern]]"])


def test_chips_have_places_all_or_none(tmp_path):
    chip = '[[chip]]\nnumber = {0}\nname = "c{0}"\nsize = [512, 512]\n'
    chip += "reference_pixel = [256, 256]\n{1}\n"
    start = SMALL.replace("size = [512, 512]\n", "", 1).partition("[[pattern]]")
    file = tmp_path / "patterns.toml"

    def write(*places):
        chips = "".join(chip.format(k + 1, place) for k, place in enumerate(places))
        file.write_text(start[0] + chips + start[1] + start[2], encoding="utf-8")

    write("", "place = [600, 0]")
    refused(tmp_path, "plan-dither", file, words=["some [[chip]] blocks have the key place"])
    write("place = [0, 0]", "place = [600, 0]")
    camera = load_plan(file).camera()
    assert camera.side == pytest.approx(512, abs=1)
    write("", "")
    assert load_plan(file).camera().side == pytest.approx(512, abs=1)


def test_what_cannot_be_planned_is_refused(job, tmp_path):
    file, out, _ = job
    refused(tmp_path, "plan", file, words=["not a run", "bayesdist plan-dither"])
    refused(out, "plan-dither", file, "-o", out, words=["holds other files"])
    refused(tmp_path, "plan-dither", tmp_path / "none.toml", words=["does not exist"])


def test_the_page_documents_every_key_and_its_example_is_sound(tmp_path):
    text = PAGE.read_text(encoding="utf-8")
    [example] = [body for language, body in blocks(PAGE) if language == "toml"]
    file = tmp_path / "patterns.toml"
    file.write_text(example, encoding="utf-8")
    assert len(load_plan(file).patterns()) > 1
    rows = re.findall(r"^\| (.*) \|$", text, re.MULTILINE)
    named = {word for row in rows for word in re.findall(r"\w+", row)}
    assert {key for _, key in _configured(PlanConfig)} <= named
