"""Format entries of the observatories whose distortion reference files are ASDF."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.formats.common.asdf.tree import (
    Detector,
    PlacedSettings,
    is_asdf,
    packed,
    plain,
)
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import (
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
)
from bayesdist.products.formats.common.read_back import ReadBack

# astropy.modeling, which these need, takes longer to import than other files to read
if TYPE_CHECKING:
    from astropy.modeling import Model

    from bayesdist.products.formats.common.asdf.distortion import DistortionFile

Settings = TypeVar("Settings", bound=PlacedSettings)


@dataclass(frozen=True)
class Observatory(Generic[Settings]):
    """What the files of one observatory have of their own."""

    key: str  # as of `Format`
    name: str  # as in "JWST"
    # from a file to the node with meta and transform, and to the key of the transform; None for a
    # file of another kind, FormatError for one without these
    node: Callable[[Content], tuple[Mapping[str, Any], str] | None]
    detector: Callable[[Mapping[str, Any]], Detector | None]  # from the node meta.instrument
    lint_meta: Callable[[Mapping[str, Any]], Iterable[Finding]]  # from the node meta to findings
    # from the name of the detector and settings to the node meta; InputError for unknown values
    meta: Callable[[str, Settings], dict[str, Any]]
    # from meta, transform, record and the name of the file to the tree of the file
    tree: Callable[[dict[str, Any], Model, dict[str, Any], str], dict[str, Any]]
    units: tuple[str, str] = ("", "")  # of pixels and positions, where a file states none

    def format(self, title: str, rank: int, settings: type[Settings]) -> Format:
        """Format entry; title, rank and settings are as of `Format`."""
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
        found = self.node(content) if is_asdf(content) else None
        if found is None:
            return None
        from bayesdist.products.formats.common.asdf.distortion import DistortionFile, transform_in

        tree, key = found
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
        from bayesdist.products.formats.common.asdf.lint import lint_distortion

        return [*self.lint_meta(file.meta), *lint_distortion(file)]

    def _describe(self, file: DistortionFile) -> list[str]:
        from bayesdist.products.formats.common.asdf.lint import describe_distortion

        return describe_distortion(file, self._lint(file))

    def _build(
        self, calibration: Calibration, settings: Settings, options: BuildOptions
    ) -> tuple[Built, ...]:
        """A file for each chip."""
        from bayesdist.products.formats.common.asdf.build import chip_transforms, refuse_larger

        out = []
        several, where = len(calibration.numbers) > 1, f"products.{self.key}"
        for one in chip_transforms(calibration, settings, options, where):
            detector = (one.chip_name if several else settings.detector) or calibration.detector
            meta = self.meta(detector, settings)
            refuse_larger(one, detector, self.detector(meta["instrument"]), where)
            instrument = meta["instrument"]["name"]
            one.record["provenance"] |= {"instrument": instrument, "detector": detector}
            usual = f"{self.key}_{instrument}_{detector}_distortion.asdf".lower()
            file = options.named(usual, several=several)
            tree = self.tree(meta, one.model, one.record, file)
            content = packed(tree, file, one.table_arrays)
            kind, found = f"{self.name} distortion", {"closure_pix": one.closure}
            out.append(Built(file, kind, content, one.model, one.chip, found))
        return tuple(out)

    def _read_back(self, files: Sequence[Built], *_: Any) -> list[ReadBack]:
        """Positions and inverse by the transforms, as pipelines have them."""
        from bayesdist.products.formats.common.asdf.distortion import transforms_read_back

        parsed = {one.chip: self._parse(Content(one.file_name, one.content)) for one in files}
        return [transforms_read_back({n: f for n, f in parsed.items() if n is not None and f})]


def _calibration(file: DistortionFile, _: str, choice: Choice) -> Calibration:
    from bayesdist.products.formats.common.asdf.distortion import distortion_calibration

    return distortion_calibration(file, choice)
