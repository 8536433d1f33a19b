"""Star lists matched with a catalogue: patterns, linear maps, nearest neighbours, and chance."""
