"""Analysis of each band and comparison of several bands, whose runs are opened and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.store.summary import head_of
from bayesdist.assess import pixel_scale_of, uncertainty_map
from bayesdist.errors import InputError
from bayesdist.missions.wise.assess.account import PRINTED_BINS, accounts, partition_parts
from bayesdist.missions.wise.assess.distortion_field import (
    DistortionField,
    band_sums,
    field_of_solution,
)
from bayesdist.missions.wise.assess.residual_field import residual_correlation, residual_partition
from bayesdist.missions.wise.assess.residual_tables import implied_sigma, residual_tables
from bayesdist.missions.wise.bands.context import BandResult, BandsInput, Printed
from bayesdist.missions.wise.bands.optical import OpticalModel
from bayesdist.missions.wise.published import (
    FORMAL_RADII,
    LONGEST_VECTORS,
    SAMPLE_SIZES,
    WISE_BANDS,
)
from bayesdist.model import Chip
from bayesdist.model.basis import n_terms

GRID = (33, 33)
SEED = 20110201

SAME_FIELD = 0.01  # largest relative difference in size of the fields of two bands
# unsupported kinds of runs: section of the configuration, name, and advice
_OTHER_KINDS = (
    ("campaign", "campaign", "compare its filters by 'bayesdist release'"),
    ("selfcal", "self-calibration", "give runs of matched stars, one for each band"),
)


def measure_bands(
    runs: Mapping[str, BandRun],
    *,
    bins: int,
    optical: Mapping[str, OpticalModel],
    published: bool,
    provenance: Mapping[str, object],
) -> BandsInput:
    """Compute the content of all tables and figures; the stars of each band are read once."""
    wise = published and set(runs) <= set(WISE_BANDS)
    fields = {
        name: field_of_solution(band.run.solution, epoch=band.run.epoch)
        for name, band in runs.items()
    }
    bands = tuple(
        _measured(band, fields[name], optical.get(name), bins, wise) for name, band in runs.items()
    )
    arcsec = {b.name: b.arcsec for b in bands}
    tables = residual_tables(
        {b.name: b.sums.bins for b in bands},
        rng=np.random.default_rng(SEED),
        arcsec=arcsec,
        absorbed={b.name: n_terms(b.order) for b in bands},
    )
    first, *further = bands
    return BandsInput(
        bands=bands,
        tables=tables,
        accounts=accounts(
            tables,
            partition_parts({b.name: b.partition for b in bands}, arcsec),
            arcsec,
            {b.name: b.n_used for b in bands},
            published=wise and bins == PRINTED_BINS,
        ),
        differences={
            # in pixels of the first band: a pixel of this band is b.arcsec / first.arcsec of them
            f"{b.name}−{first.name}": _times(
                fields[b.name].minus(fields[first.name], first.arcsec / b.arcsec),
                b.arcsec / first.arcsec,
                fields[first.name],
            ).vectors(GRID)
            for b in further
        },
        n_bins=bins,
        wise=wise,
        optical="; ".join(dict.fromkeys(model.label for model in optical.values())),
        provenance=provenance,
    )


def _times(field: DistortionField, factor: float, like: DistortionField) -> DistortionField:
    """Scale the vectors of a field and transfer it to the array of another field."""
    order = field.basis.order
    basis = type(like.basis)(order, like.basis.size, like.basis.reference_pixel)
    return DistortionField(basis, factor * field.polynomial, like.to_pixels)


def _measured(
    band: BandRun, field: DistortionField, optical: OpticalModel | None, bins: int, wise: bool
) -> BandResult:
    run, fit = band.run, band.run.fit
    minus_optical = None if optical is None else field.minus(optical.field(band.chip, band.arcsec))
    vectors = field.vectors(GRID)
    without = {"no correction": field} | (
        {} if minus_optical is None else {"optical model": minus_optical}
    )
    rms = float(np.linalg.norm(field.to_pixels) * max(fit.rms_u, fit.rms_v) / np.sqrt(2))
    sums = run.shards.sum(
        band_sums,
        run.solution.mean,
        fit.clip,
        field.to_pixels,
        without,
        1.25 * vectors.length_max + 4 * rms,
        bins,
    )
    run.close()
    order = run.posterior.model.order
    binned, rng = sums.bins.residuals(), np.random.default_rng(SEED)
    convergence = run.posterior.convergence
    return BandResult(
        name=band.name,
        path=band.path,
        simulated=head_of(run.directory.facts)["simulated"],
        converged=convergence.converged,
        reasons=tuple(convergence.reasons),
        arcsec=band.arcsec,
        size=band.chip.size,
        order=order,
        n_pairs=fit.n_rows,
        n_used=fit.n_used,
        sums=sums,
        partition=residual_partition(binned, order=order, rng=rng),
        correlation=residual_correlation(binned, order=order, rng=rng),
        vectors=vectors,
        formal_map=uncertainty_map(fit, grid=GRID, epoch=run.epoch),
        posterior_map=uncertainty_map(run.solution, grid=GRID, epoch=run.epoch),
        minus_optical=None if minus_optical is None else minus_optical.vectors(GRID),
        printed=_printed(band.name, field) if wise else None,
    )


def _printed(band: str, field: DistortionField) -> Printed:
    n = field.basis.size[0]
    # the published extremes extend to the edges of the array for W4, and to the centres of the
    # outermost pixels for the other bands
    reach = 1.0 if band == "W4" else (n - 1) / n
    side = np.linspace(-reach, reach, GRID[0])
    longest = float(np.hypot(*field.at_scaled(*np.meshgrid(side, side))).max())
    return Printed(
        LONGEST_VECTORS[band],
        longest,
        FORMAL_RADII[band],
        implied_sigma(FORMAL_RADII[band], SAMPLE_SIZES[band], order=field.basis.order),
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
