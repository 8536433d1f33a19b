"""Distortion reference files of Roman's Wide Field Instrument: ASDF, as romancal reads them."""
