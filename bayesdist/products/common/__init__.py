"""Parts that all formats use: content of a file, documents and findings, cards, coefficients."""
