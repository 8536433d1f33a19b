"""Matching of star lists with a catalogue: patterns, linear maps, neighbours, and chance."""
