"""Tests of the residuals of self-calibrations, whose stars are eliminated."""
