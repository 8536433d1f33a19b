"""Values and pure functions of `match`, `fit` and `sample`, for each kind of run."""
