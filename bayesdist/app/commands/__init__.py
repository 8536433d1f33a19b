"""Commands of the core: `runs` and `files` declare them; the other modules do the work.

The other modules are imported when their commands are called.
"""
