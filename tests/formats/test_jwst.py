"""JWST's distortion reference files: stdatamodels, gwcs and jwst read ours, and we read others'."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy.modeling import models
from numpy.testing import assert_allclose

from bayesdist.calibration.calibration import calibration_of
from bayesdist.calibration.plane import Plane
from bayesdist.errors import FormatError, InputError
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.products import registry
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import Choice
from bayesdist.products.common.record import calibration_from

from .support import StandIn, some_covariance
from .v2v3 import (
    ANGLE,
    V2REF,
    V3REF,
    files,
    imager,
    largest_distance,
    read,
    same_calibration,
    some_pixels,
    tree_of,
    v2v3_of,
    with_tables,
    with_tree,
)

SIZE, PIXEL = (2048.0, 2048.0), 0.0656
SETTINGS = {
    "instrument": "NIRISS", "detector": "NIS", "filter": "CLEAR", "pupil": "F200W",
    "useafter": "2022-07-01T00:00:00", "pedigree": "INFLIGHT 2022-05-01 2022-06-01",
    "author": "nobody", "v2ref": V2REF, "v3ref": V3REF, "v3idlyangle": ANGLE, "inverse_order": 7,
}  # fmt: skip
LIMIT = 1e-6  # pixels


@pytest.fixture(scope="module")
def plain():
    """A calibration and its file."""
    calibration = imager(SIZE, PIXEL)
    [built] = files("jwst", calibration, SETTINGS)
    return calibration, built


@pytest.fixture(scope="module")
def tabulated():
    """A calibration with tables of detector and filter, and its file."""
    calibration = replace(with_tables(imager(SIZE, PIXEL), "", "F200W"), filter="F200W")
    [built] = files("jwst", calibration, SETTINGS)
    return calibration, built


# -- read back ------------------------------------------------------------------------------------


def test_a_file_that_was_read_is_built_again_without_its_position(plain):
    calibration, built = plain
    settings = {k: v for k, v in SETTINGS.items() if k not in ("v2ref", "v3ref", "v3idlyangle")}
    [again] = files("jwst", read(built).calibration(), settings)
    same_calibration(calibration, read(again).calibration())
    with pytest.raises(InputError, match="v2ref and v3ref and v3idlyangle of"):
        files("jwst", calibration, settings)


@pytest.mark.parametrize("unit", ["pix", "mas", "deg"])
def test_other_units_are_written_in_arcsec(unit):
    pixel = {"pix": 1.0, "mas": 1e3 * PIXEL, "deg": PIXEL / 3600}[unit]
    calibration = imager(SIZE, pixel, order=3, unit=unit)
    [built] = files("jwst", calibration, SETTINGS, scale_arcsec=PIXEL)
    x, y = some_pixels(calibration)
    theirs = read(built).calibration()
    assert_allclose(
        theirs.forward(x, y, chip=1) / PIXEL, calibration.forward(x, y, chip=1) / pixel, atol=1e-9
    )
    assert_allclose(theirs.solution.cov / PIXEL**2, calibration.solution.cov / pixel**2, rtol=1e-9)
    if unit == "pix":
        with pytest.raises(InputError, match="u and v are in pixels, but the file is in arcsec"):
            files("jwst", calibration, SETTINGS)


def test_chips_and_dates_are_files_of_their_own():
    """Two chips with a drift: at a date each chip's file is the solution there, with its errors."""
    chips = tuple(Chip(n, f"NRCA{n}", SIZE, (1024.5, 1024.5)) for n in (1, 2))
    model = DistortionModel(3, chips, "arcsec", TimeDependence((("u", 1, 0),), (2022.5,)))
    rng = np.random.default_rng(2)
    theta = 0.01 * rng.normal(size=model.n_params)
    for chip in chips:
        for axis in (0, 1):
            theta[model.coefficient_slice(chip.number, axis).start + 1 + axis] += 32.0
    solution = StandIn(model, theta, some_covariance(theta.size, 1e-4, rng))
    calibration = calibration_of(solution, "two chips")
    settings = SETTINGS | {"instrument": "NIRCAM", "detector": None, "pupil": "CLEAR"}
    with pytest.raises(InputError, match="holds for one epoch"):
        files("jwst", calibration, settings)
    built = files("jwst", calibration, settings, epoch=2025.0)
    assert [one.file_name for one in built] == [
        f"jwst_nircam_nrca{n}_distortion.asdf" for n in (1, 2)
    ]
    x, y = some_pixels(calibration, 50)
    for one, chip in zip(built, chips, strict=True):
        theirs = read(one).calibration()
        ours = calibration.chip(chip.number, 2025.0, origin="stated")
        assert theirs.numbers == (chip.number,) and theirs.model.chips == (chip,)
        assert_allclose(theirs.chip(origin="stated").at(x, y), ours.at(x, y), atol=1e-12)
        assert_allclose(
            theirs.chip(origin="stated").covariance_at(x, y), ours.covariance_at(x, y), rtol=1e-9
        )
        meta = tree_of(one)["meta"]
        assert meta["instrument"]["module"] == "A" and meta["instrument"]["channel"] == "SHORT"
        assert not [f for f in read(one).lint() if f.where.startswith("meta")]


