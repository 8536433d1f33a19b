"""What `match`, `fit` and `sample` make of each kind of run, as values and pure functions."""
