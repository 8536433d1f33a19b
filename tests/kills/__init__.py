"""Runs that are killed, stopped or interrupted end as if nothing had happened.

`python -m tests.kills` strikes runs at random moments; `test_kills` is its reduced form.
"""
