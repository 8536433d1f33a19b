"""Score tests for effects that a model may lack, with the size and the power of each test."""
