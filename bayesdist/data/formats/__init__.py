"""Input files: resolution of paths, recognition of formats, and formats of other programs."""
