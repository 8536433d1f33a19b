"""AST mappings: polynomials as text dumps, as written by starlink-pyast and Rubin."""
