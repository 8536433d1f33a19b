"""The documentation says what is so: pages run, links lead somewhere, nothing is left out."""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
import subprocess
import sys
import typing
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name

import click
import numpy as np
import pytest
from pydantic import BaseModel

import bayesdist as bd
from bayesdist import formats
from bayesdist.app.cli import bayesdist as root
from bayesdist.app.config import installed_kinds
from bayesdist.kinds.matches.config import data_sections
from bayesdist.missions import wise
from bayesdist.plugin import load_object

from .docs_blocks import DOCS, blocks, run_notebook, run_page
from .reduced import only_in_full
from .sketches import sketched

ROOT = DOCS.parent
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.md"))
PAGES = sorted(
    [*DOCS.glob("*.md"), *NOTEBOOKS, *ROOT.glob("[CR]*.md"), ROOT / "examples" / "README.md"]
)
# what make docs needs beyond the test extra's other packages
SITE = ("sphinx", "myst_nb", "numpydoc", "pydata_sphinx_theme", "sphinx-mathjax-offline")


@pytest.fixture(scope="module", autouse=True)
def quick_reports(full):
    """Figures of the reports of tutorials are neither made nor drawn, unless run in full."""
    with nullcontext() if full else sketched(made=False):
        yield


@pytest.fixture(scope="module")
def wise_tutorial(tmp_path_factory):
    """Folder of the WISE tutorial after it was gone through, and what its Python found."""
    folder = tmp_path_factory.mktemp("tutorial_wise")
    before = Path.cwd()
    os.chdir(folder)
    try:
        return folder, run_page(DOCS / "tutorial_wise.md")
    finally:
        os.chdir(before)


def test_the_wise_tutorial_runs_and_its_pulls_are_normal(wise_tutorial):
    """30 pulls: between 9 and 29 within one sigma but for 4e-6 of normal ones (binomial)."""
    _, namespace = wise_tutorial
    pulls = np.asarray(namespace["pulls"])
    assert pulls.size == 30 and 9 <= (abs(pulls) < 1).sum() <= 29


def test_the_page_of_the_files_describes_those_of_a_run(wise_tutorial, monkeypatch):
    folder, _ = wise_tutorial
    monkeypatch.chdir(folder)
    namespace = run_page(DOCS / "posterior_file.md")
    tree, text = namespace["tree"], (DOCS / "posterior_file.md").read_text(encoding="utf-8")
    named = set(re.findall(r"\w+", text))
    for group in tree.subtree:
        words = {*group.variables, *group.dims, *group.attrs, group.name}
        assert {w for w in words if w} <= named, group.path
    named = set(re.findall(r"\w+", (DOCS / "files.md").read_text(encoding="utf-8")))
    found = json.loads((folder / "run_w1" / "summary.json").read_text(encoding="utf-8"))
    assert _keys(found) - set(found["data"]["rejected"]) <= named


def _keys(value: object) -> set[str]:
    if isinstance(value, dict):
        return {*value, *(k for v in value.values() for k in _keys(v))}
    return {k for v in value for k in _keys(v)} if isinstance(value, list) else set()


def test_the_tutorial_in_python_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = run_page(DOCS / "tutorial_python.md")
    assert namespace["margin"].verdict == "met" and Path("w2.hdr").is_file()
    assert Path("w2-run/summary.json").is_file() and Path("w2.html").is_file()


def test_the_page_on_ground_based_cameras_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_page(DOCS / "ground_based.md")
    assert Path("tpv/tpv.head").is_file() and "sigma_x_out" in Path("with_errors.ecsv").read_text()


def test_the_page_on_positions_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = run_page(DOCS / "positions.md")
    assert namespace["cov"].shape == (6, 6)


def test_the_page_on_tables_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = run_page(DOCS / "your_table.md")
    on_sky = namespace["on_sky"]
    assert any("moved to 2024.50" in note for note in on_sky.notes)
    assert np.array_equal(namespace["found"].star, np.arange(400))


def test_the_page_on_files_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_page(DOCS / "files.md", languages={"python"})["calibration"].numbers == (1,)


def test_the_page_on_plots_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = run_page(DOCS / "plots.md")
    assert Path("plots_maps.png").is_file() and namespace["panels"].shape == (3, 3)
    listed = re.findall(r"^  \.(\w+)\(\)", repr(namespace["run"].plot), re.MULTILINE)
    shown = set(re.findall(r"run\.plot\.(\w+)\(", (DOCS / "plots.md").read_text("utf-8")))
    assert set(listed) <= shown


