"""Format entry of Roman's distortion reference files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bayesdist.errors import FormatError
from bayesdist.products.formats.common.asdf.format import Observatory
from bayesdist.products.formats.common.asdf.settings import PlacedSettings
from bayesdist.products.formats.common.asdf.tree import is_asdf, plain, tagged, tree_of
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Finding

if TYPE_CHECKING:
    from bayesdist.products.formats.common.asdf.build import ChipTransform
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile

__all__ = ["FORMAT", "Settings"]

KEY = "coordinate_distortion_transform"


class Settings(PlacedSettings):
    """Configuration of a Roman WFI distortion reference file."""

    optical_element: str


def _parse(content: Content) -> DistortionFile | None:
    """ASDF files with the node roman: of another kind they are refused."""
    if not is_asdf(content) or b"\nroman:" not in content.raw:
        return None
    # astropy.modeling takes longer to import than other files to read
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile, transform_in
    from bayesdist.products.formats.roman.meta import detector_of, units_of

    tree = tree_of(content).get("roman")
    if not isinstance(tree, Mapping) or KEY not in tree or "meta" not in tree:
        held = ", ".join(sorted(tree)) if isinstance(tree, Mapping) else "nothing"
        raise FormatError(
            f"holds {held or 'nothing'} under roman, and not meta and {KEY}",
            where=content.name,
            do="give a distortion reference file of the WFI",
        )
    meta = plain(tree["meta"])
    instrument = meta.setdefault("instrument", {})
    record = tree.get("bayesdist")
    return DistortionFile(
        content.name,
        "Roman",
        transform_in(tree, KEY, content.name),
        meta,
        units_of(meta),
        None if record is None else plain(record),
        detector_of(instrument.get("detector")),
    )


def _lint_meta(meta: Mapping[str, Any]) -> Sequence[Finding]:
    from bayesdist.products.formats.roman.meta import lint_meta

    return [*lint_meta(meta)]


def _tree(one: ChipTransform, detector: str, settings: Settings, file: str) -> dict[str, Any]:
    from bayesdist.products.formats.common.asdf.build import refuse_larger
    from bayesdist.products.formats.roman.meta import TAG, detector_of, meta_of

    meta = meta_of(detector, settings.model_dump(), "products.roman")
    refuse_larger(one, detector, detector_of(detector), "products.roman")
    return {"roman": tagged({"meta": meta, KEY: one.model, "bayesdist": one.record}, TAG, file)}


FORMAT = Observatory[Settings](
    "roman", "Roman", _parse, _lint_meta, lambda settings: "WFI", _tree
).format("a Roman distortion reference file", 6, Settings)
