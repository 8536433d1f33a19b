"""Commands of the core: small functions beside their options, which load what they need."""
