"""Commands on files: positions, contents, a first configuration."""
