"""Format entry of JWST's distortion reference files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import FormatError
from bayesdist.products.formats.common.asdf.settings import PlacedSettings
from bayesdist.products.formats.common.asdf.tree import is_asdf, packed, plain, tree_of
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

WHERE = "products.jwst"


class Settings(PlacedSettings):
    """Configuration of a JWST distortion reference file."""

    instrument: Literal["NIRCAM", "NIRISS", "FGS", "MIRI"]
    detector: str | None = None  # by default the names of the chips, or of the calibration
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


def _lint(file: DistortionFile) -> list[Finding]:
    from bayesdist.products.formats.common.asdf.lint import lint_distortion
    from bayesdist.products.formats.jwst.meta import lint_meta

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
    from bayesdist.products.formats.jwst.meta import meta_of

    out = []
    several = len(calibration.numbers) > 1
    for one in chip_transforms(calibration, settings, options, WHERE):
        name = (one.chip_name if several else settings.detector) or calibration.detector
        meta = meta_of(name, settings.model_dump(), WHERE)
        record = one.record
        record["provenance"] |= {"instrument": settings.instrument, "detector": name}
        tree: dict[str, Any] = {"meta": meta, "model": one.model, "bayesdist": record}
        file = f"jwst_{settings.instrument}_{name}_distortion.asdf".lower()
        out.append(
            Built(
                file, "JWST distortion", packed(tree, file, one.table_arrays), one.model, one.chip,
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
    "jwst",
    "a JWST distortion reference file",
    7,
    _parse,
    _describe,
    _lint,
    _calibration,
    Settings,
    _build,
    _read_back,
    holds_tables=True,
)
