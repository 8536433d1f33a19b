"""Commands on files: transformations, content, initial configuration."""
