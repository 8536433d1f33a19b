"""A comparison in sentences: the verdict, what was removed, and which errors were used."""

from __future__ import annotations

import numpy as np

from bayesdist.assess.comparison.compare import Comparison, comparison_table
from bayesdist.assess.comparison.gap import GapDifference
from bayesdist.utils.distributions import norm_sf
from bayesdist.utils.limits import DIFFERENCE
from bayesdist.utils.numbers import p_words

IDENTICAL = 1e-9  # pixels: smaller differences are rounding


def verdict(found: Comparison, pixel_mas: float | None = None) -> str:
    """Verdict in one sentence: if the calibrations differ, by how much, and how significantly.

    `pixel_mas`: size of a pixel in mas, if neither side states it.
    """
    size = (
        f"{_length(found.rms, found, pixel_mas)} rms, at most "
        f"{_length(found.largest, found, pixel_mas)}"
    )
    if found.sigma_of_largest is not None and found.sigma_of_largest > 0:
        size += f" +- {found.sigma_of_largest:.2g} pix"
    x, y = found.position_of_largest
    size += f" at ({x:.0f}, {y:.0f})"
    if found.largest < IDENTICAL:
        return "The calibrations agree to rounding."
    if found.field is None:
        return f"The calibrations differ by {size}; {_why_untested(found)}."
    test = (
        f"chi-square {found.field.chi2:.4g} for {found.field.dof} degrees of freedom, "
        f"{p_words(found.field.p_value, 2, 1e-12)}"
    )
    if found.differs:
        return f"The calibrations differ significantly: {size} ({test})."
    return f"No significant difference: {size}, which is within the errors ({test})."


def comparison_lines(found: Comparison) -> list[str]:
    """Lines of text below the verdict."""
    keeps_similarity = not found.frame.taken.shape[1]
    lines = [
        f"{letter}  {c.name}: order {c.basis.order}, in {c.unit}"
        + (f", chip {c.chip}" if c.chip is not None else "")
        + (f", at {c.epoch:g}" if c.epoch is not None else "")
        + f", errors: {_errors(c.errors)}"
        + "".join(f"; {note}" for note in c.notes)
        for letter, c in (("A", found.a), ("B", found.b))
    ]
    lines.append("kept in the difference:" if keeps_similarity else "taken out of the difference:")
    lines += [f"  {line}" for line in _similarity(found)]
    if found.errors_of in ("A", "B"):
        exact_side = "B" if found.errors_of == "A" else "A"
        lines.append(
            f"only {found.errors_of} has errors: the significance takes {exact_side} for exact"
        )
    if found.noise_rms is not None:
        lines.append(f"the errors alone would make {found.noise_rms:.2g} pix rms")
    p_z, p_chi2 = found.p_largest_z, found.p_largest_chi2
    if found.chi2 is not None and p_z is not None and p_chi2 is not None:
        lines.append(
            f"largest |z| of the coefficients {found.largest_z:.3g}: as large somewhere by chance "
            f"with {_share(p_z)}; largest chi-square on the grid "
            f"{np.nanmax(found.chi2, initial=0.0):.3g}: {_share(p_chi2)}"
        )
    if found.field is None and found.errors_of != "none":
        lines.append(_singly(found))
    if found.unknown_rms > IDENTICAL:
        lines.append(
            f"not tested: {found.unknown_rms:.3g} pix rms in terms that only one side has, "
            "and of which no covariance speaks"
        )
    return lines


def _singly(found: Comparison) -> str:
    """Most significant coefficient, if coefficients can only be tested one by one."""
    table = comparison_table(found)
    z = np.abs(np.asarray(table["z"], float))
    tested = int(np.isfinite(z).sum())
    if not tested:
        return "no coefficient can be tested"
    k = int(np.nanargmax(z))
    row = table[k]
    p = min(1.0, tested * 2 * float(norm_sf(z[k])))  # Bonferroni: correlations are unknown
    return (
        f"most significant of {tested} coefficients: x^{row['i']} y^{row['j']} of {row['axis']}, "
        f"{z[k]:.3g} sigma, {_share(p)} for the largest of so many"
    )


