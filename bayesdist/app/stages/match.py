"""Stage 'match': stars of lists, matched with a catalogue or with each other."""

from __future__ import annotations

from bayesdist.app.results import Results

__all__ = ["run_match"]


def run_match(results: Results) -> Results:
    """Match, and write what was found."""
    run, kind, config, base = results.run, results.kind, results.config, results.base
    matched = kind.match(results.inputs, config, base)
    matched.save(run.path)
    run.summarise(**{matched.section: matched.facts})
    # rows may name the files that they lie in from now on, as for a run that is resumed
    return results.having(matched=matched.reopened(run.path, config))
