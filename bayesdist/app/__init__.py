"""Application layer: configuration, run directories, stages, command line."""
