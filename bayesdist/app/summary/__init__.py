"""summary.json: what scripts read of a run."""

from __future__ import annotations

from bayesdist.app.summary.model import Sections, Summary, head_of, schema_text

__all__ = ["Sections", "Summary", "head_of", "schema_text"]
