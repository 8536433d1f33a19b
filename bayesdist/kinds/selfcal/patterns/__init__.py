"""Comparison of dither patterns: `bayesdist plan-dither PATTERNS.toml`."""
