"""Published values of the WISE distortion calibration (WSDC D-T033)."""

from __future__ import annotations

from dataclasses import dataclass

WISE_BANDS = ("W1", "W2", "W3", "W4")

# Appendix B.  band: (A, B), each in the order of polynomial_terms(4): 00, 10, 01, 20, 11, 02, 30,
# ...  All values are as published except B_0_2 of W1, for which the report repeats B_1_1.  The
# value here gives the smallest closure error of the published inverse (0.0002 px rms over the
# array).  It also gives the published B_DMAX of 1.066, instead of 1.97 for the published value.
# A_1_0 of W3 is published with an extra digit; removing any one digit changes positions by at most
# 3e-7 px.
# fmt: off
WISE_COEFFICIENTS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "W1": (
        (7.228039e-01, -7.790246e-04, -1.243220e-04, -1.629945e-06, 1.344445e-06, -7.793528e-06,
         2.756392e-09, -1.186318e-10, 1.228555e-09, -2.928111e-10,
         1.794526e-12, -4.586393e-13, 1.503974e-12, -5.895443e-13, -6.270019e-13),
        (-7.946909e-02, -2.481941e-04, 3.218232e-04, -6.590985e-08, -3.541684e-06, 1.1657e-06,
         -6.360093e-11, -2.600160e-10, -4.987962e-10, -3.174803e-09,
         8.797685e-13, 7.028808e-13, -2.594371e-13, 1.458031e-12, -8.545365e-13),
    ),
    "W2": (
        (7.597772e-01, -5.040463e-04, -1.192789e-04, -1.349460e-06, 1.082862e-06, -8.064834e-06,
         2.959435e-09, -1.297961e-09, 3.389170e-10, -4.935791e-10,
         1.787756e-12, -6.743610e-13, 2.075723e-12, -5.769507e-13, -1.303108e-13),
        (-9.433609e-02, -2.026974e-04, 5.505028e-04, 8.038015e-08, -3.953933e-06, 1.091415e-06,
         1.067827e-10, 4.101600e-10, -9.316313e-10, -3.840921e-09,
         -1.788157e-13, 1.952342e-12, -5.705721e-13, 8.534495e-13, -5.181754e-13),
    ),
    "W3": (
        (7.358456e-01, -4.8377784e-04, -6.410136e-04, -1.754315e-06, 8.952514e-07, -8.308111e-06,
         2.879012e-09, -9.762929e-10, 3.550849e-10, -1.625272e-10,
         3.033166e-12, -3.960689e-12, 1.454345e-12, -9.680264e-13, 2.677086e-13),
        (-8.389715e-02, -6.788420e-04, 5.030167e-04, 5.414236e-07, -3.515651e-06, 5.610990e-07,
         8.619879e-11, 1.285471e-10, -2.476911e-10, -3.660396e-09,
         -7.304812e-13, 1.482141e-12, -2.083238e-12, 9.798616e-13, 1.671433e-14),
    ),
    "W4": (
        (4.454888e-01, -6.246135e-04, 1.798126e-04, -4.103560e-06, 1.123638e-06, -1.719398e-05,
         1.242150e-08, -2.036670e-09, 3.241247e-09, 3.413039e-10,
         1.445548e-11, -3.249992e-11, 1.857739e-11, -3.767396e-12, 3.375647e-12),
        (-5.775286e-02, -1.431559e-04, 5.474906e-04, 1.315098e-06, -7.968204e-06, 1.364385e-06,
         -5.358762e-10, 9.606579e-10, -9.571209e-10, -1.534179e-08,
         -1.173857e-11, 1.290359e-11, -1.052149e-11, 5.169349e-12, -1.931603e-12),
    ),
}
# fmt: on

# section 4: longest vector without the constant, pixels
LONGEST_VECTORS = {"W1": 2.931, "W2": 3.048, "W3": 3.004, "W4": 1.435}

# section 4: numbers of pairs; section 6: largest radius of the formal uncertainty, pixels
SAMPLE_SIZES = {"W1": 10_350_744, "W2": 11_213_542, "W3": 3_765_817, "W4": 315_505}
FORMAL_RADII = {"W1": 0.0093, "W2": 0.0082, "W3": 0.0028, "W4": 0.0026}

# Table 5-1: sigma over 31 x 31 bins of the mean residual in X and Y, pixels
RESIDUAL_SIGMAS = {
    "W1": (0.01949, 0.01159),
    "W2": (0.01679, 0.008914),
    "W3": (0.01608, 0.008846),
    "W4": (0.0236, 0.02276),
}


@dataclass(frozen=True)
class WiseArray:
    """Detector array of a band."""

    size: tuple[float, float]  # columns and rows
    scale: float  # arcsec per pixel

    @property
    def centre(self) -> tuple[float, float]:
        """Reference pixel, FITS 1-based, at which u = v = 0 in Appendix B."""
        return (self.size[0] + 1) / 2, (self.size[1] + 1) / 2


# W4 is binned 2 x 2.  The published A_DMAX and B_DMAX are the maxima for u and v within +-507.5
# pixels, the centres of the outermost pixels; for W4 within +-254 pixels, the edges of the array.
_FULL = WiseArray((1016.0, 1016.0), 2.75)
WISE_ARRAYS = {"W1": _FULL, "W2": _FULL, "W3": _FULL, "W4": WiseArray((508.0, 508.0), 5.5)}
WISE_ARCSEC = {band: array.scale for band, array in WISE_ARRAYS.items()}  # per pixel
