"""Formats of the observatories that use ASDF distortion reference files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.common.asdf.tree import (
    KnownDetector,
    PlacedSettings,
    ReferenceMeta,
    is_asdf,
    packed,
    plain,
)
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
    ReadBack,
)
from bayesdist.products.common.record import CalibrationRecord

# these need astropy.modeling, which takes longer to import than other files take to read
if TYPE_CHECKING:
    from astropy.modeling import Model

    from bayesdist.products.common.asdf.distortion import DistortionFile

Settings = TypeVar("Settings", bound=PlacedSettings)


@dataclass(frozen=True)
class Observatory(Generic[Settings]):
    """Properties that distinguish the files of one observatory."""

    key: str  # key of the `Format`
    name: str  # as in "JWST"
    # returns the node with meta and transform, and the key of the transform; None for a file of
    # another format, FormatError if these nodes are missing
    node: Callable[[Content], tuple[Mapping[str, Any], str] | None]
    detector: Callable[[Mapping[str, Any]], KnownDetector | None]  # takes the node meta.instrument
    lint_meta: Callable[[Mapping[str, Any]], Iterable[Finding]]  # takes the node meta
    # (detector name, settings) -> node meta; InputError for unknown values
    meta: Callable[[str, Settings], ReferenceMeta]
    # (meta, transform, record, file name) -> tree of the file
    tree: Callable[[ReferenceMeta, Model, CalibrationRecord, str], Mapping[str, object]]
    units: tuple[str, str] = ("", "")  # of pixels and positions if a file states none

    def format(self, title: str, rank: int, settings: type[Settings]) -> Format:
        """`Format` of the observatory's files; title, rank and settings are passed on to it."""
        return Format(
            self.key,
            title,
            rank,
            self._parse,
            self._describe,
            self._lint,
            _calibration,
            settings,
            self._build,
            self._read_back,
            holds_tables=True,
            asks=("size",),
        )

    def _parse(self, content: Content) -> DistortionFile | None:
        node = self.node(content) if is_asdf(content) else None
        if node is None:
            return None
        from bayesdist.products.common.asdf.distortion import DistortionFile, transform_in

        tree, key = node
        meta, record = plain(tree["meta"]), tree.get("bayesdist")
        instrument = meta.setdefault("instrument", {})
        stated = zip(("input_units", "output_units"), self.units, strict=True)
        units = tuple(str(meta.get(name, usual)) for name, usual in stated)
        return DistortionFile(
            content.name,
            self.name,
            transform_in(tree, key, content.name),
            meta,
            (units[0], units[1]),
            None if record is None else plain(record),
            self.detector(instrument),
        )

    def _lint(self, file: DistortionFile) -> list[Finding]:
        from bayesdist.products.common.asdf.distortion import lint_distortion

        return [*self.lint_meta(file.meta), *lint_distortion(file)]

    def _describe(self, file: DistortionFile) -> list[str]:
        from bayesdist.products.common.asdf.distortion import describe_distortion

        return describe_distortion(file, self._lint(file))

    def _build(
        self, calibration: Calibration, settings: Settings, options: BuildOptions
    ) -> tuple[Built, ...]:
        """Build one file per chip."""
        from bayesdist.products.common.asdf.distortion import chip_transforms, refuse_larger

        out = []
        several, location = len(calibration.numbers) > 1, f"products.{self.key}"
        for transform in chip_transforms(calibration, settings, options, location):
            detector = (
                transform.chip_name if several else settings.detector
            ) or calibration.detector
            meta = self.meta(detector, settings)
            refuse_larger(transform, detector, self.detector(meta["instrument"]), location)
            instrument = meta["instrument"]["name"]
            provenance = transform.record["provenance"]
            provenance["instrument"], provenance["detector"] = instrument, detector
            usual = f"{self.key}_{instrument}_{detector}_distortion.asdf".lower()
            file = options.named(usual, several=several)
            tree = self.tree(meta, transform.model, transform.record, file)
            content = packed(tree, file, transform.table_arrays)
            kind, summary = f"{self.name} distortion", {"closure_pix": transform.closure}
            out.append(Built(file, kind, content, transform.model, transform.chip, summary))
        return tuple(out)

    def _read_back(self, files: Sequence[Built], *_: Any) -> list[ReadBack]:
        """Positions and inverse evaluated by the transforms of the files, as pipelines do."""
        from bayesdist.products.common.asdf.distortion import transforms_read_back

        parsed = {part.chip: self._parse(Content(part.file_name, part.content)) for part in files}
        return [transforms_read_back({n: f for n, f in parsed.items() if n is not None and f})]


def _calibration(file: DistortionFile, _: str, choice: Choice) -> Calibration:
    from bayesdist.products.common.asdf.distortion import distortion_calibration

    return distortion_calibration(file, choice)
