"""Reading and writing of ASDF trees, and settings common to all observatories."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from bayesdist.files.asdf import asdf_tree, asdf_with_transforms
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import FormatSettings

if TYPE_CHECKING:
    from astropy.time import Time

DESCRIPTION = "Geometric distortion with its uncertainty, by bayesdist"


class Identity(TypedDict):
    """Metadata that every reference file contains."""

    pedigree: str
    useafter: str | Time
    author: str
    description: str


class InstrumentMeta(TypedDict):
    """Node meta.instrument of a file that is written."""

    name: str
    detector: str
    module: NotRequired[str]
    channel: NotRequired[str]
    filter: NotRequired[str]
    pupil: NotRequired[str]
    p_pupil: NotRequired[str]
    optical_element: NotRequired[str]


class ReferenceMeta(Identity):
    """Node meta of a file that is written."""

    telescope: str
    origin: NotRequired[str]
    reftype: str
    model_type: NotRequired[str]
    instrument: InstrumentMeta
    exposure: NotRequired[dict[str, str]]
    input_units: str
    output_units: str


class PlacedSettings(FormatSettings):
    """Identity of the file, and position and orientation of the (u, v) plane in V2, V3.

    V2Ref, V3Ref [arcsec] are the position of (u, v) = 0. V3IdlYAngle [deg] and VIdlParity describe
    the axes of (u, v), which are those of the aperture's Ideal system. A calibration made in an
    aperture provides all of these values.
    """

    detector: str | None = None  # default: the chip names, or the detector of the calibration
    useafter: str
    pedigree: str
    author: str
    description: str = DESCRIPTION
    v2ref: float | None = None
    v3ref: float | None = None
    v3idlyangle: float | None = None
    parity: Literal[-1, 1] | None = None
    inverse_order: Annotated[int, Field(ge=1, le=12)] | None = None

    def identity(self) -> Identity:
        """Metadata that every reference file contains."""
        return {
            "pedigree": self.pedigree,
            "useafter": self.useafter,
            "author": self.author,
            "description": self.description,
        }


@dataclass(frozen=True)
class KnownDetector:
    """Known properties of a detector."""

    size: tuple[float, float]
    scale: float  # arcsec, nominal


_START = b"#ASDF"


def is_asdf(content: Content) -> bool:
    """True if the content begins like an ASDF file."""
    return content.raw[: len(_START)] == _START


def tree_of(content: Content) -> Mapping[str, Any]:
    """Tree of an ASDF file with its arrays in memory; errors as for `asdf_tree`."""
    return asdf_tree(content.raw, content.budget, max_order=MAX_ORDER)


def packed(
    tree: Mapping[str, Any], name: str, in_text: Iterable[NDArray[np.generic]] = ()
) -> bytes:
    """Bytes of an ASDF file with this tree.

    Arrays in `in_text` are written as text: pipelines close the file before they evaluate a
    transform, and arrays in binary blocks are not read until then.  Raises InputError if asdf is
    not installed; `name` is the file for its message.
    """
    stream = io.BytesIO()
    file = asdf_with_transforms(name).AsdfFile(dict(tree))
    for array in in_text:
        file.set_array_storage(array, "inline")
    file.write_to(stream)
    return stream.getvalue()


def tagged(node: Mapping[str, Any], tag: str, name: str) -> Any:
    """Node of an ASDF tree with a tag that needs no converter.

    Raises InputError if asdf is not installed; `name` is the file for its message.
    """
    asdf_with_transforms(name)
    from asdf.tagged import TaggedDict

    return TaggedDict(dict(node), tag)


def plain(node: Any) -> Any:
    """Convert asdf's classes in a node to numpy arrays, lists and dictionaries."""
    if isinstance(node, Mapping):
        return {str(key): plain(value) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [plain(value) for value in node]
    return np.asarray(node) if hasattr(node, "__array__") else node
