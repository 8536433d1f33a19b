"""The runs of several bands: opened, and found to go together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bayesdist.app.results import Results, results_of
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import pixel_scale_of
from bayesdist.errors import InputError
from bayesdist.missions.wise.published import WISE_BANDS
from bayesdist.model import Chip

SAME_FIELD = 0.01  # by so much the fields of two bands may differ in size
# section of the configuration, what it is called, and what to do
_OTHER_KINDS = (
    ("campaign", "campaign", "compare its filters by 'bayesdist release'"),
    ("selfcal", "self-calibration", "give runs of matched stars, one for each band"),
)


@dataclass(frozen=True, eq=False)
class BandRun:
    """A finished run of a band."""

    name: str  # of its detector
    results: Results
    arcsec: float  # per pixel

    @property
    def path(self) -> str:
        """Folder of the run."""
        return str(self.results.run.path)

    @property
    def chip(self) -> Chip:
        """The one chip."""
        return self.results.posterior.model.chips[0]

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Extent on x and y, arcsec."""
        nx, ny = self.chip.size
        return nx * self.arcsec, ny * self.arcsec


def open_bands(paths: Sequence[str | Path]) -> dict[str, BandRun]:
    """Runs of several bands, opened, in the order given; those of WISE in their own.

    InputError for a run that is not finished, has several chips or no scale, for two runs of one
    band, and for bands that do not see one field.
    """
    out: dict[str, BandRun] = {}
    for path in paths:
        band = _opened(path)
        if band.name in out:
            raise InputError(
                f"is of band {band.name}, as {out[band.name].path} is",
                where=str(path),
                do="give one run for each band",
            )
        out[band.name] = band
    _require_one_field(out)
    return dict(sorted(out.items())) if set(out) <= set(WISE_BANDS) else out


def _opened(path: str | Path) -> BandRun:
    run = RunDirectory.open(path)
    for kind, word, do in _OTHER_KINDS:
        if getattr(run.config, kind) is not None:
            raise InputError(f"is a run of a {word}", where=str(path), do=do)
    results = results_of(run)
    run.require("bands", ("fit", "sample", "diagnose"))
    chips = results.posterior.model.chips
    if len(chips) > 1:
        raise InputError(
            f"has {len(chips)} chips, and bands are compared on one",
            where=str(path),
            do="give runs of one chip each",
        )
    config = results.config
    scale = pixel_scale_of(results.posterior, scale_mas=config.detector.scale_mas)
    if scale is None:
        raise InputError(
            "the size of a pixel is not known",
            where=f"{path}, detector.scale_mas",
            do="give it in the configuration and run again",
        )
    return BandRun(config.detector.name or run.path.resolve().name, results, scale / 1000)


def _require_one_field(bands: Mapping[str, BandRun]) -> None:
    first, *others = bands.values()
    for band in others:
        for mine, theirs in zip(first.field_of_view, band.field_of_view, strict=True):
            if abs(theirs / mine - 1) > SAME_FIELD:
                raise InputError(
                    f"sees {theirs:.4g} arcsec where {first.name} sees {mine:.4g}",
                    where=band.path,
                    do="compare bands that see the same field",
                )
