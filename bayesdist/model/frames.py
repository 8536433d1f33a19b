"""Exposure frames: the transformation T of one exposure by shift, rotation, scale and shear.

    T(w) = o + d + M (w - o)
    M = R(rotation) [(1 + scale) I + shear_plus diag(1, -1) + shear_cross offdiag(1, 1)]

for a position w = (u, v), with the shift d.  The origin o is fixed such that shifts and linear
terms are nearly uncorrelated.  R rotates from u towards v by an angle in radians.  Each kind of
frame adds parameters to the previous kind.  Near zero, with the quarter turn J,

    M = I + scale I + rotation J + shear_plus diag(1, -1) + shear_cross offdiag(1, 1)

Scale and shear act along the axes of w, before the rotation.  They are therefore deviations of the
detector, small at any roll angle, for which independent Gaussian priors are appropriate.

A chip may deviate from the first chip.  About the position c of its reference pixel,

    w -> w + d + L (w - c)      L = scale I + rotation J + shear_plus diag(1, -1) + shear_cross ...

with the shift d, scale, rotation and shears of this chip.  The deviations are small, so that they
are linearised.  Scale and shear of the frame then also act about c.
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

CHIP_DEVIATIONS = (*RIGID, *DEVIATIONS)  # of one chip relative to the first chip
# derivatives of M with respect to the linear parameters at zero
LINEAR_MATRICES = {
    "rotation": np.array([[0.0, -1.0], [1.0, 0.0]]),
    "scale": np.array([[1.0, 0.0], [0.0, 1.0]]),
    "shear_plus": np.array([[1.0, 0.0], [0.0, -1.0]]),
    "shear_cross": np.array([[0.0, 1.0], [1.0, 0.0]]),
}


def frame_names(kind: str) -> tuple[str, ...]:
    """Names of the parameters of a frame of this kind."""
    return _NAMES[kind]


def _rotation(angle: Float) -> Float:
    c, s = np.cos(angle), np.sin(angle)
    out = np.empty((*np.shape(angle), 2, 2))
    out[..., 0, 0] = out[..., 1, 1] = c
    out[..., 0, 1], out[..., 1, 0] = -s, s
    return out


def _parts(kind: str, p: Float) -> tuple[Float, Float]:
    """Rotation (..., 2, 2) and symmetric factor (..., 2, 2) of M, in this order."""
    names = frame_names(kind)
    symmetric = np.broadcast_to(np.eye(2), (*p.shape[:-1], 2, 2)).copy()
    for name in DEVIATIONS:
        if name in names:
            symmetric += p[..., names.index(name), None, None] * LINEAR_MATRICES[name]
    angle = p[..., names.index("rotation")] if "rotation" in names else np.zeros(p.shape[:-1])
    return _rotation(angle), symmetric


def frame_matrix(kind: str, p: ArrayLike) -> tuple[Float, Float]:
    """Linear part M (..., 2, 2) and shift d (..., 2) of frames with parameters `p` (..., q).

    `kind` is the name of the frame model, such as 'shift_rotation'.
    """
    p = np.asarray(p, float)
    rotation, symmetric = _parts(kind, p)
    return rotation @ symmetric, np.zeros((*p.shape[:-1], 2)) if kind == "none" else p[
        ..., :2
    ].copy()


def frame_tangent(kind: str, p: ArrayLike) -> Float:
    """Derivatives (..., q - 2, 2, 2) of M with respect to the parameters after the shifts.

    M is the linear part of frames of a `kind` with parameters `p` (..., q).
    """
    p = np.asarray(p, float)
    names = frame_names(kind)[2:]
    rotation, symmetric = _parts(kind, p)
    quarter_turn = LINEAR_MATRICES["rotation"]
    out = np.zeros((*p.shape[:-1], len(names), 2, 2))
    for k, name in enumerate(names):
        by_name = quarter_turn @ symmetric if name == "rotation" else LINEAR_MATRICES[name]
        out[..., k, :, :] = rotation @ by_name
    return out


def rigid_part(kind: str, p: ArrayLike) -> tuple[Float, Float]:
    """Rotation R (..., 2, 2) in M, the linear part of a frame, and its derivatives.

    The frames are of a `kind` and have the parameters `p` (..., q).  The derivatives (..., q - 2,
    2, 2) are with respect to the parameters after the shifts.
    """
    p = np.asarray(p, float)
    names = frame_names(kind)[2:]
    rotation, _ = _parts(kind, p)
    tangent = np.zeros((*p.shape[:-1], len(names), 2, 2))
    if "rotation" in names:
        tangent[..., names.index("rotation"), :, :] = rotation @ LINEAR_MATRICES["rotation"]
    return rotation, tangent


def chip_matrix(p: ArrayLike) -> tuple[Float, Float]:
    """Matrix L (..., 2, 2) and shift d (..., 2) of a chip with deviations p (..., 6).

    The parameters are in the order of `CHIP_DEVIATIONS`.  L and d are linear in p, so that their
    derivatives are the `chip_matrix` of the unit vectors.
    """
    p = np.asarray(p, float)
    L = np.zeros((*p.shape[:-1], 2, 2))
    for name, value in zip(CHIP_DEVIATIONS[2:], np.moveaxis(p, -1, 0)[2:], strict=True):
        L += value[..., None, None] * LINEAR_MATRICES[name]
    return L, p[..., :2].copy()


def nearest_frame(kind: str, M: ArrayLike, d: ArrayLike) -> Float:
    """Parameters (q,) of the frame that is closest to the map M z + d, in the Frobenius norm.

    `kind` is the name of the frame model, M a matrix (2, 2) and d a shift (2,).
    """
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
