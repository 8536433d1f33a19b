"""What files differ by from the solution, against astropy.wcs and the model itself."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from bayesdist.app.evaluating import _Laid, product_terms
from bayesdist.app.products import ProductInput, made_files, product_of_run
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.calibration.calibration import calibration_of
from bayesdist.calibration.plane import Plane
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.format import sip_positions
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.missions.wise.meta_data.meta import read_wise_meta, write_wise_meta
from bayesdist.model import Chip, DistortionModel
from bayesdist.products.common.document import BuildOptions
from bayesdist.products.registry import product_settings
from tests.app.support import good, summary_of, write_job
from tests.formats.support import random_pixels, some_solution
from tests.reduced import only_in_full

SIZE, GRID, REFERENCE = (512, 256), (9, 5), (256.0, 128.0)
DRIFT = 2e-5
FILES_OF_OTHERS = ("tpv.head", "ast.txt", "cpdis.fits")

BUDGET = [
    {"name": "catalogue", "kind": "random", "sigma_u": 0.004, "sigma_v": 0.004,
     "source": "a letter"},
    {"name": "guiding", "kind": "systematic", "sigma_u": 0.001, "sigma_v": 0.001,
     "source": "Published: a handbook, Table 2"},
]  # fmt: skip
# pixels of the handbook's size: an IDCTAB counts in arcseconds
DETECTOR = {"name": "chip", "size": SIZE, "scale_mas": 50.0}
CONFIG = {
    "data": {"matches": "stars.ecsv", "unit": "pix"},
    "model": {"order": 3, "reference_pixel": REFERENCE},
    "model.tdd": {"epoch0": 2008.0, "terms": [["u", 1, 0], ["v", 1, 0]]},
    "sampler": {"target_ess": 100},
    "assess": {"epoch": 2008.0, "grid": GRID, "draws": 400},
    "products": {
        "sip": {"inverse_order": 2},
        "idctab": {"instrument": "ACS", "detector": "WFC"},
    },
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("products")
    rng = np.random.default_rng(1)
    epoch = np.repeat(np.linspace(2004.0, 2012.0, 4), 200)
    x, y = rng.uniform(1, SIZE[0], epoch.size), rng.uniform(1, SIZE[1], epoch.size)
    dx, dy = x - REFERENCE[0], y - REFERENCE[1]
    drift = DRIFT * (epoch - 2008.0) * dx
    u = dx + 4e-5 * dx**2 - 3e-5 * dx * dy + drift + 0.02 * rng.standard_normal(x.size)
    v = dy + 5e-5 * dy**2 + 6e-8 * dx**3 - drift + 0.02 * rng.standard_normal(x.size)
    columns = {"x": x, "y": y, "u": u, "v": v, "epoch": epoch}
    for name in ("sigma_u", "sigma_v"):
        columns[name] = np.full(x.size, 0.02)
    config = write_job(folder, Table(columns), detector=DETECTOR, budget=BUDGET, **CONFIG)
    good("run", config, "-o", folder / "run", "-q")
    return folder / "run"


@pytest.fixture(scope="module")
def results(run):
    with Run.of(RunDirectory.open(run)) as found:
        yield found


def product_of(solution, **what):
    """Ingredients of the files of a solution that no run has made."""
    return ProductInput(solution, calibration_of(solution, "made up", **what), BuildOptions())


def rows_of(run):
    return {row["name"]: row for row in summary_of(run)["budget"]}


def test_the_inverse_row_is_what_astropy_leaves(run):
    header = fits.Header.fromtextfile(run / "sip.hdr")
    wcs = WCS(header)
    x, y = (
        a.ravel()
        for a in np.meshgrid(*(np.linspace(1, n, k) for n, k in zip(SIZE, GRID, strict=True)))
    )
    pixel = np.column_stack([x, y])
    back = wcs.sip_foc2pix(wcs.sip_pix2foc(pixel, 1), 1)
    missed = np.sqrt(np.mean(np.sum((back - pixel) ** 2, axis=1)))
    row = rows_of(run)["sip.hdr, inverse"]
    assert missed > 1e-3  # an inverse of order 2 of a distortion of order 3
    # pixels are those of u, v but for a distortion of some per cent
    assert row["radial"] == pytest.approx(missed, rel=0.05)
    [sip] = [p for p in summary_of(run)["products"] if p["path"] == "sip.hdr"]
    assert sip["inverse_rms"] == row["radial"] <= sip["closure_pix"]


def test_forward_it_is_exact_at_its_own_date_and_lacks_the_drift_at_others(run, results):
    row = rows_of(run)["sip.hdr, forward"]
    assert row["radial"] < 1e-10
    terms = product_terms(product_of_run(results), results.config, results.base)
    [term] = [t for t in terms if t.row.name == "sip.hdr, forward"]
    x, y = np.array([1.0, 300.0, 512.0]), np.array([200.0, 7.0, 256.0])
    solution = results.solution
    at = [solution.model.predict(solution.mean, x, y, epoch=t) for t in (2008.0, 2016.5)]
    np.testing.assert_allclose(term.shift(x, y, 1, 2016.5), at[0] - at[1], atol=1e-10)
    assert np.abs(at[0] - at[1]).max() > 0.02
    text = good("budget", run, "--at", 512, 256, "--epoch", 2016.5).out
    assert "sip.hdr, forward" in text and "in no total" in text


def test_an_idctab_holds_the_drift_too(run):
    row = rows_of(run)["acs_wfc_idc.fits, forward"]
    assert row["kind"] == "product" and row["radial"] < 1e-9
    assert "acs_wfc_idc.fits, inverse" not in rows_of(run)  # it has no INVERSE rows


def test_products_say_what_the_total_is_with_them(run):
    found, total = summary_of(run), rows_of(run)["total"]["radial"]
    for product in found["products"]:
        if product["path"].endswith("_parameters.fits"):
            continue
        assert product["total_rms"] == pytest.approx(np.hypot(total, product["forward_rms"]))


def test_every_row_says_where_it_is_from(run):
    rows = rows_of(run)
    assert rows["catalogue"]["source"] == "given by the user: a letter"
    assert rows["guiding"]["source"] == "published: a handbook, Table 2"
    kinds = ("measured in this run", "given by the user", "published")
    for name, row in rows.items():
        assert name == "total" or row["source"].startswith(kinds), row
    assert rows["total"]["source"]
    table = Table.read(run / "budget.ecsv")
    assert [str(s) for s in table["source"]] == [r["source"] for r in rows.values()]
    report = (run / "report.html").read_text(encoding="utf-8")
    for row in rows.values():
        assert row["source"] in report


def test_axes_and_size_of_a_file_are_its_own_and_a_wave_is_not():
    """A field turned, mirrored, shifted and counted in other pixels; with a wave added."""
    chips = tuple(Chip(k, f"C{k}", (256.0, 128.0), (128.0, 64.0)) for k in (1, 2))
    model = DistortionModel(1, chips)
    mean = np.zeros(model.n_params)
    for chip in chips:
        for axis, k, half in ((0, (1, 0), 128.0), (1, (0, 1), 64.0)):
            at = model.basis(chip.number).terms.index(k)
            mean[model.coefficient_slice(chip.number, axis)][at] = half
    solution = SimpleNamespace(model=model, mean=mean, tangent_point=None)
    product = product_of(solution)

    def wave(x, y, chip, epoch):
        return 0.01 * np.sin(np.stack([x, y], axis=-1) * 2 * np.pi / 32 + chip)

    def other(x, y, chip, epoch):
        u = model.predict(mean, x, y, chip=chip) + wave(x, y, chip, epoch)
        z = 0.05 * np.exp(0.3j) * (u @ [1, -1j]) + 7 - 3j  # -1j: mirrored
        return np.stack([z.real, z.imag], axis=-1)

    found = _Laid(product, other, scaled=True)
    x, y = np.random.default_rng(1).uniform(1, 128, (2, 50))
    for chip in (1, 2):
        # shift, turn and scale take up what they can of a wave: next to nothing
        np.testing.assert_allclose(found(x, y, chip, None), wave(x, y, chip, None), atol=1e-3)


def test_digits_of_wise_entries_are_what_is_left(tmp_path):
    """Seven digits, and nothing said of scale and zero point: those of the header hold."""
    side = 1016.0
    chip = Chip(1, "W1", (side, side), (508.5, 508.5))
    model = DistortionModel(2, (chip,), unit="arcsec")
    basis = model.basis(1)
    rng = np.random.default_rng(5)
    monomial = np.zeros((2, model.n_terms))
    monomial[:, 1:3] = 2.757 * (np.eye(2) + 1e-3 * rng.standard_normal((2, 2)))
    monomial[:, 3:] = 1e-6 * rng.standard_normal((2, 3))
    monomial[:, 0] = 0.3, -0.2
    mean = basis.from_monomials(monomial).ravel()
    solution = GaussianSolution(model, mean, 1e-12 * np.eye(len(mean)))
    header = sip_from_solution(solution, linear="sip", inverse_order=2)
    write_wise_meta(tmp_path / "w1.meta", {1: header})
    [band] = read_wise_meta(tmp_path / "w1.meta")
    x, y = rng.uniform(1, side, (2, 300))
    options = {"unit": "arcsec", "scale_arcsec": None}
    true = model.predict(mean, x, y)
    exact = sip_positions(header, x, y, **options)
    np.testing.assert_allclose(exact, true, atol=1e-9)
    printed = sip_positions(band.sip, x, y, like=header, **options)
    # half a unit of the seventh digit of each coefficient, times its power of the offset
    lever = np.stack([np.abs(x - 508.5) ** i * np.abs(y - 508.5) ** j for i, j in basis.terms])
    for axis, terms in enumerate((header.a, header.b)):
        half = [5e-7 * 10 ** np.floor(np.log10(abs(terms[k]))) for k in basis.terms]
        bound = np.hypot(*header.cd[axis]) * 3600 * (half @ lever)
        off = np.abs(printed - true)[:, axis]
        assert (off <= bound + 1e-9).all()
        assert off.max() > 10 * np.abs(exact - true).max()  # the digits show


def test_files_that_others_read_are_measured_as_others_read_them():
    """A TPV header and an AST mapping to rounding; tables by what lies between their nodes."""
    solution = some_solution(3, unit="arcsec", pixel=0.26, angle=0.4, flip=True)
    product = product_of(solution, plane=Plane("sky", point=(150.1, 2.2)))
    known = product_settings()
    asked = {"tpv": known["tpv"](), "ast": known["ast"](), "cpdis": known["cpdis"](step=64.0)}
    products = SimpleNamespace(release=None, asked=lambda: asked)
    terms = product_terms(product, SimpleNamespace(products=products), None)
    assert {t.row.name for t in terms} == {f"{n}, forward" for n in FILES_OF_OTHERS}
    x, y = random_pixels((1200.0, 900.0), 5000)
    off = {
        t.row.name.split(",")[0]: np.hypot(*t.shift(x, y, 1, None).T).max() / 0.26 for t in terms
    }
    assert off["tpv.head"] < 1e-7 and off["ast.txt"] < 1e-7
    [built] = made_files(product, SimpleNamespace(products=products))["cpdis"]
    assert 0.3 * built.summary["tables_pix"] < off["cpdis.fits"] < 1.1 * built.summary["tables_pix"]


PLACED = {
    "useafter": "2022-07-01T00:00:00", "pedigree": "GROUND", "author": "nobody",
    "v2ref": -453.4, "v3ref": -373.8, "v3idlyangle": 4.8,
}  # fmt: skip


@pytest.mark.slow
@only_in_full("the inverse row of one file is run")
@pytest.mark.parametrize(
    ("key", "settings", "size"),
    [
        ("jwst", {**PLACED, "instrument": "MIRI", "detector": "MIRIMAGE"}, (1032.0, 1024.0)),
        ("roman", {**PLACED, "detector": "WFI04", "optical_element": "F158"}, (4088.0, 4088.0)),
        ("siaf", {"aperture": "MADE_UP"}, (1200.0, 900.0)),
    ],
)
def test_files_of_pipelines_are_right_forward_and_miss_by_their_inverse(key, settings, size):
    """Forward to rounding, along axes of their own; back as far as the file states."""
    reference = ((size[0] + 1) / 2, (size[1] + 1) / 2)
    solution = some_solution(4, unit="arcsec", pixel=0.11, size=size, reference_pixel=reference)
    product = product_of(solution)
    asked = {key: product_settings()[key](**settings)}
    config = SimpleNamespace(products=SimpleNamespace(release=None, asked=lambda: asked))
    forward, inverse = product_terms(product, config, None)
    *_, built = made_files(product, config)[key]
    assert [forward.row.name, inverse.row.name] == [
        f"{built.file_name}, forward", f"{built.file_name}, inverse"
    ]  # fmt: skip
    x, y = random_pixels(size, 5000)
    there, back = (np.hypot(*one.shift(x, y, 1, None).T).max() / 0.11 for one in (forward, inverse))
    assert there < 1e-7
    stated = built.summary["closure_pix"]
    assert 0.3 * stated < back < 1.2 * stated
