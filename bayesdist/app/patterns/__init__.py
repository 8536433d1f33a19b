"""Comparison of dither patterns: `bayesdist plan PATTERNS.toml`."""
