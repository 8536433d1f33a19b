"""The configuration file: defaults, nearest keys, what excludes what."""

from __future__ import annotations

import json

import pytest

from bayesdist.app.config import installed_kinds, load_config, load_requirements, parse_config
from bayesdist.errors import ConfigError, InputError
from bayesdist.infer import Compute
from tests.app.support import config_text, write_config

# design.md, section 8, for one chip and without the choice of an engine
SAMPLE = """
[data]
matches  = "stars.ecsv"
format   = "auto"
columns  = {x="x", y="y", u="u", v="v", sigma_u="su", sigma_v="sv", exposure="exp", mag="mag"}
unit     = "pix"
sigma    = "columns"
pixel_origin = 1
[detector]
name = "WFC1"
size = [4096, 2048]
scale_mas = 49.7
[model]
order = 5
reference_pixel = [2048.0, 1024.0]
frames = "none"
[model.tdd]
epoch0 = 2004.5
terms = [["u",1,0], ["v",1,0]]
breaks = [2009.4]
[fit]
clip_chi2 = 25.0
clip_abs = 2.0
radial_weight = 1.0
[outliers]
model = "gaussian"
match_radius = 2.0
[sampler]
seed = 1
ensembles = 4
target_ess = 400
target_rhat = 1.01
max_steps = 20000
checkpoint_every = 200
[assess]
epoch = 2006.5
grid = [33, 17]
[[budget]]
name = "reference catalogue"
kind = "systematic"
sigma_u = 0.02
sigma_v = 0.02
unit = "pix"
[[requirement]]
name = "field-wide"
statistic = "p95"
limit = 0.1
unit = "pix"
probability = 0.95
epoch = 2006.5
[products]
sip = {inverse_order = 6}
idctab = {instrument = "ACS", detector = "WFC", v2ref = 256.6}
"""
CHIP = {"number": 2, "name": "WFC2", "size": [4096, 2048], "reference_pixel": [2048.0, 1024.0]}


def parsed(text: str):
    return parse_config(text, "c.toml")


def refusal(text: str) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        parsed(text)
    sentence = str(caught.value)
    assert sentence.startswith("c.toml: ") and "\n" not in sentence
    return caught.value


def test_the_sample_of_the_design_parses():
    config = parsed(SAMPLE)
    assert config.detector.size == (4096, 2048)
    assert config.model.order == 5
    time = config.time()
    assert time.terms == (("u", 1, 0), ("v", 1, 0))
    assert time.breaks == (2009.4,) and time.epoch0 == (2004.5, 2004.5)
    assert config.requirements()[0].epoch == 2006.5
    assert config.user_terms()[0].kind == "systematic"
    assert config.products.sip.inverse_order == 6
    assert config.products.idctab.detector == "WFC"


def test_the_sample_with_a_chip_block_in_place_of_the_detector():
    text = SAMPLE.replace("size = [4096, 2048]\n", "").replace(
        "reference_pixel = [2048.0, 1024.0]\n", ""
    )
    block = config_text(
        data=None, detector=None, model=None, sampler=None, assess=None,
        chip=[CHIP | {"reference": True}],
    )  # fmt: skip
    (chip,) = parsed(text + block).chips()
    assert (chip.number, chip.name) == (2, "WFC2")
    assert chip.size == (4096, 2048) and chip.reference_pixel == (2048, 1024)


def test_values_that_the_design_names_are_the_defaults():
    config = parsed('[data]\nmatches = "s.ecsv"\n[detector]\nsize = [9, 9]\n[model]\norder = 3\n')
    assert (config.data.format, config.data.sigma, config.data.pixel_origin) == (
        "auto",
        "columns",
        None,  # 1, but for tables whose names are of a program that counts from 0
    )
    assert config.model.frames == "none" and config.time() is None
    assert (config.fit.clip_chi2, config.fit.clip_abs, config.fit.radial_weight) == (25, 2, 1)
    assert config.outliers.model == "gaussian" and config.outliers.jitter == "fit"
    s = config.sampler
    assert (s.seed, s.ensembles, s.target_ess, s.target_rhat) == (1, 4, 400, 1.01)
    assert (s.max_steps, s.checkpoint_every) == (20000, 200)
    assert config.assess.grid == (33, 17) and config.assess.epoch is None
    assert config.requirements() == () and config.user_terms() == () and config.chips() == ()
    assert config.products.sip is None and config.products.idctab is None
    assert config.resources() == Compute("threads", 1000.0)
    cluster = parsed(config_text(compute={"engine": "dask", "scheduler": "tcp://10.0.0.1:8786"}))
    assert cluster.resources() == Compute("dask", scheduler="tcp://10.0.0.1:8786")