def test_the_quickstart_has_the_configuration_and_commands_of_the_readme():
    """Those of the README are run, see `test_the_quickstart_of_the_readme_runs`."""
    quickstart = blocks(DOCS / "quickstart.md")
    assert [b for b in quickstart if b[0] != "python"] == [
        b for b in blocks(ROOT / "README.md") if b[0] in ("toml", "console")
    ]


def test_the_page_on_wcs_runs(tmp_path, monkeypatch):
    for program in ("gwcs", "photutils", "regions", "reproject"):
        pytest.importorskip(program)
    monkeypatch.chdir(tmp_path)
    assert run_page(DOCS / "wcs.md")["wcs"].pixel_shape == (1000, 800)


@pytest.mark.parametrize("page", ["jwst.md", "roman.md"])
def test_the_pages_of_the_pipelines_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_page(DOCS / page)
    assert list(tmp_path.glob("**/*_distortion.asdf"))


@pytest.mark.slow
@only_in_full("the pages of these steps are run")
def test_the_notebook_on_sip_headers_agrees_with_the_truth(tmp_path, monkeypatch):
    """Its header errs as much as stated: the rms of error / sigma of 30 joint errors is near 1."""
    monkeypatch.chdir(tmp_path)
    namespace = run_notebook(DOCS / "notebooks" / "sextractor_to_sip.md")
    run = namespace["run"]
    assert run.converged and run.margins[0].verdict == "met" and run.warnings == ()
    assert namespace["p95"] < 0.02  # the requirement, by the truth
    assert 0.3 < np.sqrt((namespace["pulls"] ** 2).mean()) < 1.8


@pytest.mark.slow
@only_in_full("the pages of these steps are run")
def test_the_notebook_on_photutils_agrees_with_the_truth(tmp_path, monkeypatch):
    """Errors of positions and of an angle are within what their covariance and draws say."""
    for package in ("photutils", "regions", "reproject"):
        pytest.importorskip(package, reason="comes with the docs extra")
    monkeypatch.chdir(tmp_path)
    namespace = run_notebook(DOCS / "notebooks" / "photutils_to_wcs.md")
    assert 0.3 < namespace["rms_pull"] < 1.8 and abs(namespace["angle_pull"]) < 4
    assert namespace["together"] < namespace["single"]


@pytest.mark.slow
@only_in_full("make docs runs it")
def test_the_notebook_on_a_campaign_agrees_with_the_truth(tmp_path, monkeypatch):
    """The error of the non-linear distortion is as large as that of draws of the posterior."""
    monkeypatch.chdir(tmp_path)
    namespace = run_notebook(DOCS / "notebooks" / "campaign.md")
    assert namespace["run"].margins[0].verdict == "met"
    assert 0.5 * namespace["low"] < namespace["error"] < 1.5 * namespace["high"]


@pytest.mark.slow
@only_in_full("make docs runs it")
def test_the_notebook_on_releases_tells_a_change_from_none(tmp_path, monkeypatch):
    """The release misses the requirement by the truth, and the new calibration meets it."""
    monkeypatch.chdir(tmp_path)
    namespace = run_notebook(DOCS / "notebooks" / "judging_a_release.md")
    assert namespace["new_p95"] < 0.02 < namespace["old_p95"]
    assert namespace["new"].margins[0].verdict == "met"
    text = namespace["printed"]
    assert "no longer describes" in text[0] and "still describes" in text[1]
    assert "differ significantly" in text[2]


@pytest.mark.slow
def test_the_hst1pass_tutorial_runs_on_real_lists(tmp_path, monkeypatch, data_dir, full):
    if not full:
        pytest.skip("half a minute of processor time: set BAYESDIST_FULL=1")
    monkeypatch.chdir(tmp_path)
    Path("lists").symlink_to(data_dir / "hst1pass_uvis")
    run_page(DOCS / "tutorial_hst1pass.md")
    assert Path("run/report.html").is_file()


@pytest.mark.slow
def test_the_acs_tutorial_runs(tmp_path, monkeypatch, full):
    if not full:
        pytest.skip("two minutes of processor time: set BAYESDIST_FULL=1")
    monkeypatch.chdir(tmp_path)
    run_page(DOCS / "tutorial_acs.md")
    assert Path("acs-run/report.html").is_file()


