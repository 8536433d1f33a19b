"""Open the runs of several bands and check that they can be compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import pixel_scale_of
from bayesdist.errors import InputError
from bayesdist.missions.wise.published import WISE_BANDS
from bayesdist.model import Chip

SAME_FIELD = 0.01  # largest relative difference in size of the fields of two bands
# unsupported kinds of runs: section of the configuration, name, and advice
_OTHER_KINDS = (
    ("campaign", "campaign", "compare its filters by 'bayesdist release'"),
    ("selfcal", "self-calibration", "give runs of matched stars, one for each band"),
)


@dataclass(frozen=True, eq=False)
class BandRun:
    """Finished run of a band."""

    name: str  # name of the detector
    run: Run
    arcsec: float  # arcsec per pixel

    @property
    def path(self) -> str:
        """Folder of the run."""
        return str(self.run.directory.path)

    @property
    def chip(self) -> Chip:
        """Chip of the band."""
        return self.run.posterior.model.chips[0]

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Extent of the array along x and y, arcsec."""
        nx, ny = self.chip.size
        return nx * self.arcsec, ny * self.arcsec


def open_bands(paths: Sequence[str | Path]) -> dict[str, BandRun]:
    """Open the runs of several bands, in the given order, or sorted by band for WISE.

    Raises InputError if a run is not finished, has several chips or no pixel scale, two runs are of
    the same band, or the bands have different fields of view.
    """
    out: dict[str, BandRun] = {}
    for path in paths:
        band = _opened(path)
        if band.name in out:
            raise InputError(
                f"is of band {band.name}, as is {out[band.name].path}",
                where=str(path),
                do="give one run for each band",
            )
        out[band.name] = band
    _require_one_field(out)
    return dict(sorted(out.items())) if set(out) <= set(WISE_BANDS) else out


def _opened(path: str | Path) -> BandRun:
    directory = RunDirectory.open(path)
    for kind, word, do in _OTHER_KINDS:
        if hasattr(directory.config, kind):
            raise InputError(f"is a run of a {word}", where=str(path), do=do)
    run = Run.of(directory)
    directory.require("bands", ("fit", "sample", "diagnose"))
    chips = run.posterior.model.chips
    if len(chips) > 1:
        raise InputError(
            f"has {len(chips)} chips, but bands must have one chip",
            where=str(path),
            do="give runs of one chip each",
        )
    config = run.config
    scale = pixel_scale_of(run.posterior, scale_mas=config.detector.scale_mas)
    if scale is None:
        raise InputError(
            "the pixel scale is unknown",
            where=f"{path}, detector.scale_mas",
            do="give it in the configuration and run again",
        )
    return BandRun(config.detector.name or directory.path.resolve().name, run, scale / 1000)


def _require_one_field(bands: Mapping[str, BandRun]) -> None:
    first, *further = bands.values()
    for band in further:
        for extent_first, extent in zip(first.field_of_view, band.field_of_view, strict=True):
            if abs(extent / extent_first - 1) > SAME_FIELD:
                raise InputError(
                    f"has a field of {extent:.4g} arcsec, but {first.name} has {extent_first:.4g}",
                    where=band.path,
                    do="compare bands with the same field of view",
                )
