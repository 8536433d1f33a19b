"""Kinds of runs, each with its settings, reading, matching, fit and report.

They are found by the plugin in `bayesdist.kinds.plugin`, as kinds of other packages are; the core
imports none of them.
"""
