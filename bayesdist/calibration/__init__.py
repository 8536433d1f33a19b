"""Calibrations: what a file for a pipeline holds, as a map from pixels to a plane and back.

Nothing here reads or writes a file: formats are made from calibrations and give them, see
`bayesdist.products`.
"""
