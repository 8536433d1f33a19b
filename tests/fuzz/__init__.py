"""Damaged input of every kind, to every command: an answer, a warning or one sentence.

`python -m tests.fuzz --cases 2000` draws cases and counts what became of them; what failed once is
in cases/failed.jsonl, and is tried again each time.
"""