@pytest.mark.parametrize(
    ("wrong", "right", "key"),
    [
        ("odrer = 2", "order", "model.odrer"),
        ("[smapler]", "sampler", "smapler"),
        ("max_stpes = 20", "max_steps", "sampler.max_stpes"),
        ("match_radus = 2", "match_radius", "outliers.match_radus"),
        ("limt = 0.1", "limit", "requirement[1].limt"),
        ("sigma_w = 0.1", "sigma_", "budget[1].sigma_w"),
        ("sip = {inverse = 4}", "inverse_order", "products.sip.inverse"),
        ("terns = []", "terms", "model.tdd.terns"),
        ("crlval = [0, 0]", "crval", "products.sip.crlval"),
    ],
)
def test_an_unknown_key_names_the_nearest_known_one(wrong, right, key):
    section = key.rpartition(".")[0].replace("[1]", "")
    text = {
        "model": config_text(model=None) + f"[model]\n{wrong}\n",
        "": config_text() + f"{wrong}\n",
        "sampler": config_text(sampler=None) + f"[sampler]\n{wrong}\n",
        "outliers": config_text() + f"[outliers]\n{wrong}\n",
        "requirement": config_text() + f"[[requirement]]\n{wrong}\n",
        "budget": config_text() + f"[[budget]]\n{wrong}\n",
        "model.tdd": config_text() + f"[model.tdd]\n{wrong}\n",
        "products.sip": config_text() + f"[products.sip]\n{wrong}\n",
    }[section]
    if wrong.startswith("sip"):
        text = config_text() + f"[products]\n{wrong}\n"
    error = refusal(text)
    assert error.where == f"c.toml: {key}"
    assert right in error.do


def test_a_key_like_no_other_lists_the_known_ones():
    error = refusal(config_text() + "[fit]\nzzzz = 1\n")
    assert all(k in error.do for k in ("clip_abs", "clip_chi2", "radial_weight"))


