"""AST mappings: polynomials as text dumps, as starlink-pyast and Rubin write them."""
