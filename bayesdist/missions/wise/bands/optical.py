"""An optical model that bands are compared with: a SIP header, or WISE meta-data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.errors import InputError
from bayesdist.missions.wise.assess.distortion_field import DistortionField
from bayesdist.model import Chip, PolynomialBasis
from bayesdist.products import SipHeader, read_sip, read_wise_meta, rotated_sip
from bayesdist.products.registry import open_document

OTHER_FIELD = 1.5  # by this factor in extent the header's image is of another instrument


@dataclass(frozen=True, eq=False)
class OpticalModel:
    """An optical model as it is compared with a band."""

    label: str  # the file, and by how much it was turned
    sip: SipHeader  # turned

    def field(self, chip: Chip, arcsec: float) -> DistortionField:
        """The model over an array that sees the same field, in that array's pixels.

        InputError when the header's image has another shape than the array, or covers a field of
        quite another size by its CD matrix.
        """
        size = self.sip.size or chip.size
        times = [own / n for own, n in zip(size, chip.size, strict=True)]
        if not np.isclose(times[0], times[1], rtol=1e-3):
            raise InputError(
                f"is for {size[0]:g} x {size[1]:g} pixels, and the array of {chip.name} has "
                f"{chip.size[0]:g} x {chip.size[1]:g}",
                where=self.label,
                do="give a model of an array of the same shape",
            )
        own_arcsec = 3600 * float(np.sqrt(abs(np.linalg.det(self.sip.cd))))
        extents = size[0] * own_arcsec, chip.size[0] * arcsec
        if max(extents) > OTHER_FIELD * min(extents):
            raise InputError(
                f"covers {extents[0] / 60:.3g} arcmin by its size and CD matrix, and {chip.name} "
                f"sees {extents[1] / 60:.3g}",
                where=self.label,
                do="give a model of the band's own field, or correct size and CD of the header",
            )
        basis = PolynomialBasis(max(self.sip.order), size, self.sip.crpix)
        monomials = np.zeros((2, basis.n_terms))
        for axis, (terms, order) in enumerate(
            zip((self.sip.a, self.sip.b), self.sip.order, strict=True)
        ):
            for (p, q), value in terms.items():
                if p + q <= order:
                    monomials[axis, basis.terms.index((p, q))] = value
        # Legendre products belong to the whole array, whatever its pixels
        polynomial = basis.from_monomials(monomials) / np.array(times)[:, None]
        about = PolynomialBasis(basis.order, chip.size, chip.reference_pixel)
        return DistortionField.of(about, polynomial, np.eye(2))


def optical_models(
    paths: Sequence[str | Path], turn: float, bands: Sequence[str]
) -> dict[str, OpticalModel]:
    """Optical models by band, turned by degrees from x towards y; one for all bands or for each."""
    if not paths:
        return {}
    if len(paths) not in (1, len(bands)):
        raise InputError(
            f"{len(paths)} optical models are given for {len(bands)} runs",
            where="--optical",
            do="give one for all runs, or one for each",
        )
    several = [*paths] * (len(bands) if len(paths) == 1 else 1)
    out = {}
    for band, path in zip(bands, several, strict=True):
        label = f"{Path(path).name}, turned by {turn:g}°" if turn % 360 else Path(path).name
        out[band] = OpticalModel(label, rotated_sip(_sip_of(Path(path), band), turn))
    return out


def _sip_of(path: Path, band: str) -> SipHeader:
    if not path.is_file():
        raise InputError(
            "there is no such file",
            where=f"--optical {path}",
            do="name a SIP header, or WISE meta-data that hold this band",
        )
    if open_document(path).format.key != "wise_meta":
        return read_sip(path)
    entries = {f"W{one.band}": one.sip for one in read_wise_meta(path)}
    if band not in entries:
        raise InputError(
            f"there is no band {band!r}", where=str(path), do=f"choose {', '.join(entries)}"
        )
    return entries[band]
