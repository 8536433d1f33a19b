"""Compiled loops (passes) over the stars; the only package that uses numba.

Polynomials are evaluated on the fly by Horner's rule from the effective coefficients, so that no
design matrix is stored.  Sums are accumulated over fixed chunks of the data and therefore do not
depend on the number of threads.
"""

from bayesdist.infer.kernel.cache import kept_by_content

with kept_by_content():
    from bayesdist.infer.kernel.blocks import BLOCK, get_threads, pieces_of, set_threads
    from bayesdist.infer.kernel.mixture import (
        GAUSSIAN,
        NO_OUTLIERS,
        UNIFORM,
        Constants,
        log_likelihood,
    )
    from bayesdist.infer.kernel.moments import (
        PIECE,
        Moments,
        least_squares_moments,
        mixture_moments,
    )
    from bayesdist.infer.kernel.small import (
        densities,
        draw_deviations,
        gaussians,
        precisions,
        shear,
    )
    from bayesdist.infer.kernel.stars import linearised, memberships, positions, residuals, slopes
    from bayesdist.infer.kernel.truncated import (
        truncated_log_likelihood,
        truncated_memberships,
        truncated_moments,
        truncated_scores,
    )

__all__ = [
    "BLOCK",
    "GAUSSIAN",
    "NO_OUTLIERS",
    "PIECE",
    "UNIFORM",
    "Constants",
    "Moments",
    "densities",
    "draw_deviations",
    "gaussians",
    "get_threads",
    "least_squares_moments",
    "linearised",
    "log_likelihood",
    "memberships",
    "mixture_moments",
    "pieces_of",
    "positions",
    "precisions",
    "residuals",
    "set_threads",
    "shear",
    "slopes",
    "truncated_log_likelihood",
    "truncated_memberships",
    "truncated_moments",
    "truncated_scores",
]
