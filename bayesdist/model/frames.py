"""The transformation T_e of one exposure: shift, rotation, scale, shear.

    T(w) = o + d + M (w - o)
    M = R(rotation) [(1 + scale) I + shear_plus diag(1, -1) + shear_cross offdiag(1, 1)]

about a fixed origin o, so that shifts and linear terms are nearly uncorrelated.  R turns u towards
v by an angle in radians.  Each kind has the parameters of the one before it and some more, with the
same meaning.  Scale and shear act along the axes of w, before the rotation: they are deviations of
the detector, small at any roll angle, and a Gaussian prior on each of them by itself makes sense.
Near zero, M = I + scale I + rotation J + shear_plus diag(1, -1) + shear_cross offdiag(1, 1).

A chip may deviate by itself from the one that the frame is bound to.  About the position c of its
reference pixel,

    w -> w + d + L (w - c)      L = scale I + rotation J + shear_plus diag(1, -1) + shear_cross ...

These are small, and taken as linear.  Scale and shear of the frame then act about c too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.utils.arrays import Float

_NAMES: dict[str, tuple[str, ...]] = {
    "none": (),
    "shift": ("shift_u", "shift_v"),
    "shift_rotation": ("shift_u", "shift_v", "rotation"),
    "shift_rotation_scale": ("shift_u", "shift_v", "scale", "rotation"),
    "affine": ("shift_u", "shift_v", "scale", "rotation", "shear_plus", "shear_cross"),
}

FRAME_KINDS = tuple(_NAMES)

RIGID = ("shift_u", "shift_v", "rotation")  # pointing of the telescope
DEVIATIONS = ("scale", "shear_plus", "shear_cross")  # deviations of the detector from its mean

CHIP_DEVIATIONS = (*RIGID, *DEVIATIONS)  # of one chip against the reference chip

# matrices that the linear parameters multiply near zero
LINEAR_MATRICES = {
    "rotation": np.array([[0.0, -1.0], [1.0, 0.0]]),
    "scale": np.array([[1.0, 0.0], [0.0, 1.0]]),
    "shear_plus": np.array([[1.0, 0.0], [0.0, -1.0]]),
    "shear_cross": np.array([[0.0, 1.0], [1.0, 0.0]]),
}


def frame_names(kind: str) -> tuple[str, ...]:
    """Names of the parameters of one exposure's frame."""
    return _NAMES[kind]


def _rotation(angle: Float) -> Float:
    c, s = np.cos(angle), np.sin(angle)
    out = np.empty((*np.shape(angle), 2, 2))
    out[..., 0, 0] = out[..., 1, 1] = c
    out[..., 0, 1], out[..., 1, 0] = -s, s
    return out


def _parts(kind: str, p: Float) -> tuple[Float, Float]:
    """Rotation (..., 2, 2), and the symmetric factor after it (..., 2, 2)."""
    names = frame_names(kind)
    behind = np.broadcast_to(np.eye(2), (*p.shape[:-1], 2, 2)).copy()
    for name in DEVIATIONS:
        if name in names:
            behind += p[..., names.index(name), None, None] * LINEAR_MATRICES[name]
    angle = p[..., names.index("rotation")] if "rotation" in names else np.zeros(p.shape[:-1])
    return _rotation(angle), behind


def frame_matrix(kind: str, p: ArrayLike) -> tuple[Float, Float]:
    """Linear part M (..., 2, 2) and shift d (..., 2) of T, for parameters (..., q)."""
    p = np.asarray(p, float)
    turn, behind = _parts(kind, p)
    return turn @ behind, np.zeros((*p.shape[:-1], 2)) if kind == "none" else p[..., :2].copy()


def frame_tangent(kind: str, p: ArrayLike) -> Float:
    """Derivatives (..., q - 2, 2, 2) of M by each parameter after the two shifts."""
    p = np.asarray(p, float)
    names = frame_names(kind)[2:]
    turn, behind = _parts(kind, p)
    quarter = LINEAR_MATRICES["rotation"]
    out = np.zeros((*p.shape[:-1], len(names), 2, 2))
    for k, name in enumerate(names):
        by_name = quarter @ behind if name == "rotation" else LINEAR_MATRICES[name]
        out[..., k, :, :] = turn @ by_name
    return out


def rigid_part(kind: str, p: ArrayLike) -> tuple[Float, Float]:
    """Rotation R (..., 2, 2) in M, and its derivatives (..., q - 2, 2, 2) after the two shifts."""
    p = np.asarray(p, float)
    names = frame_names(kind)[2:]
    turn, _ = _parts(kind, p)
    tangent = np.zeros((*p.shape[:-1], len(names), 2, 2))
    if "rotation" in names:
        tangent[..., names.index("rotation"), :, :] = turn @ LINEAR_MATRICES["rotation"]
    return turn, tangent


def chip_matrix(p: ArrayLike) -> tuple[Float, Float]:
    """Matrix L (..., 2, 2) and shift d (..., 2) of a chip's deviations (..., 6), `CHIP_DEVIATIONS`.

    L is linear in p: `chip_matrix` of the unit vectors is its derivative.
    """
    p = np.asarray(p, float)
    L = np.zeros((*p.shape[:-1], 2, 2))
    for name, value in zip(CHIP_DEVIATIONS[2:], np.moveaxis(p, -1, 0)[2:], strict=True):
        L += value[..., None, None] * LINEAR_MATRICES[name]
    return L, p[..., :2].copy()


def nearest_frame(kind: str, M: ArrayLike, d: ArrayLike) -> Float:
    """Parameters (q,) of the frame of a kind nearest to a linear map, in the Frobenius norm."""
    M = np.asarray(M, float)
    # M z = a z + b conj(z) with z = u + i v; a is the similarity nearest to M
    a = complex(M[0, 0] + M[1, 1], M[1, 0] - M[0, 1]) / 2
    b = complex(M[0, 0] - M[1, 1], M[1, 0] + M[0, 1]) / 2
    angle = float(np.angle(a))
    shear = b * np.exp(-1j * angle)
    shift = np.asarray(d, float)
    value = {
        "shift_u": shift[0],
        "shift_v": shift[1],
        "scale": abs(a) - 1.0,
        "rotation": angle,
        "shear_plus": shear.real,
        "shear_cross": shear.imag,
    }
    return np.array([value[name] for name in frame_names(kind)])
