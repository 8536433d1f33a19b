"""Optical models for comparison with bands, from SIP headers or WISE meta-data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.errors import InputError
from bayesdist.formats.sip.files import read_sip
from bayesdist.formats.sip.header import SipHeader
from bayesdist.missions.wise.assess.distortion_field import DistortionField
from bayesdist.missions.wise.meta_data.meta import read_wise_meta
from bayesdist.missions.wise.rotate import rotated_sip
from bayesdist.model import Chip, PolynomialBasis
from bayesdist.products.registry import open_document

OTHER_FIELD = 1.5  # ratio of extents above which a header must be of another instrument


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
