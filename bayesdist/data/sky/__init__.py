"""Sky positions: epoch propagation, effects of the Earth's motion, and tangent planes."""
