"""Format entry of Roman's distortion reference files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import FormatError
from bayesdist.products.formats.common.asdf.settings import PlacedSettings
from bayesdist.products.formats.common.asdf.tree import is_asdf, packed, plain, tagged, tree_of
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import (
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
)
from bayesdist.products.formats.common.read_back import ReadBack

if TYPE_CHECKING:
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile

__all__ = ["FORMAT", "Settings"]

WHERE = "products.roman"
KEY = "coordinate_distortion_transform"


class Settings(PlacedSettings):
    """Configuration of a Roman WFI distortion reference file."""

    detector: str | None = None  # by default the names of the chips, or of the calibration
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


def _lint(file: DistortionFile) -> list[Finding]:
    from bayesdist.products.formats.common.asdf.lint import lint_distortion
    from bayesdist.products.formats.roman.meta import lint_meta

    return [*lint_meta(file.meta), *lint_distortion(file)]


def _describe(file: DistortionFile) -> list[str]:
    from bayesdist.products.formats.common.asdf.text import describe_distortion

    return describe_distortion(file, _lint(file))


def _calibration(file: DistortionFile, _: str, choice: Choice) -> Calibration:
    from bayesdist.products.formats.common.asdf.distortion import distortion_calibration

    return distortion_calibration(file, choice)


def _build(
    calibration: Calibration, settings: Settings, options: BuildOptions
) -> tuple[Built, ...]:
    """A file for each chip."""
    from bayesdist.products.formats.common.asdf.build import chip_transforms
    from bayesdist.products.formats.roman.meta import TAG, meta_of

    out = []
    several = len(calibration.numbers) > 1
    for one in chip_transforms(calibration, settings, options, WHERE):
        name = (one.chip_name if several else settings.detector) or calibration.detector
        record = one.record
        record["provenance"] |= {"instrument": "WFI", "detector": name}
        node = {"meta": meta_of(name, settings.model_dump(), WHERE), KEY: one.model}
        file = f"roman_wfi_{name}_distortion.asdf".lower()
        tree = {"roman": tagged(node | {"bayesdist": record}, TAG, file)}
        out.append(
            Built(
                file, "Roman distortion", packed(tree, file, one.table_arrays), one.model, one.chip,
                {"closure_pix": one.closure},
            )
        )  # fmt: skip
    return tuple(out)


def _read_back(files: Sequence[Built], *_: Any) -> list[ReadBack]:
    """Positions and inverse by the transforms, as pipelines have them."""
    from bayesdist.products.formats.common.asdf.distortion import transforms_read_back

    parsed = {one.chip: _parse(Content(one.file_name, one.content)) for one in files}
    return [transforms_read_back({n: f for n, f in parsed.items() if n is not None and f})]


FORMAT = Format(
    "roman",
    "a Roman distortion reference file",
    6,
    _parse,
    _describe,
    _lint,
    _calibration,
    Settings,
    _build,
    _read_back,
    holds_tables=True,
)
