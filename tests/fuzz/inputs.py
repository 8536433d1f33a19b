"""Small inputs of every kind, written into a folder, and the commands that read them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from astropy.table import Table

from bayesdist.formats.lookup.tables import write_d2im
from bayesdist.missions.wise.simulate.bringup import simulate_unpaired
from bayesdist.products import registry
from tests.app.rvb_jobs import rvb_job, rvb_pairs, write_rvb_table
from tests.app.support import as_table, good, simulated, write_config, write_job
from tests.formats.test_ast import gbdes_table
from tests.formats.test_formats import OPTIONS, SETTINGS, SIZES, calibration_for
from tests.formats.test_hst1pass import LIST
from tests.formats.test_lookup_files import table as lookup_table
from tests.fuzz.settings import CAMPAIGN, MATCHED, REQUIREMENTS
from tests.kinds.matches import layouts
from tests.kinds.selfcal.patterns.test_command import SMALL
from tests.kinds.selfcal.runs.support import commanded, list_table, small, write_selfcal
from tests.missions.wise.test_bringup import write_lists
from tests.sketches import sketched

HERE = "@"  # the copy of the folder, in the arguments of a command
FORMS = {
    **dict.fromkeys((".ecsv", ".csv", ".tsv", ".tbl", ".txt", ".cat", ".als", ".dat"), "rows"),
    **dict.fromkeys((".uvMXY", ".XYMEEE"), "rows"),
    **dict.fromkeys((".nc", ".h5"), "hdf5"),
    ".fits": "fits",
    ".gz": "gz",
    ".parquet": "parquet",
    ".toml": "toml",
    ".json": "json",
    ".asdf": "asdf",
}


@dataclass(frozen=True)
class Input:
    """A file of a folder, and commands that read it.

    Parameters
    ----------
    name : str
    kind : str
        Row of the table of counts.
    folder : Path
        Copied for each case.
    file : str
        What is damaged, relative to the folder.
    commands : dict of str to list of str
        Arguments, in which HERE is the copy.
    outputs : tuple of str
        Files that are part of the answer.
    """

    name: str
    kind: str
    folder: Path
    file: str
    commands: dict[str, list[str]]
    outputs: tuple[str, ...] = field(default=("out.csv", "new.toml"))

    @property
    def path(self) -> Path:
        return self.folder / self.file

    @property
    def form(self) -> str:
        content = self.path.read_bytes()
        if content.startswith(b"SIMPLE  ="):
            return "fits"
        name = self.path.name
        if self.kind == "products" and name.endswith(".txt"):
            return "text"
        return FORMS.get(self.path.suffix, "text")


def inputs(folder: Path, *, begun: bool = True) -> list[Input]:
    """All inputs, written into a new folder; runs that have `begun` take seconds to make."""
    with sketched(made=False):
        run = _run(folder / "finished")
        found = [
            *_stars(folder / "stars", run),
            *_star_lists(folder / "lists"),
            *_settings(folder / "settings", run),
            *_of_wise(folder / "wise"),
            *_products(folder / "products"),
            *_foreign_products(folder / "foreign"),
            *_of_run(run, folder),
            *(_begun_runs(folder / "begun") if begun else ()),
        ]
    names = [one.name for one in found]
    assert len(set(names)) == len(names)
    return found


# -- tables of stars ------------------------------------------------------------------------------

CHECK = {"check": ["check", "@/config.toml"]}


def _stars(folder: Path, run: Path) -> Iterator[Input]:
    stars = layouts.field_of(n=60)
    for layout in layouts.LAYOUTS:
        here = folder / layout.name
        here.mkdir(parents=True)
        layout.write(stars, here / layout.name)
        options = list(layout.options)
        good("init", here / "config.toml", "--matches", here / layout.name, *options)
        init = ["init", "@/new.toml", "--matches", f"@/{layout.name}", *options]
        yield Input(layout.name, "stars", here, layout.name, {"init": init, **CHECK})
    matches, _ = simulated(120, seed=7, mag=np.linspace(12.0, 18.0, 120))
    for end in ("ecsv", "csv", "tsv", "fits", "fits.gz", "parquet", "vot"):
        here, name = folder / f"simulated-{end}", f"stars.{end}"
        write_job(here)
        (here / "stars.ecsv").unlink()
        kind = {"csv": "ascii.csv", "tsv": "ascii.tab", "vot": "votable"}.get(end)
        table = as_table(matches)
        table.write(here / name, **({"format": kind} if kind else {}))
        data = {"matches": name} | ({} if end not in ("csv", "tsv") else {"unit": "pix"})
        write_config(here / "config.toml", data=data, detector={"name": "A", "size": (1000, 800)})
        commands = CHECK | {
            "init": ["init", "@/new.toml", "--matches", f"@/{name}"],
            "apply": ["apply", str(run / "sip.hdr"), f"@/{name}", "-o", "@/out.csv", "--chip", "1"],
            "select-order": ["select-order", "@/config.toml", "--orders", "1", "2"],
            "fit": ["stage", "fit", "@", "-q"],
        }
        if "unit" not in data:  # monitor takes it from the table
            commands["monitor"] = ["monitor", str(run), f"@/{name}"]
        yield Input(name, "stars", here, name, commands)
    here = folder / "hst1pass"
    here.mkdir()
    (here / "a.uvMXY").write_text(LIST.format(name="a.uvMXY") + _hst1pass_rows(matches))
    write_config(here / "config.toml", data={"matches": "a.uvMXY", "sigma": 0.02})
    yield Input("a.uvMXY", "stars", here, "a.uvMXY", CHECK)
    for suffix in (".tbl", ".parquet"):
        here = folder / f"rvb{suffix}"
        rvb_job(here, rvb_pairs(150), suffix)
        name = f"pairs{suffix}"
        shift = ["wise", "rvb", "transform", f"@/{name}", "-o", "@/out", "--dx", "1"]
        yield Input(f"rvb-{name}", "stars", here, name, CHECK | {"rvb": shift})


def _hst1pass_rows(matches) -> str:
    rows = zip(matches.u, matches.v, matches.mag - 25, matches.x, matches.y, strict=True)
    return "".join(f"{u:10.4f}{v:10.4f}{m:8.3f}{x:10.4f}{y:10.4f}\n" for u, v, m, x, y in rows)


def _star_lists(folder: Path) -> Iterator[Input]:
    """Campaign and self-calibration: lists, catalogue, log, pointing, initial distortion."""
    here = folder / "campaign"
    _simulated_campaign(here)
    commands = {"check": ["check", "@/campaign_f606w.toml"]}
    for name in ("exposures.ecsv", "catalog.parquet", "start_idc.fits", "lists/f606w-002.parquet"):
        yield Input(f"campaign-{Path(name).name}", "star lists", here, name, commands)
    field_ = small()
    here = folder / "selfcal"
    write_selfcal(here, list_table(field_), gauge={"offsets": "commanded.ecsv"})
    commanded(field_, 1.0, np.random.default_rng(1)).write(here / "commanded.ecsv")
    for name in ("lists.ecsv", "commanded.ecsv"):
        yield Input(f"selfcal-{name}", "star lists", here, name, CHECK)


def _simulated_campaign(folder: Path) -> None:
    good("simulate", "acs", "-o", folder, "--exposures", 6, "--stars", 1500, "--seed", 3, "-q",
         "--no-tables")  # fmt: skip
    shutil.rmtree(folder / "truth")
    for name in ("catalog_early.parquet", "catalog_late.parquet"):
        (folder / name).unlink()


def _of_wise(folder: Path) -> Iterator[Input]:
    """Solutions of frames beside their pairs, and lists that nobody has paired."""
    here = folder / "solutions"
    pairs = rvb_pairs(150)
    frames = sorted(set(pairs["frame"]))
    shifts = {name: np.full(len(frames), 1e-3) for name in ("shift_u", "shift_v", "rotation")}
    for name, file in (("from", {"frame": frames} | shifts), ("to", {"frame": frames} | shifts)):
        write_rvb_table(Table(file), here / f"{name}.tbl")
    write_rvb_table(pairs, here / "pairs.parquet")
    line = ["wise", "rvb", "rereference", "@/pairs.parquet", "--from", "@/from.tbl", "--to",
            "@/to.tbl", "-o", "@/out", "--band", "W4"]  # fmt: skip
    yield Input("solutions.tbl", "star lists", here, "from.tbl", {"rereference": line})
    here = folder / "unpaired"
    here.mkdir()
    write_lists(simulate_unpaired(2, rng=np.random.default_rng(8), density=2e-4), here)
    line = ["wise", "bring-up", "@/detections.ecsv", "@/reference.ecsv", "-o", "@/out", "--band",
            "W2", "--optical", "@/optical.hdr", "--order", "2"]  # fmt: skip
    for name in ("detections.ecsv", "optical.hdr"):
        yield Input(f"bring-up-{name}", "star lists", here, name, {"bring-up": line})


# -- configurations -------------------------------------------------------------------------------


def _settings(folder: Path, run: Path) -> Iterator[Input]:
    here = folder / "matched"
    matches, _ = simulated(150, seed=7, mag=np.linspace(12.0, 18.0, 150))
    write_job(here, as_table(matches))
    (here / "config.toml").write_text(MATCHED, encoding="utf-8")
    fit = {"fit": ["stage", "fit", "@", "-q"]}
    yield Input("matched.toml", "configurations", here, "config.toml", CHECK | fit)
    here = folder / "rvb"
    rvb_job(here, rvb_pairs(150))
    yield Input("rvb.toml", "configurations", here, "config.toml", CHECK)
    here = folder / "selfcal"
    write_selfcal(here, list_table(small()), products={"sip": {}})
    yield Input("selfcal.toml", "configurations", here, "config.toml", CHECK)
    here = folder.parent / "lists" / "campaign"
    (here / "config.toml").write_text(CAMPAIGN, encoding="utf-8")
    yield Input("campaign.toml", "configurations", here, "config.toml", CHECK)
    here = folder / "others"
    here.mkdir()
    (here / "patterns.toml").write_text(SMALL, encoding="utf-8")
    (here / "requirements.toml").write_text(REQUIREMENTS, encoding="utf-8")
    plan = {"plan-dither": ["plan-dither", "@/patterns.toml"]}
    yield Input("patterns.toml", "configurations", here, "patterns.toml", plan)
    judge = {"requirements": ["requirements", str(run), "--requirements", "@/requirements.toml"]}
    yield Input("requirements.toml", "configurations", here, "requirements.toml", judge)


# -- products -------------------------------------------------------------------------------------


def _products(folder: Path) -> Iterator[Input]:
    for key, settings in SETTINGS.items():
        here = folder / key
        here.mkdir(parents=True)
        made = registry.product_settings()[key](**settings)
        files = registry.build(key, calibration_for(key), made, OPTIONS)
        for one in files:
            (here / one.file_name).write_bytes(one.content)
        main = files[-1].file_name
        (here / "whole").mkdir()
        for one in files:
            shutil.copy(here / one.file_name, here / "whole" / one.file_name)
        (here / "stars.csv").write_text("x,y\n500,400\n600,500\n7,9\n")
        states_size = key in SIZES or "size" not in registry.format_of(key).asks
        size = [] if states_size else ["--size", "1200", "900"]
        commands = {
            "inspect": ["inspect", f"@/{main}"],
            "compare": ["compare", f"@/{main}", f"@/whole/{main}", *size, "--grid", "9", "9"],
            "apply": ["apply", f"@/{main}", "@/stars.csv", "-o", "@/out.csv", *size],
            "convert": ["convert", f"@/{main}", "--to", "parameters", "-o", "@/converted", *size],
        }
        if key in ("sip", "wise_meta"):
            commands["rotate"] = ["wise", "rotate", f"@/{main}", "-o", "@/out.txt"]
        if key == "idctab":
            commands["pam"] = ["hst", "pam", f"@/{main}", "-o", "@/pam.fits"]
            commands["handbook"] = ["hst", "handbook", f"@/{main}", "-o", "@/out"]
        for one in files:
            yield Input(f"{key}-{one.file_name}", "products", here, one.file_name, commands)


def _foreign_products(folder: Path) -> Iterator[Input]:
    """Parameters of gbdes, which we read and do not write, and a table of D2IM."""
    folder.mkdir()
    parameters, *_ = gbdes_table()
    for name in ("gbdes.parquet", "gbdes.ecsv"):
        here = folder / name.replace(".", "-")
        (here / "whole").mkdir(parents=True)
        for path in (here / name, here / "whole" / name):
            parameters.write(path)
        size = ["--size", "4000", "4072"]
        commands = {
            "inspect": ["inspect", f"@/{name}"],
            "compare": ["compare", f"@/{name}", f"@/whole/{name}", *size, "--grid", "9", "9"],
            "convert": ["convert", f"@/{name}", "--to", "tpv", "-o", "@/converted", *size],
        }
        yield Input(name, "products", here, name, commands)
    here = folder / "d2im"
    here.mkdir()
    given = [lookup_table(chip, np.random.default_rng(chip), shape=(6, 8)) for chip in (1, 2)]
    write_d2im(given, here / "a_d2i.fits")
    inspect = {"inspect": ["inspect", "@/a_d2i.fits"]}
    yield Input("a_d2i.fits", "products", here, "a_d2i.fits", inspect)


# -- a run ----------------------------------------------------------------------------------------


def _run(folder: Path) -> Path:
    """A finished run, with its report."""
    matches, _ = simulated(200, mag=np.linspace(12.0, 18.0, 200))
    config = write_job(
        folder / "input",
        as_table(matches),
        detector={"name": "A", "size": (1000, 800), "scale_mas": 50.0},
        requirement=[{"name": "loose", "statistic": "p95", "limit": 1.0, "unit": "pix",
                      "probability": 0.95}],
        products={"sip": {"inverse_order": 4}},
    )  # fmt: skip
    good("run", config, "-o", folder / "run", "-q")
    return folder / "run"


def _of_run(run: Path, folder: Path) -> Iterator[Input]:
    config = str(run.parent / "input" / "config.toml")
    here = folder / "run"
    shutil.copytree(run, here / "run")
    (here / "requirements.toml").write_text(REQUIREMENTS, encoding="utf-8")
    (here / "stars.csv").write_text("x,y\n500,400\n600,500\n7,9\n")
    new, _ = simulated(100, seed=99, mag=np.linspace(12.0, 18.0, 100))
    as_table(new).write(here / "new.ecsv")
    commands = {
        "resume": ["run", config, "-o", "@/run", "--resume", "-q"],
        "inspect": ["inspect", "@/run"],
        "budget": ["budget", "@/run", "--at", "100", "200", "--to", "300", "400"],
        "requirements": ["requirements", "@/run", "--requirements", "@/requirements.toml"],
        "plan": ["plan", "@/run"],
        "compare": ["compare", "@/run", str(run), "--grid", "9", "9"],
        "monitor": ["monitor", "@/run", "@/new.ecsv"],
        "apply": ["apply", "@/run", "@/stars.csv", "-o", "@/out.csv"],
        "convert": ["convert", "@/run", "--to", "tpv", "-o", "@/converted"],
        "overview": ["report", "@/run", str(run), "-o", "@/all.html"],
        "report": ["stage", "report", "@/run", "-q"],
        "evaluate": ["stage", "evaluate", "@/run", "-q"],
        "export": ["stage", "export", "@/run", "-q"],
    }
    names = ("run.json", "summary.json", "config.toml", "posterior.nc", "fit.nc", "diagnostics.h5",
             "evaluation.h5", "budget.ecsv", "margins.ecsv", "coefficients.ecsv",
             "maps.fits", "sip.hdr", "chain-1-*.h5")  # fmt: skip
    for name in names:
        for path in sorted((here / "run").glob(name))[:1]:
            yield Input(f"run-{path.name}", "run folders", here, f"run/{path.name}", commands)
    alone = {
        "compare": ["compare", "@/run/posterior.nc", str(run), "--grid", "9", "9"],
        "inspect": ["inspect", "@/run/posterior.nc"],
    }
    yield Input("posterior.nc", "run folders", here, "run/posterior.nc", alone)


def _begun_runs(folder: Path) -> Iterator[Input]:
    """A self-calibration and a campaign that are fitted, and a band of WISE that is diagnosed."""
    here = _begun(folder / "selfcal", "match", "fit")
    commands = {
        "fit": ["stage", "fit", "@/run", "-q"],
        "match": ["stage", "match", "@/run", "-q"],
    }
    for name in ("run.json", "detections.h5", "solution.h5", "fit.nc", "gauge.ecsv",
                 "matching.ecsv", "fit.h5"):  # fmt: skip
        yield Input(f"begun-selfcal-{name}", "run folders", here, f"run/{name}", commands)
    here = _begun(folder / "campaign", "match", "fit")
    for name in ("run.json", "pairs/part-00000.parquet", "fit.h5", "fit.nc",
                 "matching.ecsv"):  # fmt: skip
        label = Path(name).name
        yield Input(f"begun-campaign-{label}", "run folders", here, f"run/{name}", commands)
    here = _begun(folder / "band", "fit", "sample", "diagnose")
    line = ["wise", "bands", "@/run", "-o", "@/out", "--no-published", "--bins", "6"]
    for name in ("run.json", "posterior.nc", "fit.nc", "stars/part-00000.parquet"):
        label = Path(name).name
        yield Input(f"band-{label}", "run folders", here, f"run/{name}", {"bands": line})


def _begun(folder: Path, *stages: str) -> Path:
    """A folder with input of the kind that it is named for, and a run of some stages."""
    given, run = folder / "input", folder / "run"
    if folder.name == "selfcal":
        write_selfcal(given, list_table(small()), products={"sip": {}})
    elif folder.name == "campaign":
        _simulated_campaign(given)
        (given / "config.toml").write_text(CAMPAIGN, encoding="utf-8")
    else:
        rvb_job(given, rvb_pairs(150))
    text = (given / "config.toml").read_text(encoding="utf-8")
    for path in given.iterdir():
        text = text.replace(f'"{path.name}"', f'"../input/{path.name}"')
    if folder.name == "band":
        text = text.replace("[detector]", "[detector]\nscale_mas = 5500.0")
    run.mkdir()
    (run / "config.toml").write_text(text, encoding="utf-8")
    for stage in stages:
        good("stage", stage, run, "-q")
    return folder
