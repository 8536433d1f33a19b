"""What all formats share: the content of a file, documents and findings, cards, coefficients."""
