"""Whether total errors cover, and whether requirements are met as often as is said.

`python -m tests.coverage RESULTS` makes all of it in pieces that are kept in a folder, prints
the numbers and draws the figure; the tests judge the same numbers.
"""