@pytest.mark.parametrize(
    ("section", "content", "words"),
    [
        ("model", {"order": 0}, ["model.order", "greater than or equal to 1"]),
        ("model", {"order": 13}, ["model.order", "less than or equal to 12"]),
        ("model", {"order": "five"}, ["'five'", "whole number"]),
        ("model", {"order": "5"}, ["'5'", "whole number"]),
        ("model", {"order": True}, ["whole number"]),
        ("model", {"order": 2.5}, ["2.5", "whole number"]),
        ("model", {}, ["model.order", "missing"]),
        ("model", {"order": 2, "frames": "shfit"}, ["'shfit'", "shift_rotation_scale"]),
        ("data", {"matches": 3}, ["data.matches"]),
        ("data", {"matches": "a", "sigma": -0.1}, ["data.sigma", "-0.1", "greater than 0"]),
        ("data", {"matches": "a", "sigma": "colums"}, ["'columns' or 'by_magnitude'", "number"]),
        ("data", {"matches": "a", "unit": "furlong"}, ["data.unit", "'mas'"]),
        (
            "data",
            {"matches": "a", "unit": "mm"},
            ["'mm'", "data.plate_scale", "divide u, v", "'pix'"],
        ),
        ("data", {"matches": "a", "format": "xls"}, ["data.format", "'hst1pass'"]),
        ("data", {"matches": "a", "pixel_origin": 2}, ["data.pixel_origin", "0 or 1"]),
        ("data", {"matches": "a", "columns": {"x": 1}}, ["data.columns.x", "text"]),
        ("detector", {"name": "A"}, ["detector.size is missing"]),
        ("detector", {"size": [10]}, ["detector.size[2]", "missing"]),
        ("detector", {"size": [10, -1]}, ["detector.size[2]", "greater than 0"]),
        ("detector", {"size": [9, 9], "scale_mas": 0}, ["detector.scale_mas"]),
        ("assess", {"grid": [1, 5]}, ["assess.grid[1]"]),
        ("assess", {"epoch": "2006"}, ["assess.epoch", "number"]),
        ("sampler", {"target_rhat": 1.0}, ["sampler.target_rhat"]),
        ("sampler", {"seed": -1}, ["sampler.seed"]),
        ("sampler", {"ensembles": 1}, ["sampler.ensembles"]),
        ("sampler", {"max_steps": 0}, ["sampler.max_steps"]),
        ("outliers", {"jitter": -1}, ["outliers.jitter", "'fit'"]),
        ("outliers", {"fraction_prior": [0, 1]}, ["outliers.fraction_prior[1]"]),
        ("compute", {"engine": "dsak"}, ["compute.engine", "'threads' or 'dask'"]),
        ("compute", {"scheduler": "tcp://a:1"}, ["compute.scheduler", "'threads'", "'dask'"]),
        ("compute", {"workers": 2}, ["compute.workers", "set the engine to 'dask'"]),
        ("compute", {"scratch": "/scratch"}, ["compute.scratch", "set the engine to 'dask'"]),
        ("compute", {"engine": "dask", "scratch": "here"}, ["compute.scratch", "absolute path"]),
        ("compute", {"engine": "dask", "workers": 0}, ["compute.workers", "greater than 0"]),
        (
            "compute",
            {"engine": "dask", "scheduler": "tcp://a:1", "workers": 2},
            ["compute.workers", "compute.scheduler", "leave one"],
        ),
        ("compute", {"memory_mb": 0}, ["compute.memory_mb", "greater than 0"]),
        ("sampler", {"method": "nuts"}, ["sampler.method"]),
        ("budget", [{"name": "b", "kind": "systemtic", "sigma_u": 1, "sigma_v": 1}], ["[1].kind"]),
        ("budget", [{"name": "b", "kind": "random", "sigma_u": -1, "sigma_v": 1}], ["sigma_u"]),
        ("prior", [{"parameter": "u_1_0", "mean": 1, "sigma": 0}], ["prior[1].sigma"]),
        ("products", {"sip": {"inverse_order": 30}}, ["products.sip.inverse_order"]),
        ("products", {"sip": True}, ["products.sip", "table"]),
        ("requirement", {"name": "r"}, ["requirement", "double brackets"]),
    ],
)
def test_a_value_that_does_not_fit(section, content, words):
    sentence = str(refusal(config_text(**{section: content})))
    for word in words:
        assert word in sentence, sentence


@pytest.mark.parametrize(
    ("tdd", "key"),
    [
        ({"epoch0": 2004.5, "terms": [["w", 1, 0]]}, "terms"),
        ({"epoch0": 2004.5, "terms": [["u", 1]]}, "terms"),
        ({"epoch0": 2004.5, "terms": [["u", 1, 0], ["u", 1, 0]]}, "terms"),
        ({"epoch0": [2004.5, 2012.5], "terms": [["u", 1, 0]]}, "epoch0"),
        ({"epoch0": 2004.5, "terms": [["u", 1, 0]], "breaks": [2012.0, 2009.4]}, "breaks"),
        ({"terms": [["u", 1, 0]]}, "epoch0"),
    ],
)
def test_time_dependence_that_makes_no_sense(tdd, key):
    sentence = str(refusal(config_text(**{"model.tdd": tdd})))
    assert f"model.tdd.{key}" in sentence


