"""What the distortion reference files of JWST and Roman have in common, each with its pipeline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asdf.tagged import TaggedDict
from astropy.modeling import models

from bayesdist.errors import FormatError
from bayesdist.products import registry
from bayesdist.products.common.content import Content

from . import test_jwst as jwst
from . import test_roman as roman
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

LIMIT = 1e-6  # pixels


def _assigned_by_jwst(path: Path) -> Any:
    """Image of NIRISS after assign_wcs, with the file alone and no CRDS."""
    assign_wcs = pytest.importorskip("jwst.assign_wcs.assign_wcs")
    from stdatamodels.jwst.datamodels import ImageModel

    image = ImageModel((2048, 2048))
    image.meta.instrument.name, image.meta.instrument.detector = "NIRISS", "NIS"
    image.meta.instrument.filter, image.meta.instrument.pupil = "CLEAR", "F200W"
    image.meta.exposure.type = "NIS_IMAGE"
    image.meta.wcsinfo.v2_ref, image.meta.wcsinfo.v3_ref = V2REF, V3REF
    image.meta.wcsinfo.ra_ref, image.meta.wcsinfo.dec_ref = 53.16, -27.79
    image.meta.wcsinfo.roll_ref = 20.0
    return assign_wcs.load_wcs(image, {"distortion": str(path), "filteroffset": None})


def _assigned_by_romancal(path: Path) -> Any:
    """Image of the WFI after assign_wcs, with the file alone."""
    assign_wcs = pytest.importorskip("romancal.assign_wcs.assign_wcs")
    datamodels = pytest.importorskip("roman_datamodels.datamodels")

    image = datamodels.ImageModel.create_fake_data(shape=(4088, 4088))
    image.meta["cal_step"] = {"assign_wcs": "INCOMPLETE"}
    info = image.meta.wcsinfo
    info.v2_ref, info.v3_ref, info.vparity, info.v3yangle = V2REF, V3REF, -1, ANGLE
    info.ra_ref, info.dec_ref, info.roll_ref = 270.0, 66.0, 20.0
    image.meta.velocity_aberration.scale_factor = 1.0
    return assign_wcs.load_wcs(image, {"distortion": str(path)})


def _of_roman(node: dict[str, Any]) -> Any:
    return with_tree({"roman": TaggedDict(node, roman.TAG)})


@dataclass(frozen=True)
class Observatory:
    """Files of one observatory.

    Parameters
    ----------
    size, pixel, settings, filter
        Of the detector, and of its file.
    title : str
        Words of its description.
    model : str
        Key of the transform, in the node that `node` takes from a tree.
    document : callable
        From such a node to the document of a file.
    assigned : callable
        From the path of a file to an image to which the pipeline has assigned it.
    """

    size: tuple[float, float]
    pixel: float
    settings: dict[str, Any]
    filter: str
    title: str
    model: str
    node: Callable[[dict[str, Any]], dict[str, Any]]
    document: Callable[[dict[str, Any]], Any]
    assigned: Callable[[Path], Any]


OBSERVATORIES = {
    "jwst": Observatory(
        jwst.SIZE, jwst.PIXEL, jwst.SETTINGS, "F200W", "JWST distortion of NIRISS/NIS", "model",
        lambda tree: tree, with_tree, _assigned_by_jwst,
    ),
    "roman": Observatory(
        roman.SIZE, roman.PIXEL, roman.SETTINGS, "F158", "Roman distortion of WFI/WFI07",
        roman.KEY, lambda tree: tree["roman"], _of_roman, _assigned_by_romancal,
    ),
}  # fmt: skip


@cache
def made(key: str, tabulated: bool = False):
    """A calibration and its file; with tables of detector and filter where they are wanted."""
    one = OBSERVATORIES[key]
    calibration = imager(one.size, one.pixel)
    if tabulated:
        calibration = replace(with_tables(calibration, "", one.filter), filter=one.filter)
    [built] = files(key, calibration, one.settings)
    return calibration, built


both = pytest.mark.parametrize("key", OBSERVATORIES)
with_and_without_tables = pytest.mark.parametrize("tabulated", [False, True])


@both
@with_and_without_tables
def test_a_file_is_read_back_as_the_same_calibration(key, tabulated):
    calibration, built = made(key, tabulated)
    document = read(built)
    same_calibration(calibration, document.calibration())
    assert document.lint() == ()
    text = document.describe()
    assert OBSERVATORIES[key].title in text and "covariance" in text
    assert OBSERVATORIES[key].filter in text
    plane = document.calibration().plane
    assert (plane.v2v3, plane.v3_angle, plane.parity) == ((V2REF, V3REF), ANGLE, -1)


@both
@with_and_without_tables
def test_the_pipeline_assigns_our_solution_to_an_image(key, tabulated, tmp_path):
    """Pixels to V2, V3 to 1e-6 px; from the sky back as well as the file states."""
    one, (calibration, built) = OBSERVATORIES[key], made(key, tabulated)
    path = tmp_path / built.file_name
    path.write_bytes(built.content)
    wcs = one.assigned(path).meta.wcs
    x, y = some_pixels(calibration)
    middle = (one.size[0] + 1) / 2
    keep = (np.abs(x - middle) < middle - 24) & (np.abs(y - middle) < middle - 24)
    x, y = x[keep], y[keep]
    there = wcs.get_transform("detector", "v2v3")(x - 1, y - 1)
    assert largest_distance(v2v3_of(calibration, x, y), there, one.pixel) < LIMIT
    back = wcs.invert(*wcs(x - 1, y - 1))
    missed = largest_distance(np.stack([x - 1, y - 1]), back, 1.0)
    assert missed <= built.summary["closure_pix"] + LIMIT


def transposed(model):
    """A transform that takes y, x."""
    out = models.Mapping((1, 0)) | model
    out.inverse = model.inverse | models.Mapping((1, 0))
    return out


def without_inverse(model):
    out = model.copy()
    del out.inverse
    return out


def inverse_of_another_order(model):
    """A transform whose inverse has the powers of x and y exchanged."""
    out = model.copy()
    out.inverse = jwst.swapped(model.inverse)
    return out


def in_degrees(model):
    out = model | models.Scale(1 / 3600) & models.Scale(1 / 3600)
    out.inverse = models.Scale(3600.0) & models.Scale(3600.0) | model.inverse
    return out


@both
@pytest.mark.parametrize(
    ("change", "where", "message"),
    [
        (without_inverse, "inverse", "is missing"),
        (inverse_of_another_order, "inverse", "order of coefficients: powers of x and y are exch"),
        (transposed, "parity", "mirror image"),
        (in_degrees, "scale", "the transform gives degrees"),
        (None, "meta.output_units", "units are 'deg'"),
    ],
)
def test_faults_are_found(key, change, where, message):
    one = OBSERVATORIES[key]
    node = dict(one.node(tree_of(made(key)[1])).items())
    node["meta"] = dict(node["meta"])
    if change is None:
        node["meta"]["output_units"] = "deg"
    else:
        node[one.model] = change(node[one.model])
    found = roman.loosely(lambda: one.document(node))
    assert any(f.level == "error" and f.where == where and message in f.message for f in found), [
        str(f) for f in found
    ]


@pytest.mark.parametrize("lost", ["provenance", "chip", "gauge"])
def test_a_record_that_lacks_something_is_said(lost):
    tree = tree_of(made("jwst")[1])
    record = {name: value for name, value in tree["bayesdist"].items() if name != lost}
    document = with_tree({**tree, "bayesdist": record})
    assert "errors    of a record that cannot be read" in document.describe()
    assert any(f"{lost}: Field required" in f.message for f in document.lint())


@both
def test_a_truncated_file_is_refused_in_a_sentence(key):
    raw = made(key)[1].content
    # shorter, what is left of Roman's names no node roman
    for n in (900, len(raw) // 2, len(raw) - 200):
        with pytest.raises(FormatError, match="is an ASDF file that cannot be read"):
            registry.recognized(Content("cut.asdf", raw[:n]))
