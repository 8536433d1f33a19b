"""Roman's distortion reference files: roman_datamodels and romancal read ours, and we others'."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from asdf.tagged import TaggedDict
from astropy.modeling import models
from astropy.time import Time
from numpy.testing import assert_allclose

from bayesdist.errors import FormatError, InputError
from bayesdist.products import registry

from .v2v3 import (
    ANGLE,
    V2REF,
    V3REF,
    files,
    imager,
    largest_distance,
    same_calibration,
    some_pixels,
    tree_of,
    v2v3_of,
    with_tables,
    with_tree,
)

SIZE, PIXEL = (4088.0, 4088.0), 0.1075
SETTINGS = {
    "detector": "WFI07", "optical_element": "F158", "useafter": "2026-10-01T00:00:00",
    "pedigree": "GROUND", "author": "nobody", "v2ref": V2REF, "v3ref": V3REF,
    "v3idlyangle": ANGLE, "inverse_order": 7,
}  # fmt: skip
KEY = "coordinate_distortion_transform"
TAG = "asdf://stsci.edu/datamodels/roman/tags/reference_files/distortion-1.3.0"
LIMIT = 1e-6  # pixels


@pytest.fixture(scope="module")
def plain():
    """A calibration and its file."""
    calibration = imager(SIZE, PIXEL)
    [built] = files("roman", calibration, SETTINGS)
    return calibration, built


@pytest.fixture(scope="module")
def tabulated():
    """A calibration with tables of detector and filter, and its file."""
    calibration = replace(with_tables(imager(SIZE, PIXEL), "", "F158"), filter="F158")
    [built] = files("roman", calibration, SETTINGS)
    return calibration, built


@pytest.fixture
def changed(plain):
    """Node roman of a file, and a function from it to a document."""
    tree = tree_of(plain[1])
    node = {key: tree["roman"][key] for key in ("meta", KEY, "bayesdist")}
    node["meta"] = {key: node["meta"][key] for key in node["meta"]}
    return node, lambda: with_tree({"roman": TaggedDict(node, TAG)})


# -- read back ------------------------------------------------------------------------------------


def test_tables_are_constant_beyond_their_nodes_and_inverted(tabulated):
    """By astropy alone: pixels outside the outermost nodes too, and back to where they were."""
    calibration, built = tabulated
    transform = tree_of(built)["roman"][KEY]
    edge = np.array([1.0, 2.0, 15.0, 4080.0, 4088.0])
    x, y = (g.ravel() for g in np.meshgrid(edge, edge))
    there = transform(x - 1, y - 1)
    assert largest_distance(v2v3_of(calibration, x, y), there, PIXEL) < LIMIT
    back = np.stack(transform.inverse(*there))
    assert np.hypot(*(back - [x - 1, y - 1])).max() <= built.summary["closure_pix"] * (1 + 1e-6)
    # tables cost the inverse nothing: it is as good as that of the polynomial alone
    [bare] = files("roman", replace(calibration, before=()), SETTINGS)
    assert_allclose(built.summary["closure_pix"], bare.summary["closure_pix"], rtol=0.02)


# -- what reads them ------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["plain", "tabulated"])
def test_the_data_model_maps_pixels_as_we_do(which, request, tmp_path):
    """Forward to 1e-6 px, also after the model has saved it; the covariance is still there."""
    datamodels = pytest.importorskip("roman_datamodels.datamodels")
    calibration, built = request.getfixturevalue(which)
    first, second = tmp_path / "ours.asdf", tmp_path / "saved.asdf"
    first.write_bytes(built.content)
    x, y = some_pixels(calibration)
    ours = v2v3_of(calibration, x, y)
    with datamodels.open(first) as model:
        assert isinstance(model, datamodels.DistortionRefModel)
        there = model.coordinate_distortion_transform(x - 1, y - 1)
        model.save(second)
    assert largest_distance(ours, there, PIXEL) < LIMIT
    same_calibration(calibration, registry.read_calibration(second))


# -- files of others ------------------------------------------------------------------------------


def foreign_transform():
    """Order 2 about the middle, with its parts in another arrangement than ours."""
    x = models.Polynomial2D(2, c1_0=-0.108, c0_1=1e-3, c2_0=2e-8, c1_1=-3e-8, c0_2=1e-8)
    y = models.Polynomial2D(2, c1_0=1e-3, c0_1=0.107, c2_0=-1e-8, c1_1=4e-8, c0_2=3e-8)
    shift = models.Shift(-2043.5) & models.Shift(-2043.5)
    return (
        shift | models.Mapping((0, 1, 0, 1)) | x & y
        | models.Rotation2D(60.0) | models.Shift(V2REF) & models.Shift(V3REF)
    )  # fmt: skip


def test_a_file_of_the_data_model_is_read(tmp_path):
    """Made by DistortionRefModel as others make them: no inverse and no uncertainty."""
    datamodels = pytest.importorskip("roman_datamodels.datamodels")
    made = datamodels.DistortionRefModel.create_minimal()
    made.meta.update({
        "reftype": "DISTORTION", "pedigree": "GROUND", "description": "as others would",
        "author": "others", "useafter": Time("2026-10-01T00:00:00"), "telescope": "ROMAN",
        "origin": "STSCI",
        "instrument": {"name": "WFI", "detector": "WFI01", "optical_element": "F106"},
    })  # fmt: skip
    made.coordinate_distortion_transform = foreign_transform()
    made.save(tmp_path / "theirs.asdf")
    document = registry.open_document(tmp_path / "theirs.asdf")
    assert document.format.key == "roman"
    found = document.calibration()
    x, y = some_pixels(found)
    at = found.plane.to_v2v3 @ found.forward(x, y, chip=1).T + np.array(found.plane.v2v3)[:, None]
    assert largest_distance(at, foreign_transform()(x - 1, y - 1), PIXEL) < LIMIT
    assert [(f.level, f.where) for f in document.lint()] == [
        ("error", "inverse"), ("note", "bayesdist"),
    ]  # fmt: skip
    assert "WFI/WFI01" in document.describe() and found.filter == "F106"


@pytest.mark.parametrize(
    ("fault", "level", "where", "message"),
    [
        ("optical element", "warning", "meta.instrument.optical_element", "asks for it"),
        ("reftype", "error", "meta.reftype", "is 'distortion', not 'DISTORTION'"),
    ],
)
def test_faults_are_found(changed, fault, level, where, message):
    node, document = changed
    if fault == "reftype":
        node["meta"]["reftype"] = "distortion"
    elif fault == "optical element":
        node["meta"]["instrument"] = {"name": "WFI", "detector": "WFI07"}
    found = loosely(document)
    assert any(f.level == level and f.where == where and message in f.message for f in found), [
        str(f) for f in found
    ]


def loosely(document):
    """Findings in a file that the schema of Roman's data models, where installed, would refuse."""
    import asdf

    with asdf.config_context() as config:
        config.validate_on_read = False
        for extension in config.extensions:
            if "roman" in str(extension.extension_uri):
                config.remove_extension(extension)
        return document().lint()


# -- what cannot be read or written ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"roman": {"meta": {"a": 1}}}, f"holds meta under roman, instead of meta and {KEY}"),
        ({"roman": {"meta": {}, "data": [1]}}, "holds data, meta under roman"),
        ({"roman": {"meta": {}, KEY: "x"}}, f"{KEY} holds no model"),
        ({"roman": {"meta": {}, KEY: models.Identity(3)}}, "takes 3 coordinates to 3"),
    ],
)
def test_another_file_of_roman_is_refused_in_a_sentence(tree, message):
    with pytest.raises(FormatError, match=message):
        with_tree(tree)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"detector": "WFI19"}, "detector is 'WFI19', none of the WFI"),
        ({"optical_element": "F814W"}, "optical_element is 'F814W', none of the WFI"),
        ({"useafter": "soon"}, "useafter is 'soon'; write it as in"),
    ],
)
def test_values_that_the_schema_has_not_are_refused(plain, change, message):
    with pytest.raises(InputError, match=message):
        files("roman", plain[0], SETTINGS | change)
