"""Fixtures of runs, for the files of this folder."""

from __future__ import annotations

from tests.app.conftest import figures_made, finished, no_report, quick_runs

__all__ = ["figures_made", "finished", "no_report", "quick_runs"]
