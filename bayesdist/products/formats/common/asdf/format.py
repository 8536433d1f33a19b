"""Format entries of the observatories whose distortion reference files are ASDF."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.formats.common.asdf.tree import PlacedSettings, packed
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
    from bayesdist.products.formats.common.asdf.build import ChipTransform
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile

__all__ = ["Observatory"]


Settings = TypeVar("Settings", bound=PlacedSettings)


@dataclass(frozen=True)
class Observatory(Generic[Settings]):
    """What the files of one observatory have of their own."""

    key: str  # as of `Format`
    name: str  # as in "JWST"
    parse: Callable[[Content], DistortionFile | None]  # as of `Format`
    lint_meta: Callable[[Mapping[str, Any]], Iterable[Finding]]  # from the node meta to findings
    instrument: Callable[[Settings], str]  # from settings to the name of the instrument
    # from the transform of a chip, the name of its detector, settings and the name of the file to
    # the tree of the file
    tree: Callable[[ChipTransform, str, Settings, str], dict[str, Any]]

    def format(self, title: str, rank: int, settings: type[Settings]) -> Format:
        """Format entry; title, rank and settings are as of `Format`."""
        return Format(
            self.key,
            title,
            rank,
            self.parse,
            self._describe,
            self._lint,
            _calibration,
            settings,
            self._build,
            self._read_back,
            holds_tables=True,
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
        from bayesdist.products.formats.common.asdf.build import chip_transforms

        out = []
        several = len(calibration.numbers) > 1
        instrument = self.instrument(settings)
        for one in chip_transforms(calibration, settings, options, f"products.{self.key}"):
            detector = (one.chip_name if several else settings.detector) or calibration.detector
            one.record["provenance"] |= {"instrument": instrument, "detector": detector}
            file = f"{self.key}_{instrument}_{detector}_distortion.asdf".lower()
            content = packed(self.tree(one, detector, settings, file), file, one.table_arrays)
            kind, found = f"{self.name} distortion", {"closure_pix": one.closure}
            out.append(Built(file, kind, content, one.model, one.chip, found))
        return tuple(out)

    def _read_back(self, files: Sequence[Built], *_: Any) -> list[ReadBack]:
        """Positions and inverse by the transforms, as pipelines have them."""
        from bayesdist.products.formats.common.asdf.distortion import transforms_read_back

        parsed = {one.chip: self.parse(Content(one.file_name, one.content)) for one in files}
        return [transforms_read_back({n: f for n, f in parsed.items() if n is not None and f})]


def _calibration(file: DistortionFile, _: str, choice: Choice) -> Calibration:
    from bayesdist.products.formats.common.asdf.distortion import distortion_calibration

    return distortion_calibration(file, choice)
