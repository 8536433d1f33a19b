"""Format entry of JWST's distortion reference files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from bayesdist.errors import FormatError
from bayesdist.products.formats.common.asdf.format import Observatory
from bayesdist.products.formats.common.asdf.settings import PlacedSettings
from bayesdist.products.formats.common.asdf.tree import is_asdf, plain, tree_of
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Finding

if TYPE_CHECKING:
    from bayesdist.products.formats.common.asdf.build import ChipTransform
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile

__all__ = ["FORMAT", "Settings"]


class Settings(PlacedSettings):
    """Configuration of a JWST distortion reference file."""

    instrument: Literal["NIRCAM", "NIRISS", "FGS", "MIRI"]
    filter: str | None = None
    pupil: str | None = None
    exp_type: str | None = None


def _parse(content: Content) -> DistortionFile | None:
    """Any ASDF file that is not Roman's: of another kind it is refused."""
    if not is_asdf(content):
        return None
    # astropy.modeling takes longer to import than other files to read
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile, transform_in
    from bayesdist.products.formats.jwst.instruments import detector_of

    tree = tree_of(content)
    if "roman" in tree:
        return None
    if "model" not in tree or not isinstance(tree.get("meta"), Mapping):
        named = ", ".join(sorted(set(tree) - {"asdf_library", "history"}))
        raise FormatError(
            f"is an ASDF file that holds {named or 'nothing'}, and not model and meta, as JWST's "
            "distortion has, or roman",
            where=content.name,
            do="give a distortion reference file of an imager",
        )
    meta = plain(tree["meta"])
    instrument = meta.setdefault("instrument", {})
    record = tree.get("bayesdist")
    return DistortionFile(
        content.name,
        "JWST",
        transform_in(tree, "model", content.name),
        meta,
        (str(meta.get("input_units", "")), str(meta.get("output_units", ""))),
        None if record is None else plain(record),
        detector_of(instrument.get("name"), instrument.get("detector")),
    )


def _lint_meta(meta: Mapping[str, Any]) -> Sequence[Finding]:
    from bayesdist.products.formats.jwst.meta import lint_meta

    return [*lint_meta(meta)]


def _tree(one: ChipTransform, detector: str, settings: Settings, _: str) -> dict[str, Any]:
    from bayesdist.products.formats.common.asdf.build import refuse_larger
    from bayesdist.products.formats.jwst.instruments import detector_of
    from bayesdist.products.formats.jwst.meta import meta_of

    meta = meta_of(detector, settings.model_dump(), "products.jwst")
    refuse_larger(one, detector, detector_of(settings.instrument, detector), "products.jwst")
    return {"meta": meta, "model": one.model, "bayesdist": one.record}


FORMAT = Observatory[Settings](
    "jwst", "JWST", _parse, _lint_meta, lambda settings: settings.instrument, _tree
).format("a JWST distortion reference file", 7, Settings)