# -- what reads them ------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["plain", "tabulated"])
def test_the_data_model_and_gwcs_map_pixels_as_we_do(which, request, tmp_path):
    """Forward to 1e-6 px, back as well as the file states, also after the model has saved it."""
    datamodels = pytest.importorskip("stdatamodels.jwst.datamodels")
    from astropy import units as u
    from gwcs import WCS
    from gwcs import coordinate_frames as cf

    calibration, built = request.getfixturevalue(which)
    first, second = tmp_path / "ours.asdf", tmp_path / "saved.asdf"
    first.write_bytes(built.content)
    with datamodels.DistortionModel(first, strict_validation=True) as model:
        model.validate()
        model.save(second)
    x, y = some_pixels(calibration)
    ours = v2v3_of(calibration, x, y)
    frames = (
        cf.Frame2D(name="detector", unit=(u.pix, u.pix)),
        cf.Frame2D(name="v2v3", unit=(u.arcsec, u.arcsec)),
    )
    for path in (first, second):
        with datamodels.DistortionModel(path) as model:
            wcs = WCS([(frames[0], model.model), (frames[1], None)])
            if path == second:  # its arrays are in blocks, which are read when they are needed
                wcs(1.0, 1.0), wcs.invert(V2REF, V3REF)
        # the pipeline closes the file first, too
        there = wcs(x - 1, y - 1)
        assert largest_distance(ours, there, PIXEL) < LIMIT
        back = wcs.invert(*there)
        missed = largest_distance(np.stack([x - 1, y - 1]), back, 1.0)
        assert missed <= built.summary["closure_pix"] * (1 + 1e-6) < 0.01
    again = registry.read_calibration(second)
    same_calibration(calibration, again)


def test_positions_are_those_of_the_siaf_functions(plain):
    """pysiaf's aperture with our V2Ref, V3Ref, V3IdlYAngle, from Ideal coordinates to V2, V3."""
    pytest.importorskip("pysiaf")
    from .siaf_aperture import aperture_of

    calibration, built = plain
    x, y = some_pixels(calibration, 200)
    aperture = aperture_of(None, V2REF, V3REF, ANGLE)
    theirs = aperture.idl_to_tel(*calibration.forward(x, y, chip=1).T)
    ours = tree_of(built)["model"](x - 1, y - 1)
    assert largest_distance(np.stack(ours), theirs, PIXEL) < LIMIT


# -- files of others ------------------------------------------------------------------------------


def foreign_model(coefficients, *, parity: int = -1, factor: float = 1.0):
    """A transform in the form of the observatory's own files: 1-based, Ideal, then two planes."""
    both = [
        models.Polynomial2D(4, **{f"c{i}_{j}": factor * v for (i, j), v in terms.items()})
        for terms in coefficients
    ]
    c, s = np.cos(np.radians(ANGLE)), np.sin(np.radians(ANGLE))
    v2 = models.Polynomial2D(1, c1_0=parity * c, c0_1=s)
    v3 = models.Polynomial2D(1, c1_0=-parity * s, c0_1=c)
    twice = models.Mapping((0, 1, 0, 1))
    return (
        models.Shift(1) & models.Shift(1)
        | models.Shift(-1024.5) & models.Shift(-1024.5)
        | twice | both[0] & both[1]
        | twice | v2 & v3
        | models.Shift(V2REF) & models.Shift(V3REF)
    )  # fmt: skip


FOREIGN = (
    {(1, 0): 0.0654, (2, 0): 2.3e-8, (1, 1): -4.1e-8, (0, 2): 1.1e-8, (3, 0): -2.3e-12},
    {(1, 0): 1e-4, (0, 1): 0.0659, (2, 0): -1.9e-8, (1, 1): 3.3e-8, (1, 3): 4e-16},
)
META = {
    "reftype": "distortion", "telescope": "JWST", "author": "others", "pedigree": "GROUND",
    "description": "as others would", "useafter": "2022-01-01T00:00:00",
    "instrument": {"name": "NIRISS", "detector": "NIS"}, "exposure": {"type": "NIS_IMAGE"},
    "input_units": "pix", "output_units": "arcsec",
}  # fmt: skip