@pytest.mark.parametrize(
    ("requirement", "word"),
    [
        ({"statistic": "p59"}, "unknown statistic 'p59'"),
        ({"statistic": "u_median"}, "unknown statistic"),
        ({"limit": 0.0}, "limit"),
        ({"limit": "0.1"}, "limit"),
        ({"probability": 95}, "probability"),
        ({"unit": "px"}, "unit"),
    ],
)
def test_requirements_are_checked_when_they_are_read(tmp_path, requirement, word):
    block = [{"name": "r", "statistic": "p95", "limit": 0.1} | requirement]
    assert word in str(refusal(config_text(requirement=block)))
    none = dict.fromkeys(("data", "detector", "model", "sampler", "assess"))
    path = write_config(tmp_path / "req.toml", **none, requirement=block)
    with pytest.raises(ConfigError, match=word):
        load_requirements(path)


def test_a_requirement_file_must_hold_requirements(tmp_path):
    path = tmp_path / "req.toml"
    for text in ("", "requirement = []\n"):
        path.write_text(text)
        with pytest.raises(ConfigError, match="requirement"):
            load_requirements(path)


def test_chip_blocks_and_the_detector_exclude_each_other():
    bare = {"detector": {"name": "ACS"}, "model": {"order": 2}}
    assert len(parsed(config_text(**bare, chip=[CHIP])).chips()) == 1
    for more in (
        {"detector": {"size": [9, 9]}},
        {"model": {"order": 2, "reference_pixel": [5, 5]}},
    ):
        assert "[[chip]]" in str(refusal(config_text(**(bare | more), chip=[CHIP])))


def test_the_reference_chip_stands_first():
    bare = {"detector": None, "model": {"order": 2}}
    (chip,) = parsed(config_text(**bare, chip=[CHIP])).chips()
    assert chip.number == CHIP["number"] and chip.size == tuple(CHIP["size"])
    other = CHIP | {"number": 1, "name": "WFC1", "reference": False}
    for blocks, order in (
        ([other, CHIP], [1, 2]),  # as written, where none is the reference
        ([other, CHIP | {"reference": True}], [2, 1]),
    ):
        config = parsed(config_text(**bare, chip=blocks))
        assert [c.number for c in config.chips()] == order


def test_a_requirement_may_name_a_chip():
    block = {"name": "n", "statistic": "p95", "limit": 1.0}
    other = block | {"name": "m", "chip": 2}
    of_all, of_one = parsed(config_text(requirement=[block, other])).requirements()
    assert (of_all.chip, of_one.chip) == (None, 2)
    assert "chip" in str(refusal(config_text(requirement=[block | {"chip": "WFC2"}])))


def test_names_are_each_of_one_block():
    block = {"name": "n", "statistic": "p95", "limit": 1.0}
    assert "name 'n'" in str(refusal(config_text(requirement=[block, block])))
    term = {"name": "total", "kind": "random", "sigma_u": 0.1, "sigma_v": 0.1}
    assert "name 'total'" in str(refusal(config_text(budget=[term])))
    term["name"] = "mine"
    assert "name 'mine'" in str(refusal(config_text(budget=[term, term])))


def test_text_is_kept_as_written(tmp_path):
    text = config_text().replace("\n", "\r\n") + "# été\r\n"
    path = tmp_path / "c.toml"
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())  # as an editor on Windows writes it
    config, kept = load_config(path)
    assert kept.encode() == path.read_bytes()
    assert config == parsed(config_text())


