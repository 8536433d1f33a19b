"""Matched stars as columns of a model: in memory, on disk, in a cluster; and their likelihood."""