def test_a_file_of_the_data_model_is_read(tmp_path):
    """Made by DistortionModel as others make them: without uncertainty, and with units as units."""
    datamodels = pytest.importorskip("stdatamodels.jwst.datamodels")
    from astropy import units as u

    transform = foreign_model(FOREIGN)
    transform.inverse = transform.copy()
    made = datamodels.DistortionModel(model=transform, input_units=u.pix, output_units=u.arcsec)
    for key in ("author", "pedigree", "description", "useafter"):
        setattr(made.meta, key, META[key])
    made.meta.instrument.name, made.meta.instrument.detector = "NIRISS", "NIS"
    made.meta.exposure.type = "NIS_IMAGE"
    made.save(tmp_path / "theirs.asdf")
    document = registry.open_document(tmp_path / "theirs.asdf")
    found = document.calibration()
    x, y = some_pixels(found)
    at = found.plane.to_v2v3 @ found.forward(x, y, chip=1).T + np.array(found.plane.v2v3)[:, None]
    assert largest_distance(at, transform(x - 1, y - 1), PIXEL) < LIMIT
    assert found.errors == "none" and found.model.order == 4
    assert [f.where for f in document.lint()] == ["inverse", "bayesdist"]
    assert "errors    none stated" in document.describe()


@pytest.mark.parametrize(
    ("fault", "level", "where", "message"),
    [
        ("forward order", "error", "model", "order of coefficients: powers of x and y"),
        ("all orders", "error", "model", "order of coefficients: powers of x and y"),
        ("coefficient", "error", "inverse", "misses the inverse of the model"),
        ("parity", "error", "parity", "mirror image"),
        ("degrees", "error", "scale", "the transform gives degrees"),
        ("no units", "warning", "meta.input_units", "is missing"),
        ("reftype", "error", "meta.reftype", "'specwcs', not 'distortion'"),
        ("author", "warning", "meta.author", "asks for it"),
        ("copied", "warning", "c0_2, c1_1", "may have been copied"),
        ("closure", "error", "bayesdist.inverse", "states 1e-09 px"),
        ("covariance", "error", "bayesdist", "a covariance of 3 x 3"),
    ],
)
def test_faults_are_found(plain, fault, level, where, message):
    tree = tree_of(plain[1])
    model, back = tree["model"], tree["model"].inverse
    meta, record = tree["meta"], tree["bayesdist"]
    instrument = meta["instrument"]
    if fault in ("forward order", "all orders"):
        tree["model"] = swapped(model, 2 if fault == "forward order" else 1)
        tree["model"].inverse = back
    elif fault == "coefficient":
        back = back.copy()
        polynomial(back).c2_0 = polynomial(back).c2_0.value + 3e-6
        tree["model"] = model.copy()
        tree["model"].inverse = back
    elif fault in ("parity", "degrees"):
        factor = 1 / 3600 if fault == "degrees" else 1.0
        tree["model"] = foreign_model(FOREIGN, parity=1 if fault == "parity" else -1, factor=factor)
        del tree["bayesdist"]
    elif fault == "no units":
        del meta["input_units"]
    elif fault == "reftype":
        meta["reftype"] = "specwcs"
    elif fault == "author":
        del meta["author"]
    elif fault == "copied":
        tree["model"] = model.copy()
        polynomial(tree["model"]).c0_2 = -polynomial(tree["model"]).c1_1.value
        tree["model"].inverse = back
    elif fault == "closure":
        record["inverse"]["closure_pix"] = 1e-9
    elif fault == "covariance":
        record["covariance"] = np.eye(3)
    assert instrument["name"] == "NIRISS"
    found = with_tree(tree).lint()
    assert any(f.level == level and f.where == where and message in f.message for f in found), [
        str(f) for f in found
    ]


def polynomial(model):
    """First polynomial of a transform."""
    return next(m for m in model if isinstance(m, models.Polynomial2D))


def swapped(model, lowest=2):
    """A transform whose polynomials have x and y exchanged, by default above the linear terms."""
    out = model.copy()
    for one in out:
        if isinstance(one, models.Polynomial2D):
            values = dict(zip(one.param_names, np.array(one.parameters), strict=True))
            for name in one.param_names:
                i, j = name[1:].split("_")
                if int(i) + int(j) >= lowest:
                    setattr(one, name, values[f"c{j}_{i}"])
    return out


