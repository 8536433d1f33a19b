"""Matches in Parquet files: written, scanned, and left on disk."""
