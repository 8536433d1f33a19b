"""Comparison of two calibrations: where and by how much they differ, and how significantly.

`compare` transforms both calibrations to a common frame and tests the difference that remains. Its
chi-square over the whole field does not depend on how shift, rotation and scale are removed: with
the covariance of the remaining difference, every linear method gives the same value, with four
degrees of freedom fewer.

The result can be shown as tables, or in sentences that give the verdict, what was removed, and
which errors were used. Offsets between chips have separate tables and verdicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.table import Table

from bayesdist.assess.comparison.frame import (
    CommonFrame,
    FrameSimilarity,
    GapDifference,
    common_frame,
    draws_of_sum,
    with_errors,
)
from bayesdist.assess.maps import sigmas_of
from bayesdist.calibration.chip_map import ChipMap, position_moments
from bayesdist.errors import required
from bayesdist.infer.equations.scaled import FieldTest, chi_square, known_terms
from bayesdist.model import AXES
from bayesdist.model.basis import point_blocks
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh, position_of_largest
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import DIFFERENCE
from bayesdist.utils.distributions import norm_sf
from bayesdist.utils.text import p_words

__all__ = [
    "Comparison",
    "compare",
    "comparison_table",
    "difference_table",
    "gap_table",
    "term_sigmas",
]
NOISE_SEED = 20150206  # seed of the noise fields, so that a comparison is reproducible
IDENTICAL = 1e-9  # pixels: smaller differences are rounding


@dataclass(frozen=True, eq=False)
class Comparison:
    """Difference that remains between two calibrations, in undistorted pixels of A.

    Parameters
    ----------
    a, b : ChipMap
        The two calibrations.
    frame : CommonFrame
        The difference A - B as a polynomial, and what was removed from it.
    x : ndarray, shape (nx,)
        Columns of the grid, FITS 1-based pixels.
    y : ndarray, shape (ny,)
        Rows of the grid, FITS 1-based pixels.
    du, dv : ndarray, shape (ny, nx)
        The difference along x and y.
    sigma_u, sigma_v, correlation : ndarray, shape (ny, nx), optional
        Errors of the difference; None without a covariance.
    chi2 : ndarray, shape (ny, nx), optional
        Chi-square of both axes, with two degrees of freedom; NaN where the errors are zero.
    field : FieldTest, optional
        Test of all terms with known errors.
    unknown_rms : float
        Rms over the detector of the terms without a covariance; 0 if there are none.
    largest_z : float, optional
        Largest Legendre coefficient in units of its error.
    p_largest_z, p_largest_chi2 : float, optional
        Fraction of noise fields in which the largest ``|z|``, or the largest chi-square on the
        grid, is at least as large; this accounts for the number of values searched.
    """

    a: ChipMap
    b: ChipMap
    frame: CommonFrame
    x: Float
    y: Float
    du: Float
    dv: Float
    sigma_u: Float | None
    sigma_v: Float | None
    correlation: Float | None
    chi2: Float | None
    field: FieldTest | None
    unknown_rms: float
    largest_z: float | None
    p_largest_z: float | None
    p_largest_chi2: float | None

    @property
    def similarity(self) -> FrameSimilarity:
        """Shift, rotation and scale between the calibrations."""
        return self.frame.similarity

    @property
    def length(self) -> Float:
        """Length (ny, nx) of the difference, in pixels of A."""
        return np.hypot(self.du, self.dv)

    @property
    def largest(self) -> float:
        """Largest difference on the grid, in pixels of A."""
        return float(self.length.max())

    @property
    def position_of_largest(self) -> tuple[float, float]:
        """Pixel (x, y) of the largest difference."""
        return position_of_largest(self.length, self.x, self.y)

    @property
    def sigma_of_largest(self) -> float | None:
        """Standard error along the largest difference, in pixels of A; None without errors."""
        if self.sigma_u is None or self.sigma_v is None or self.correlation is None:
            return None
        k = np.unravel_index(int(self.length.argmax()), self.length.shape)
        along = np.array([self.du[k], self.dv[k]]) / max(self.length[k], 1e-300)
        su, sv, rho = self.sigma_u[k], self.sigma_v[k], self.correlation[k]
        cov = np.array([[su**2, rho * su * sv], [rho * su * sv, sv**2]])
        return float(np.sqrt(along @ cov @ along))

    @property
    def rms(self) -> float:
        """Rms length of the difference over the detector, in pixels of A."""
        return float(np.sqrt(self.frame.norm @ self.frame.difference.ravel() ** 2))

    @property
    def noise_rms(self) -> float | None:
        """Rms length (pixels) of the difference expected from the errors; None without errors."""
        if self.sigma_u is None or self.frame.cov is None:
            return None
        return float(np.sqrt(self.frame.norm @ np.diag(self.frame.cov)))

    @property
    def errors_of(self) -> str:
        """Calibrations with known errors: 'both', 'A', 'B' or 'none'."""
        return with_errors(self.a.cov, self.b.cov)

    @property
    def differs(self) -> bool | None:
        """True if the difference is significant; None if the errors are unknown."""
        return None if self.field is None else self.field.p_value < DIFFERENCE.value


def compare(
    a: ChipMap,
    b: ChipMap,
    *,
    rng: np.random.Generator,
    grid: tuple[int, int] = DEFAULT_GRID,
    keep: bool = False,
    n_draws: int = 2000,
) -> Comparison:
    """Compare two calibrations of one detector.

    Parameters
    ----------
    a, b : ChipMap
        Calibrations with independent errors.
    rng : numpy.random.Generator
        Generator of the noise fields.
    grid : tuple of int
        Number of points along x and y.
    keep : bool
        True to keep shift, rotation and scale in the difference.
    n_draws : int
        Number of noise fields. Probabilities are never stated below 1 / (n_draws + 1).

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If the grid is invalid; see also `common_frame`.
    """
    frame = common_frame(a, b, keep=keep)
    basis, d = frame.basis, frame.difference
    x, y = grid_pixels(basis.size, grid)
    X, Y = mesh(x, y)
    shape = (y.size, x.size)
    phi = np.concatenate([basis.evaluate(X[rows], Y[rows]) for rows in point_blocks(X.size)])
    du, dv = d @ phi.T
    tested = frame.cov is not None and a.correlated and b.correlated
    sigma_u = sigma_v = correlation = chi2 = field = None
    z_max = p_z = p_chi2 = None
    unknown = 0.0
    if tested and frame.cov is not None and frame.raw_cov is not None:
        K = basis.n_terms
        uu, vv, uv = position_moments(frame.cov.reshape(2, K, 2, K), basis, X, Y)
        chi2 = _of_two(du, dv, uu, vv, uv)
        sigma_u, sigma_v, correlation = (values.reshape(shape) for values in sigmas_of(uu, vv, uv))
        draws = draws_of_sum(zip(frame.shares, (a, b), strict=True))
        field = chi_square(
            d.ravel(), frame.raw_cov, without=frame.taken, norm=frame.norm, draws=draws
        )
        untested = ~known_terms(frame.raw_cov)
        untested[[0, K]] &= not frame.taken.shape[1]
        unknown = float(np.sqrt(frame.norm[untested] @ d.ravel()[untested] ** 2))
        sigma = term_sigmas(frame)
        noise = rng.standard_normal((n_draws, 2 * K)) @ _root(frame.cov).T
        tested_terms = sigma > 0
        z_max = float(np.abs(d.ravel()[tested_terms] / sigma[tested_terms]).max(initial=0.0))
        p_z = _share(
            np.abs(noise[:, tested_terms] / sigma[tested_terms]).max(axis=1, initial=0.0), z_max
        )
        fields = (n.reshape(2, K) @ phi.T for n in noise)
        noise_chi2 = np.array(
            [_of_two(along_x, along_y, uu, vv, uv) for along_x, along_y in fields]
        )
        top = float(np.nanmax(chi2, initial=0.0))
        p_chi2 = _share(np.nanmax(noise_chi2, axis=1, initial=0.0), top)
        chi2 = chi2.reshape(shape)
    return Comparison(
        a=a,
        b=b,
        frame=frame,
        x=x,
        y=y,
        du=du.reshape(shape),
        dv=dv.reshape(shape),
        sigma_u=sigma_u,
        sigma_v=sigma_v,
        correlation=correlation,
        chi2=chi2,
        field=field,
        unknown_rms=unknown,
        largest_z=z_max,
        p_largest_z=p_z,
        p_largest_chi2=p_chi2,
    )


def term_sigmas(frame: CommonFrame) -> Float:
    """Standard deviations (2 K,) of the difference in pixels; 0 for terms that were removed."""
    variance, raw = (
        np.diag(required(cov, "neither calibration has errors"))
        for cov in (frame.cov, frame.raw_cov)
    )
    return np.sqrt(np.where(variance > 1e-16 * raw, variance, 0.0))


def _of_two(du: Float, dv: Float, uu: Float, vv: Float, uv: Float) -> Float:
    """Chi-square of both axes at each point."""
    det = uu * vv - uv**2
    value = vv * du**2 - 2 * uv * du * dv + uu * dv**2
    return np.divide(value, det, out=np.full(det.shape, np.nan), where=det > 1e-12 * uu * vv)


def _root(cov: Float) -> Float:
    values, vectors = np.linalg.eigh(cov)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _share(noise: Float, value: float) -> float:
    """Fraction of noise values that are at least as large as a value."""
    return float((1 + (noise >= value).sum()) / (len(noise) + 1))


def comparison_table(found: Comparison) -> Table:
    """Table of the difference of each coefficient.

    Returns columns form ('legendre': products of Legendre polynomials over the detector;
    'monomial': powers of pixel offsets from the reference pixel of A), axis, i, j, difference,
    sigma and z (NaN if no error is known or the term was removed), unit.
    """
    frame = found.frame
    K, basis = frame.basis.n_terms, frame.basis
    to_monomials = np.kron(np.eye(2), basis.monomial_matrix)
    forms: dict[str, tuple[Float, Float | None]] = {
        "legendre": (frame.difference.ravel(), None),
        "monomial": (to_monomials @ frame.difference.ravel(), None),
    }
    if frame.cov is not None:
        sigma = term_sigmas(frame)
        of_monomials = np.sqrt(
            np.maximum(np.einsum("ij,jk,ik->i", to_monomials, frame.cov, to_monomials), 0.0)
        )
        correlated = found.a.correlated and found.b.correlated
        forms["legendre"] = (forms["legendre"][0], sigma if correlated else None)
        forms["monomial"] = (forms["monomial"][0], of_monomials)
    rows = []
    for form, (values, errors) in forms.items():
        for n in range(2 * K):
            i, j = basis.terms[n % K]
            sigma_n = np.nan if errors is None or not errors[n] > 0 else float(errors[n])
            if form == "monomial" and not (found.a.correlated and found.b.correlated) and i + j < 2:
                sigma_n = np.nan  # needs correlations, which are unknown
            unit = "pix" if form == "legendre" else _unit(i + j)
            value = float(values[n])
            rows.append((form, AXES[n // K], i, j, value, sigma_n, value / sigma_n, unit))
    names = ("form", "axis", "i", "j", "difference", "sigma", "z", "unit")
    return Table(rows=rows, names=names)


def _unit(order: int) -> str:
    """Unit of the coefficient of a monomial, for positions in pixels."""
    return {0: "pix", 1: ""}.get(order, f"pix^{1 - order}")


def difference_table(found: Comparison) -> Table:
    """Table of the difference at each point of the grid.

    Returns columns x, y, du, dv and, if errors are known, sigma_u, sigma_v, correlation, chi2; in
    pixels.
    """
    X, Y = np.meshgrid(found.x, found.y)
    columns = {"x": X, "y": Y, "du": found.du, "dv": found.dv}
    for name in ("sigma_u", "sigma_v", "correlation", "chi2"):
        values = getattr(found, name)
        if values is not None:
            columns[name] = values
    table = Table({name: values.ravel() for name, values in columns.items()})
    for name in table.colnames:
        if name not in ("correlation", "chi2"):
            table[name].unit = "pix"
    return table


def gap_table(gaps: Sequence[GapDifference]) -> Table:
    """Table of the offsets of chips from the reference chip, A minus B.

    `gaps`: one per chip, without the reference chip. Returns columns chip, reference, quantity,
    difference, sigma and z (NaN without errors), unit.
    """
    quantities = (("shift_x", "pix"), ("shift_y", "pix"), ("scale", ""), ("rotation", "rad"))
    rows = []
    for gap in gaps:
        sigma = np.full(4, np.nan) if gap.sigma is None else gap.sigma
        for (name, unit), value, error in zip(quantities, gap.values, sigma, strict=True):
            z = value / error if error > 0 else np.nan
            rows.append((gap.chip, gap.reference, name, float(value), float(error), float(z), unit))
    names = ("chip", "reference", "quantity", "difference", "sigma", "z", "unit")
    return Table(rows=rows, names=names)


def verdict(found: Comparison, pixel_mas: float | None = None) -> str:
    """Verdict in one sentence: whether the calibrations differ, by how much, and how significantly.

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
    """Lines of text with the details of a comparison, which follow the verdict."""
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
            f"with {_probability_words(p_z)}; largest chi-square on the grid "
            f"{np.nanmax(found.chi2, initial=0.0):.3g}: {_probability_words(p_chi2)}"
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
        f"{z[k]:.3g} sigma, {_probability_words(p)} for the largest of so many"
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
    """Verdict in one sentence: whether the position of a chip relative to the first one differs."""
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


def _probability_words(p: float) -> str:
    return f"p = {p:.2g}" + (" (significant)" if p < DIFFERENCE.value else "")


def _length(value: float, found: Comparison, pixel_mas: float | None) -> str:
    scale = pixel_mas or found.frame.pixel_mas
    text = f"{value:.3g} pix"
    return text if scale is None else f"{text} ({value * scale:.3g} mas)"
