"""Kinds of truth whose map, or catalogue, is not what is fitted; all at one time."""

from __future__ import annotations

import numpy as np

from . import fields
from .truth import Truth, catalogue_row, kind, mapped, observed, order_config, pixels

STRUCTURE = (
    *("structure", "unmodelled", "leaves out", "correlated", "err together", "misfit"),
    *("discrepancy", "does not describe", "repeat", "edges"),
)
ORDER = (*STRUCTURE, "order")
CATALOGUE_WORDS = ("catalogue", "catalog", "reference frame")


def of_map(rng: np.random.Generator, n: int, *parts: fields.Field, order: int = 3) -> Truth:
    """Even stars of a polynomial of order 3 and what comes beside it."""
    true_map = mapped(fields.distortion(rng), *parts)
    x, y = pixels(rng, n)
    return Truth(observed(rng, x, y, true_map(x, y, None)), true_map, order_config(order))


@kind("inside_5000", n=5000, inside=True)
@kind("inside_1500", n=1500, inside=True)
@kind("inside_300", n=300, inside=True)
def inside(rng: np.random.Generator, n: int) -> Truth:
    """What is fitted is what is true."""
    return of_map(rng, n)


@kind("inside_t_noise", inside=True, n=1500)
def inside_t(rng: np.random.Generator, n: int) -> Truth:
    """Errors are Student's t with 5 degrees of freedom, of the quoted standard deviation."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    noise = 0.02 * rng.standard_t(5, (n, 2)) / np.sqrt(5 / 3)
    return Truth(observed(rng, x, y, true_map(x, y, None), noise=noise), true_map, order_config(3))


@kind("order_too_high", inside=True, n=1500)
def order_too_high(rng: np.random.Generator, n: int) -> Truth:
    """The truth has order 2, and order 5 is fitted."""
    true_map = mapped(fields.distortion(rng, 2))
    x, y = pixels(rng, n)
    return Truth(observed(rng, x, y, true_map(x, y, None)), true_map, order_config(5))


@kind("two_orders_more", *ORDER, rms=0.003, orders=(4, 5))
@kind("one_order_more_10", *ORDER, rms=0.010, orders=(4,))
@kind("one_order_more_3", *ORDER, rms=0.003, orders=(4,))
@kind("one_order_more_1", *ORDER, rms=0.001, orders=(4,))
def higher_order(rng: np.random.Generator, n: int, rms: float, orders: tuple[int, ...]) -> Truth:
    """The truth has terms above the order that is fitted, of exactly this rms together."""
    more = fields.random_polynomial(rng, dict.fromkeys(orders, 1.0))
    return of_map(rng, n, fields.of_rms(more, rms))


@kind("smooth_500", *STRUCTURE, n=3000, scale=500, rms=0.003)
@kind("smooth_270_matern", *STRUCTURE, n=3000, scale=270, rms=0.004, roughness=1.5)
@kind("smooth_270_faint", *STRUCTURE, scale=270, rms=0.002)
@kind("smooth_270", *STRUCTURE, n=3000, scale=270, rms=0.004)
@kind("smooth_100", *STRUCTURE, n=3000, scale=100, rms=0.005)
def smooth(
    rng: np.random.Generator, n: int, scale: float, rms: float, roughness: float | None = None
) -> Truth:
    """A Gaussian random field beside the polynomial."""
    return of_map(rng, n, fields.smooth(rng, scale, rms, roughness))


@kind("lithography_300", *STRUCTURE, n=3000, period=300.0)
@kind("lithography_68", *STRUCTURE, n=3000, period=68.2)
def lithography(rng: np.random.Generator, n: int, period: float) -> Truth:
    """Columns and rows are displaced periodically."""
    return of_map(rng, n, fields.ridges(rng, period, 0.004))


@kind("columns", *STRUCTURE, n=3000)
def columns(rng: np.random.Generator, n: int) -> Truth:
    """Each 40 columns have an offset of their own along u, 0.006 px rms."""
    offset = 0.006 * rng.standard_normal(fields.SIDE // 40 + 1)

    def steps(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        own = offset[np.clip((np.asarray(x) - 0.5) // 40, 0, len(offset) - 1).astype(int)]
        return np.stack([own, np.zeros_like(own)], axis=-1)

    return of_map(rng, n, steps)


@kind("dead_amplifier", *STRUCTURE, n=3000)
def dead_amplifier(rng: np.random.Generator, n: int) -> Truth:
    """One quadrant is displaced by 0.005 px."""
    return of_map(rng, n, fields.quadrant((0.004, -0.003)))


@kind("stitching", *STRUCTURE, n=3000)
def stitching(rng: np.random.Generator, n: int) -> Truth:
    """The upper half is displaced by 0.004 px and turned a little."""
    return of_map(rng, n, fields.stitching(0.004, 2e-6))


@kind("edges", *STRUCTURE, "edge", n=3000)
def edges(rng: np.random.Generator, n: int) -> Truth:
    """Within 60 px of the edges positions are drawn outwards by up to 0.02 px."""
    return of_map(rng, n, fields.edges(0.02, 60.0))


@kind("tree_rings", *STRUCTURE, n=3000)
def tree_rings(rng: np.random.Generator, n: int) -> Truth:
    """Rings of a period of 80 to 400 px."""
    return of_map(rng, n, fields.tree_rings(rng, 0.003))


@kind("bump_at_edge", *STRUCTURE, "edge", kindest=True, n=2500)
def bump_at_edge(rng: np.random.Generator, n: int) -> Truth:
    """The detector bulges about a point of one edge: 0.06 px, over 250 px."""
    along = rng.uniform(300, fields.SIDE - 300)

    def bump(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        away = np.stack([np.asarray(x, float) - fields.SIDE, np.asarray(y, float) - along], axis=-1)
        square = (away**2).sum(axis=-1, keepdims=True) / 250.0**2
        return 0.06 * away / 250.0 * np.exp((1 - square) / 2)

    return of_map(rng, n, bump)


@kind("pixel_phase_corner", *STRUCTURE, "pixel", kindest=True, n=2500)
def pixel_phase_corner(rng: np.random.Generator, n: int) -> Truth:
    """Images are undersampled in one corner, where the phase of the pixel displaces stars."""
    wave = fields.ridges(rng, 1.0, 0.04)

    def phase(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        undersampled = ((1 + fields.scaled(x)) * (1 + fields.scaled(y)) / 4)[..., None]
        return undersampled * wave(x, y)

    return of_map(rng, n, phase)


@kind("quantised_third", *STRUCTURE, "pixel", kindest=True, n=2500)
def quantised_third(rng: np.random.Generator, n: int) -> Truth:
    """On a third of the columns a list has centroids that are cut off after a digit that stands
    for 0.04 px; the true map is that of the stars themselves."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    uv = true_map(x, y, None)
    cut = np.maximum(np.floor(x / 0.04) * 0.04, 0.5)
    stars = observed(rng, np.where(x > 2 / 3 * fields.SIDE, cut, x), y, uv)
    return Truth(stars, true_map, order_config(3))