@pytest.mark.parametrize(
    ("content", "word"),
    [(b"[data\n", "TOML"), (b"\xff\xfe\x00", "UTF-8"), (b"a = 1\na = 2\n", "TOML")],
)
def test_a_file_that_is_no_toml(tmp_path, content, word):
    path = tmp_path / "c.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=word) as caught:
        load_config(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_and_a_folder(tmp_path):
    for path, word in ((tmp_path / "none.toml", "does not exist"), (tmp_path, "is a folder")):
        with pytest.raises(InputError, match=word):
            load_config(path)


KINDS = installed_kinds()

# -- three kinds ----------------------------------------------------------------------------------

BEGINS = {
    "data": {"matches": "stars.ecsv"},
    "campaign": {"lists": "l", "catalog": "c", "exposures": "e", "initial_distortion": "i"},
    "selfcal": {"lists": "l"},
}


def of_kind(kind: str, **sections) -> str:
    """A configuration of a kind, with other sections or with changed ones."""
    own = {"data": None, kind: BEGINS[kind] | sections.pop(kind, {})}
    if kind == "campaign":
        own |= {"detector": None, "model": {"order": 2}, "chip": [CHIP]}
    return config_text(**(own | sections))


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_a_kind_is_known_by_its_section(kind):
    config = parsed(of_kind(kind))
    assert type(config) is KINDS[kind]
    others = KINDS.keys() - {kind}
    assert not any(hasattr(config, other) for other in others)
    assert config.fit.clip_chi2 == 25.0 and config.mixture() and config.resources() == Compute()
    for other in others:
        assert "give one" in str(refusal(of_kind(kind, **{other: BEGINS[other]})))


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_sections_of_another_kind_are_refused_with_its_name(kind):
    own = KINDS[kind].model_fields
    others = {name: k for k in KINDS for name in KINDS[k].model_fields if name not in own}
    assert len(others) > 3
    for name in others.keys() - KINDS.keys():
        error = refusal(of_kind(kind, **{name: {"any": 1}}))
        assert error.cause.startswith(f"unknown key '{name}': it is of [")
        assert error.cause.endswith(f"and this is a [{kind}]")
        assert error.where == f"c.toml: {name}" and error.do.startswith(("leave it out", "set"))


@pytest.mark.parametrize(("kind", "path"), [(k, path) for k in KINDS for path in KINDS[k].instead])
def test_what_to_set_in_place_of_a_key_of_another_kind(kind, path):
    section, _, key = path.partition(".")
    content = {key: {}} if key else {"any": 1}
    if section == "model":
        content |= {"order": 2}
    error = refusal(of_kind(kind, **{section: content}))
    assert error.do == KINDS[kind].instead[path]


RENAMED = {path: name for kind in KINDS.values() for path, name in kind.renamed.items()}


@pytest.mark.parametrize("path", sorted(RENAMED))
def test_an_old_key_names_the_new_one(path):
    section, _, key = path.partition(".")
    kind = section if section in KINDS else "campaign"
    block = BEGINS.get(section, {}) | {key: 1}
    error = refusal(of_kind(kind, **{section: [block] if section == "budget" else block}))
    assert f"it is called '{RENAMED[path]}' now" in error.cause
    assert error.where.endswith(key)
    assert f'"{RENAMED[path]}"' in json.dumps(KINDS[kind].model_json_schema())


def test_a_unit_of_what_has_none_is_refused():
    block = {"name": "tilt", "kind": "rotation", "sigma": 1e-6}
    error = refusal(of_kind("campaign", budget=[block | {"unit": "mas"}]))
    assert "has a fixed unit, but unit is 'mas'" in error.cause
    assert error.do == "leave out unit"


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"catalogue": {"name": "UKIDSS"}}, "no published errors are known .* Gaia DR3, Gaia EDR3"),
        (
            {
                "catalogue": {"name": "Gaia DR3"},
                "budget": [
                    {
                        "name": "Gaia",
                        "kind": "systematic",
                        "sigma_u": 1,
                        "sigma_v": 1,
                        "unit": "mas",
                    }
                ],
            },
            "states the errors of the catalogue, and so does the .*'Gaia'; leave one",
        ),
        (
            {"data": None, "catalogue": {"name": "Gaia DR3"}, "selfcal": {"lists": "l"}},
            "which a self-calibration does not use; leave it out",
        ),
    ],
)
def test_catalogues_that_cannot_be_used_are_refused(sections, message):
    with pytest.raises(ConfigError, match=message):
        parse_config(config_text(**sections), "c.toml")


def test_a_catalogue_states_errors_of_positions_and_motions():
    config = parse_config(config_text(catalogue={"name": "gaia edr3"}), "c.toml")
    assert config.states_catalogue and config.states_motions
    own = {"name": "A", "systematics_mas": 1.0, "correlation_deg": 1.0}
    config = parse_config(config_text(catalogue=own), "c.toml")
    assert config.states_catalogue and not config.states_motions
