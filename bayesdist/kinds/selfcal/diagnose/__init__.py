"""Tests of the residuals of self-calibrations, with the positions of the stars eliminated."""
