"""The transformation T_e of one exposure: shift, rotation, scale, or a general linear map.

    T(w) = o + d + M (w - o)

about a fixed origin o, so that shifts and linear terms are nearly uncorrelated.  The linear kinds
are linear in their parameters; only 'shift_rotation' is not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["FRAME_KINDS", "frame_matrix", "frame_names", "frame_tangent", "nearest_frame"]

Float = NDArray[np.float64]

_NAMES: dict[str, tuple[str, ...]] = {
    "none": (),
    "shift": ("shift_u", "shift_v"),
    "shift_rotation": ("shift_u", "shift_v", "rotation"),
    # M = [[1 + scale, -rotation], [rotation, 1 + scale]]: s cos(a) - 1 and s sin(a)
    "shift_rotation_scale": ("shift_u", "shift_v", "scale", "rotation"),
    "affine": ("shift_u", "shift_v", "m_uu", "m_uv", "m_vu", "m_vv"),
}

FRAME_KINDS = tuple(_NAMES)


def frame_names(kind: str) -> tuple[str, ...]:
    """Names of the parameters of one exposure's frame."""
    return _NAMES[kind]


def frame_matrix(kind: str, p: ArrayLike) -> tuple[Float, Float]:
    """Linear part and shift of T.

    Parameters
    ----------
    kind : str
        One of `FRAME_KINDS`.
    p : array_like, shape (..., q)
        Parameters, in the order of `frame_names`.

    Returns
    -------
    M : ndarray, shape (..., 2, 2)
    d : ndarray, shape (..., 2)
    """
    p = np.asarray(p, float)
    lead = p.shape[:-1]
    M = np.broadcast_to(np.eye(2), (*lead, 2, 2)).copy()
    d = np.zeros((*lead, 2))
    if kind == "none":
        return M, d
    d[...] = p[..., :2]
    if kind == "shift_rotation":
        c, s = np.cos(p[..., 2]), np.sin(p[..., 2])
        M[..., 0, 0], M[..., 0, 1], M[..., 1, 0], M[..., 1, 1] = c, -s, s, c
    elif kind == "shift_rotation_scale":
        M[..., 0, 0] += p[..., 2]
        M[..., 1, 1] += p[..., 2]
        M[..., 0, 1] = -p[..., 3]
        M[..., 1, 0] = p[..., 3]
    elif kind == "affine":
        M += p[..., 2:].reshape(*lead, 2, 2)
    return M, d


def frame_tangent(kind: str, p: ArrayLike) -> Float:
    """Derivatives of M by each parameter after the two shifts.

    Parameters
    ----------
    kind : str
    p : array_like, shape (q,)

    Returns
    -------
    ndarray, shape (q - 2, 2, 2), or (0, 2, 2) where there is none
    """
    if kind in ("none", "shift"):
        return np.zeros((0, 2, 2))
    if kind == "shift_rotation":
        a = float(np.asarray(p, float)[2])
        return np.array([[[-np.sin(a), -np.cos(a)], [np.cos(a), -np.sin(a)]]])
    if kind == "shift_rotation_scale":
        return np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.0, -1.0], [1.0, 0.0]]])
    return np.eye(4).reshape(4, 2, 2)


def nearest_frame(kind: str, M: ArrayLike, d: ArrayLike) -> Float:
    """Parameters of the frame of a kind that is nearest to a general linear map.

    Parameters
    ----------
    kind : str
    M : array_like, shape (2, 2)
    d : array_like, shape (2,)

    Returns
    -------
    ndarray, shape (q,)
    """
    M = np.asarray(M, float)
    d = np.asarray(d, float)
    c = (M[0, 0] + M[1, 1]) / 2  # the similarity nearest in the Frobenius norm
    s = (M[1, 0] - M[0, 1]) / 2
    linear = {
        "none": [],
        "shift": [],
        "shift_rotation": [np.arctan2(s, c)],
        "shift_rotation_scale": [c - 1.0, s],
        "affine": (M - np.eye(2)).ravel(),
    }[kind]
    return np.concatenate([d, linear]) if kind != "none" else np.zeros(0)
