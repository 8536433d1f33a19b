"""Matches in Parquet files: writing, scanning, and reading from disk in batches."""
