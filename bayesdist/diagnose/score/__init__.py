"""Score tests of what a model may lack, each with its size and its power."""
