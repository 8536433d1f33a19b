"""Calibrations: content of a file for a pipeline, as a map from pixels to a plane and back.

Nothing here reads or writes a file: formats make calibrations from files and files from
calibrations, see `bayesdist.products`.
"""