def test_a_changed_model_has_no_covariance(plain):
    """The transform is what pipelines use: where the record is of another, its errors are not."""
    tree = tree_of(plain[1])
    back = tree["model"].inverse
    tree["model"] = tree["model"] | models.Shift(0.01) & models.Identity(1)
    tree["model"].inverse = models.Shift(-0.01) & models.Identity(1) | back
    document = with_tree(tree)
    [finding] = document.lint()
    assert finding.where == "bayesdist.parameters" and finding.level == "error"
    far = float(finding.message.split("up to ")[1].split(" px")[0])
    assert far == pytest.approx(0.01 / PIXEL, rel=0.02)  # of a pixel that distortion has changed
    assert document.calibration().errors == "none"
    x, y = some_pixels(plain[0], 50)
    found = document.calibration()
    at = found.plane.to_v2v3 @ found.forward(x, y, chip=1).T + np.array(found.plane.v2v3)[:, None]
    assert largest_distance(at - [[0.01], [0]], v2v3_of(plain[0], x, y), PIXEL) < LIMIT


# -- what cannot be read or written ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"meta": META}, "holds meta, instead of model and meta"),
        ({"model": models.Identity(2)}, "holds model, instead of model and meta"),
        ({"meta": META, "x_model": 1, "y_model": 2}, "holds meta, x_model, y_model"),
        ({"meta": META, "model": [models.Identity(2)]}, "model holds a list of models"),
        ({"meta": META, "model": models.Identity(3)}, "takes 3 coordinates to 3"),
        ({"meta": META, "model": "x"}, "model holds no model"),
    ],
)
def test_another_asdf_file_is_refused_in_a_sentence(tree, message):
    with pytest.raises(FormatError, match=message):
        with_tree(tree)


def test_the_beginning_of_a_file_is_refused_in_a_sentence(plain):
    for n in (7, 100):
        with pytest.raises(FormatError, match="is an ASDF file that cannot be read"):
            registry.recognized(Content("cut.asdf", plain[1].content[:n]))


def test_a_transform_that_is_no_polynomial_is_described_and_not_applied(tabulated):
    tree = tree_of(tabulated[1])
    del tree["bayesdist"]
    document = with_tree(tree)
    assert "4 look-up tables" in document.describe()
    with pytest.raises(InputError, match="look-up tables are not arranged as bayesdist does"):
        document.calibration()
    tree["model"] = models.Rotation2D(3.0) | models.Gaussian1D() & models.Identity(1)
    with pytest.raises(InputError, match="its transform is not a polynomial"):
        with_tree(tree).calibration()


def test_an_unknown_detector_needs_a_size():
    document = with_tree(
        {"meta": META | {"instrument": {"name": "TFI"}}, "model": foreign_model(FOREIGN)}
    )
    assert "the detector is not known here" in document.describe()
    with pytest.raises(InputError, match="does not state the size of the image"):
        document.calibration()
    assert document.calibration(Choice(size=SIZE)).model.chips[0].size == SIZE


def test_without_asdf_there_is_a_sentence(plain, monkeypatch):
    monkeypatch.setitem(sys.modules, "asdf", None)
    with pytest.raises(InputError, match=r"asdf is not installed; pip install 'bayesdist\[asdf\]'"):
        read(plain[1])
    with pytest.raises(InputError, match="asdf is not installed"):
        files("jwst", plain[0], SETTINGS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"detector": "NRCA1"}, "the detector is 'NRCA1', none of NIRISS; choose one of NIS"),
        ({"instrument": "MIRI", "detector": "MIRIFULONG"}, "none of MIRI"),
        (
            {"instrument": "MIRI", "detector": "MIRIMAGE"},
            "the chip has 2048 x 2048 pixels, but MIRIMAGE 1032 x 1024; name the detector",
        ),
    ],
)
def test_detectors_are_those_of_the_instrument(plain, change, message):
    with pytest.raises(InputError, match=message):
        files("jwst", plain[0], SETTINGS | change)


def test_tables_behind_the_polynomial_are_refused(plain):
    calibration = replace(plain[0], after=with_tables(plain[0], "").before)
    with pytest.raises(InputError, match="applied after the polynomial"):
        files("jwst", calibration, SETTINGS)


def test_a_record_of_another_version_is_refused(plain):
    record = tree_of(plain[1])["bayesdist"] | {"version": 99}
    with pytest.raises(FormatError, match="version 99, but this version of bayesdist reads 1"):
        calibration_from(record, "a file")


def test_parity_turns_u_against_v2():
    """At an angle of zero u runs along V2 with parity +1 and against it with -1, v along V3."""
    for parity in (1, -1):
        matrix = Plane("aperture", v2v3=(0.0, 0.0), v3_angle=0.0, parity=parity).to_v2v3
        assert_allclose(matrix, [[parity, 0], [0, 1]], atol=1e-15)
    # v points from +V3 by the angle towards +V2
    matrix = Plane("aperture", v3_angle=90.0, parity=-1).to_v2v3
    assert_allclose(matrix @ [0, 1], [1, 0], atol=1e-15)