def _similarity(found: Comparison) -> list[str]:
    s = found.similarity
    out = []
    if s.shift is not None:
        for axis in (0, 1):
            sigma = None if s.sigma_shift is None else s.sigma_shift[axis]
            out.append(f"shift in {'xy'[axis]}  {_measured(s.shift[axis], sigma)} pix")
    else:
        out.append("shift       not comparable: the axes or units are different")
    if s.mirrored:
        out.append("parity      A and B are mirrored against each other")
    degrees = np.degrees(s.rotation)
    sigma = None if s.sigma_rotation is None else float(np.degrees(s.sigma_rotation))
    out.append(f"rotation    {_measured(float(degrees), sigma)} deg")
    if s.same_unit:
        out.append(f"scale - 1   {_measured(s.scale - 1.0, s.sigma_scale)}")
    else:
        out.append(
            f"scale       {s.scale:.8g} {found.a.unit} of A for one {found.b.unit} of B: "
            "no difference can be told"
        )
    return out


def _measured(value: float, sigma: float | None) -> str:
    """A value with its error and significance."""
    if sigma is None:
        return f"{value:+.4g} (no errors given)"
    if not sigma > 0:
        return f"{value:+.4g}"
    return f"{value:+.4g} +- {sigma:.2g} ({abs(value) / sigma:.1f} sigma)"


def gap_verdict(gap: GapDifference) -> str:
    """Verdict in one sentence: if the position of a chip relative to the reference chip differs."""
    chips, d = f"against chip {gap.reference}", float(np.hypot(*gap.values[:2]))
    if np.abs(gap.values).max() < IDENTICAL:
        return f"Chip {gap.chip} lies alike {chips}, to rounding."
    size = f"{d:.3g} pix from where B has it"
    if gap.test is None:
        return f"Chip {gap.chip} lies {size} {chips}; neither gives errors of the gap."
    test = (
        f"shift, rotation and scale together: chi-square {gap.test.chi2:.4g} for {gap.test.dof} "
        f"degrees of freedom, {p_words(gap.test.p_value, 2, 1e-12)}"
    )
    if gap.errors_of != "both":
        test += f", on the errors of {gap.errors_of} alone"
    if gap.test.p_value < DIFFERENCE.value:
        return f"Chip {gap.chip} lies elsewhere {chips}, significantly: {size} ({test})."
    return f"Chip {gap.chip} lies alike {chips} within the errors: {size} ({test})."


def gap_lines(gap: GapDifference) -> list[str]:
    """Lines of text below the verdict on a gap: A minus B, with aligned reference chips."""
    sigma = [None] * 4 if gap.sigma is None else gap.sigma.tolist()
    shift_x, shift_y, scale, (turn, error) = zip(gap.values.tolist(), sigma, strict=True)
    in_degrees = None if error is None else float(np.degrees(error))
    return [
        f"  shift in x  {_measured(*shift_x)} pix",
        f"  shift in y  {_measured(*shift_y)} pix",
        f"  rotation    {_measured(float(np.degrees(turn)), in_degrees)} deg",
        f"  scale - 1   {_measured(*scale)}",
    ]


def _errors(kind: str) -> str:
    return {
        "none": "none given",
        "sigma": "standard deviations without correlations",
        "covariance": "full covariance",
    }[kind]


def _why_untested(found: Comparison) -> str:
    if found.errors_of == "none":
        return "neither gives errors, so that nothing can be said of significance"
    return "errors are given without their correlations: only single coefficients can be tested"


def _share(p: float) -> str:
    return f"p = {p:.2g}" + (" (significant)" if p < DIFFERENCE.value else "")


def _length(value: float, found: Comparison, pixel_mas: float | None) -> str:
    scale = pixel_mas or found.frame.pixel_mas
    text = f"{value:.3g} pix"
    return text if scale is None else f"{text} ({value * scale:.3g} mas)"