@kind("catalogue_zones", *CATALOGUE_WORDS, *STRUCTURE, kindest=True, n=2500)
def catalogue_zones(rng: np.random.Generator, n: int) -> Truth:
    """The catalogue was put together from 16 plates, which are displaced by 0.008 px each."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, n)
    plates = 0.008 * rng.standard_normal((4, 4, 2))
    i, j = (np.minimum((at - 0.5) // (fields.SIDE / 4), 3).astype(int) for at in (x, y))
    return Truth(
        observed(rng, x, y, true_map(x, y, None) + plates[i, j]), true_map, order_config(3)
    )


@kind("catalogue_listed", *CATALOGUE_WORDS, n=3000, listed=True)
@kind("catalogue_unlisted", *CATALOGUE_WORDS, n=3000, listed=False)
def catalogue(rng: np.random.Generator, n: int, listed: bool) -> Truth:
    """The catalogue has a distortion of its own, 0.02 px rms on each axis, nearly all of it of
    orders that the fit takes for the detector's."""
    true_map = mapped(fields.distortion(rng))
    low = fields.random_polynomial(rng, dict.fromkeys(range(4), 1.0))
    own = fields.total(fields.of_rms(low, 0.02), fields.smooth(rng, 270, 0.002))
    x, y = pixels(rng, n)
    config = order_config(3)
    config["budget"] = [catalogue_row(0.02)] if listed else []
    stars = observed(rng, x, y, true_map(x, y, None) + own(x, y), offset=0.0)
    return Truth(stars, true_map, config)


@kind("gap", "stars cover", "extrapolat", "without stars", *ORDER)
def gap(rng: np.random.Generator, n: int) -> Truth:
    """Stars lie in clusters, none on the right third; the truth has a little of order 4."""
    more = fields.of_rms(fields.random_polynomial(rng, {4: 1.0}), 0.002)
    true_map = mapped(fields.distortion(rng), more)
    centres = rng.uniform(100, [1250, 1950], (8, 2))
    at = np.concatenate(
        [
            centres[rng.integers(8, size=20 * n)] + rng.normal(0, 120, (20 * n, 2)),
            rng.uniform(1, [1300, fields.SIDE], (n // 4, 2)),
        ]
    )
    on = (at.min(axis=1) > 0.5) & (at[:, 0] < 1365) & (at[:, 1] < fields.SIDE + 0.5)
    x, y = rng.permutation(at[on])[:n].T
    return Truth(observed(rng, x, y, true_map(x, y, None)), true_map, order_config(3))
