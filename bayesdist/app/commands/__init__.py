"""Commands of the core: short functions with their options, which import code when needed."""
