"""The program: configuration, run directories, stages, command line."""