def test_every_block_that_could_run_is_run():
    """Pages with blocks of console or Python are those that tests above go through."""
    run = {p.name for p in DOCS.glob("*.md") if {"console", "python"} & {b for b, _ in blocks(p)}}
    tutorials = {p.name for p in DOCS.glob("tutorial_*.md")}
    others = {"posterior_file.md", "new_instrument.md", "ground_based.md", "jwst.md", "roman.md"}
    others |= {"files.md", "plots.md", "positions.md", "wcs.md", "your_table.md"}
    others |= {"quickstart.md"}  # its configuration and commands are the README's
    assert run == tutorials | others


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        name, _, anchor = target.partition("#")
        to = (page.parent / name).resolve() if name else page
        assert to.is_file(), f"{page.name}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", to.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {_slug(h) for h in headings}, f"{page.name}: {target}"


def _slug(heading: str) -> str:
    kept = re.sub(r"[^\w\- ]", "", heading.lower().replace("`", ""))
    return kept.strip().replace(" ", "-")


def test_every_page_is_in_the_table_of_contents():
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    listed = {line.strip() for body in re.findall(r"```\{toctree\}(.*?)```", index, re.S)
              for line in body.splitlines()}  # fmt: skip
    pages = {*DOCS.glob("*.md"), *NOTEBOOKS} - {DOCS / "index.md"}
    assert {p.relative_to(DOCS).with_suffix("").as_posix() for p in pages} <= listed


def _configured(kind: type[BaseModel], section: str = "") -> set[tuple[str, str]]:
    """Section and key of all that a configuration may hold."""
    found = set()
    for key, field in kind.model_fields.items():
        inner = list(_models(field.annotation))
        path = f"{section}.{key}".strip(".")
        if inner:
            found |= {pair for m in inner for pair in _configured(m, path)}
        if section:
            found.add((section, key))
    return found


def _configured_of_any_kind() -> set[tuple[str, str]]:
    own = {pair for section in data_sections().values() for pair in _configured(section, "data")}
    return own | {pair for kind in installed_kinds().values() for pair in _configured(kind)}


def _models(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for part in typing.get_args(annotation) for m in _models(part)]


def _documented() -> tuple[set[tuple[str, str]], set[tuple[str, str]]]:
    """Section and key of all rows of the tables, and of all words in the text of these rows."""
    keys, words = set(), set()
    for name in ("configuration.md", "campaign.md", "self_calibration.md"):
        section = ""
        for line in (DOCS / name).read_text(encoding="utf-8").splitlines():
            first, _, text = line.strip().strip("|").partition("|")
            if head := re.fullmatch(r"\*\*\[{1,2}([\w.]+)\]{1,2}\*\*", first.strip()):
                section = head.group(1)
                words |= {(section, w) for w in re.findall(r"\w+", text)}
                parent, _, key = section.rpartition(".")
                keys.add((parent, key))
            elif not line.startswith("|"):
                section = ""
            elif section:
                named = [k.strip() for k in first.split(",")]
                keys |= {(section, k) for k in named}
                words |= {(f"{section}.{k}", w) for k in named for w in re.findall(r"\w+", text)}
    return keys, words


def test_every_key_of_the_configuration_is_documented_and_no_other():
    keys, words = _documented()
    configured = _configured_of_any_kind()
    assert configured - keys - words == set()
    assert {(s, k) for s, k in keys if s} - configured == set()


SECTIONS = "|".join(
    sorted(
        {
            name
            for kind in installed_kinds().values()
            for name, field in kind.model_fields.items()
            if _models(field.annotation)
        }
    )
)
KEY = re.compile(
    rf"(?<![\w./\]])({SECTIONS})\.([a-z_0-9]+(?:\.[a-z_0-9]+)*)(?: = '(\w+)')?(?![\w(])"
)


