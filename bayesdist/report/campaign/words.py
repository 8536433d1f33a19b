"""Names of terms and kinds of scatter in words."""

from __future__ import annotations

__all__ = ["name_of_scatter", "name_of_term"]

_TERMS = {
    "A_1": "A_1 (constant of u)",
    "A_2": "A_2 (X scale)",
    "A_3": "A_3 (angle of the Y axis)",
    "B_1": "B_1 (constant of v)",
    "B_2": "B_2 (residual rotation)",
    "B_3": "B_3 (Y scale)",
}
_SCATTER = {
    "scale": "scale",
    "shear_plus": "shear along the axes (X scale against Y scale)",
    "shear_cross": "shear across the axes (skew)",
    "shift_u": "shift in u",
    "shift_v": "shift in v",
}


def name_of_term(term: str) -> str:
    """A linear term with its meaning, as ACS ISR 2015-06 (Section 4.2) gives it."""
    return _TERMS.get(term, term)


def name_of_scatter(kind: str) -> str:
    """In what the exposures scatter; a chip that does so by itself comes first."""
    chip, _, bare = kind.rpartition(".")
    text = _SCATTER.get(bare, bare.replace("_", " "))
    return f"{chip} against the others: {text}" if chip else f"all chips together: {text}"
