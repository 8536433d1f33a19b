"""Measurements of each band, their comparison, and the optical models compared with them.

The runs of the bands are opened and checked here.
"""

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
from bayesdist.formats.sip.files import read_sip
from bayesdist.formats.sip.header import SipHeader
from bayesdist.missions.wise.assess.account import PRINTED_BINS, accounts, partition_parts
from bayesdist.missions.wise.assess.distortion_field import (
    DistortionField,
    band_sums,
    field_of_solution,
)
from bayesdist.missions.wise.assess.residual_field import residual_correlation, residual_partition
from bayesdist.missions.wise.assess.residual_tables import implied_sigma, residual_tables
from bayesdist.missions.wise.bands.context import BandResult, BandsInput, Printed
from bayesdist.missions.wise.meta_data.meta import read_wise_meta
from bayesdist.missions.wise.published import (
    FORMAL_RADII,
    LONGEST_VECTORS,
    SAMPLE_SIZES,
    WISE_BANDS,
)
from bayesdist.missions.wise.rotate import rotated_sip
from bayesdist.model import Chip, PolynomialBasis
from bayesdist.model.basis import n_terms
from bayesdist.products.registry import open_document

GRID = (33, 33)
SEED = 20110201

SAME_FIELD = 0.01  # largest relative difference in size of the fields of two bands
# unsupported kinds of runs: section of the configuration, name, and advice
_OTHER_KINDS = (
    ("campaign", "campaign", "compare its filters by 'bayesdist release'"),
    ("selfcal", "self-calibration", "give runs of matched stars, one for each band"),
)
OTHER_FIELD = 1.5  # ratio of extents above which a header must be of another instrument


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


@dataclass(frozen=True, eq=False)
class OpticalModel:
    """Optical model of a band."""

    label: str  # file name and rotation
    sip: SipHeader  # after rotation

    def field(self, chip: Chip, arcsec: float) -> DistortionField:
        """Distortion of the model over an array with the same field of view, in its pixels.

        Raises InputError if the image of the header has another aspect ratio than the array, or its
        CD matrix implies a field of very different size.
        """
        size = self.sip.size or chip.size
        times = [n_model / n for n_model, n in zip(size, chip.size, strict=True)]
        if not np.isclose(times[0], times[1], rtol=1e-3):
            raise InputError(
                f"is for {size[0]:g} x {size[1]:g} pixels, but the array of {chip.name} has "
                f"{chip.size[0]:g} x {chip.size[1]:g}",
                where=self.label,
                do="give a model of an array of the same shape",
            )
        model_arcsec = 3600 * float(np.sqrt(abs(np.linalg.det(self.sip.cd))))
        extents = size[0] * model_arcsec, chip.size[0] * arcsec
        if max(extents) > OTHER_FIELD * min(extents):
            raise InputError(
                f"covers {extents[0] / 60:.3g} arcmin by its size and CD matrix, but {chip.name} "
                f"covers {extents[1] / 60:.3g}",
                where=self.label,
                do="give a model of the band's field, or correct size and CD of the header",
            )
        basis = PolynomialBasis(max(self.sip.order), size, self.sip.crpix)
        monomials = np.zeros((2, basis.n_terms))
        for axis, (terms, order) in enumerate(
            zip((self.sip.a, self.sip.b), self.sip.order, strict=True)
        ):
            for (p, q), value in terms.items():
                if p + q <= order:
                    monomials[axis, basis.terms.index((p, q))] = value
        # Legendre products depend only on the relative position on the array
        polynomial = basis.from_monomials(monomials) / np.array(times)[:, None]
        about = PolynomialBasis(basis.order, chip.size, chip.reference_pixel)
        return DistortionField.of(about, polynomial, np.eye(2))


def optical_models(
    paths: Sequence[str | Path], turn: float, bands: Sequence[str]
) -> dict[str, OpticalModel]:
    """Optical models by band, rotated by `turn` degrees from x towards y.

    `paths` is one file for all bands, or one per band.
    """
    if not paths:
        return {}
    if len(paths) not in (1, len(bands)):
        raise InputError(
            f"{len(paths)} optical models are given for {len(bands)} runs",
            where="--optical",
            do="give one for all runs, or one per run",
        )
    path_by_band = [*paths] * (len(bands) if len(paths) == 1 else 1)
    out = {}
    for band, path in zip(bands, path_by_band, strict=True):
        label = f"{Path(path).name}, rotated by {turn:g}°" if turn % 360 else Path(path).name
        out[band] = OpticalModel(label, rotated_sip(_sip_of(Path(path), band), turn))
    return out


def _sip_of(path: Path, band: str) -> SipHeader:
    if not path.is_file():
        raise InputError(
            "there is no such file",
            where=f"--optical {path}",
            do="give a SIP header, or WISE meta-data that contain this band",
        )
    if open_document(path).format.key != "wise_meta":
        return read_sip(path)
    entries = {f"W{entry.band}": entry.sip for entry in read_wise_meta(path)}
    if band not in entries:
        raise InputError(
            f"there is no band {band!r}", where=str(path), do=f"choose {', '.join(entries)}"
        )
    return entries[band]