def _advice():
    """Texts of errors that say what to do: of every `do=` and every ValueError."""
    for path in sorted(Path(bd.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            said = [k.value for k in node.keywords if k.arg == "do"]
            if getattr(node.func, "id", "") == "ValueError":
                said += node.args
            for one in said:
                texts = [c.value for c in ast.walk(one) if isinstance(c, ast.Constant)]
                yield path.name, " ".join(t for t in texts if isinstance(t, str))


def test_keys_that_errors_advise_exist():
    """And the values that they advise are among those that the key may have."""
    configured = {f"{section}.{key}" for section, key in _configured_of_any_kind()}
    found = 0
    for name, text in _advice():
        for section, key, value in KEY.findall(text):
            assert f"{section}.{key}" in configured, f"{name}: {text}"
            found += 1
            if value:
                known = {
                    v for one in installed_kinds().values() for v in _values_of(one, section, key)
                }
                assert value in known, f"{name}: {text}"
    assert found > 20


def _values_of(kind: type[BaseModel], section: str, key: str) -> set[object]:
    """Words that a key of one kind of run may have; none where the kind does not have the key."""
    annotation: object = kind
    for part in (section, *key.split(".")):
        fields = next((m.model_fields for m in _models(annotation)), {})
        if part not in fields:
            return set()
        annotation = fields[part].annotation
    return _values(annotation)


def _values(annotation: object) -> set[object]:
    """Words that a key may have."""
    parts = typing.get_args(annotation)
    if typing.get_origin(annotation) is typing.Literal:
        return set(parts)
    return {value for part in parts for value in _values(part)}


def test_commands_hand_their_options_to_functions_that_take_them():
    called = 0
    for words, command in _commands(root):
        known = inspect.getclosurevars(command.callback).nonlocals
        if not known.get("calls"):
            continue
        given = [p.name for p in command.params if p.expose_value] + ["command"] * known["recorded"]
        try:
            inspect.signature(load_object(known["calls"])).bind(**dict.fromkeys(given))
        except TypeError as error:
            pytest.fail(f"{words}: {error}")
        called += 1
    assert called >= 10


def _commands(group: click.Group, path: str = ""):
    """Each command by its words, those in groups of groups too."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        words = f"{path} {name}".strip()
        if isinstance(command, click.Group):
            yield from _commands(command, words)
        else:
            yield words, command


def test_every_command_is_documented_with_its_options():
    text = (DOCS / "commands.md").read_text(encoding="utf-8")
    everywhere = "\n".join(p.read_text(encoding="utf-8") for p in DOCS.glob("*.md"))
    for words, command in _commands(root):
        assert f"bayesdist {words} " in text, words
        assert command.help, words
        for option in (one for one in command.params if isinstance(one, click.Option)):
            name = max(option.opts, key=len)
            if name not in ("--quiet", "--output"):
                assert name in everywhere, f"{words} {name}"


@pytest.mark.parametrize("page", [DOCS / "architecture.md", ROOT / "CONTRIBUTING.md"], ids=str)
def test_names_and_files_of_the_code_are_there(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`(bayesdist(?:\.\w+)+)`", text):
        assert resolve_name(name), name
    for name in re.findall(r"`((?:bayesdist|docs|tests)/[\w./]+)`", text):
        assert "NAME" in name or (ROOT / name).exists(), name


def test_the_reference_names_all_that_is_public():
    api = (DOCS / "api.md").read_text(encoding="utf-8")
    names = re.findall(r"^   ~(bayesdist[\w.]+)$", api, re.MULTILINE)
    listed = {n.rpartition(".")[2] for n in names}
    for module, _, name in (n.rpartition(".") for n in names):
        assert hasattr(import_module(module), name), f"{module} does not offer {name}"
    public = {*bd.__all__, *formats.__all__, *wise.__all__}
    assert listed == public - {"__version__", "PLUGIN"}
    modules = re.findall(r"^   (bayesdist[\w.]+)$", api, re.MULTILINE)
    assert {p.stem for p in (DOCS / "api").glob("*.md")} == set(modules)
    for name in modules:
        module = import_module(name)
        for offered in getattr(module, "__all__", ()):
            member = getattr(module, offered)
            assert not callable(member) or member.__doc__, f"{name}.{offered}"


@pytest.mark.slow
def test_the_site_is_built_without_warnings_and_needs_no_network(tmp_path, full):
    if not full:
        pytest.skip("half a minute; `make docs` builds it, too: set BAYESDIST_FULL=1")
    for package in SITE:
        pytest.importorskip(package, reason=f"{package} is not installed: pip install '.[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *"-q -W --keep-going -n".split(),
         "-d", tmp_path / "doctrees", DOCS, tmp_path / "site"],
        capture_output=True, text=True, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    built = {p.relative_to(tmp_path / "site").with_suffix(".md") for p in
             (tmp_path / "site").rglob("*.html")}  # fmt: skip
    assert {p.relative_to(DOCS) for p in DOCS.rglob("*.md")} <= built
    for page in (tmp_path / "site").rglob("*.html"):
        loaded = re.findall(
            r"<(?:script|link|img)\b[^>]*?(?:src|href)=\"(https?:[^\"]*)", page.read_text()
        )
        assert not loaded, f"{page.name} loads {loaded}"
