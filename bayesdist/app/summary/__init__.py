"""summary.json: what scripts read of a run."""

from __future__ import annotations

from bayesdist.app.summary.model import Summary, head_of, schema_text

__all__ = ["Summary", "head_of", "schema_text"]
