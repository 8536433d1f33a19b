"""Which files a path names and which format they have; formats of other programs."""
