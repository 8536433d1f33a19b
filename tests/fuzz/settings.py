"""Configurations that have most of the sections there are."""

MATCHED = """\
[data]
matches = "stars.ecsv"
sigma = "columns"
not_finite = "reject"

[detector]
name = "A"
mission = "M"
instrument = "I"
filter = "F"
size = [1000, 800]
scale_mas = 50.0

[model]
order = 2
reference_pixel = [500.5, 400.5]
frames = "none"

[fit]
clip_chi2 = 25.0
clip_abs = 2.0
radial_weight = 1.0

[outliers]
model = "gaussian"

[sampler]
seed = 1
target_ess = 100
target_rhat = 1.05

[compute]
engine = "threads"
memory_mb = 1000

[assess]
grid = [9, 7]
draws = 400

[[budget]]
name = "reference catalogue"
kind = "random"
sigma_u = 0.0
sigma_v = 0.0
unit = "pix"
source = "exact"

[[budget]]
name = "centroid"
kind = "random"
sigma_u = 0.01
sigma_v = 0.01

[[requirement]]
name = "loose"
statistic = "p95"
limit = 1.0
unit = "pix"
probability = 0.95

[products]
sip = {inverse_order = 4, linear = "cd", crval = [150.0, 2.0]}
idctab = {instrument = "ACS", detector = "WFC"}
"""

CAMPAIGN = """\
[campaign]
catalog = "catalog.parquet"
exposures = "exposures.ecsv"
lists = "lists"
simulated = true
initial_distortion = "start_idc.fits"
filter = "F606W"
mag = [-14.0, -10.0]
q_max = 0.1

[tables]
method = "none"

[detector]
mission = "HST"
instrument = "ACS"
scale_mas = 50.0

[[chip]]
number = 2
name = "WFC2"
size = [4096.0, 2048.0]
reference_pixel = [2048.0, 1024.0]
reference = true

[[chip]]
number = 1
name = "WFC1"
size = [4096.0, 2048.0]
reference_pixel = [2048.0, 1024.0]

[model]
order = 3

[model.tdd]
epoch0 = [2004.5, 2012.5]
breaks = [2009.4]
terms = [["u", 1, 0], ["v", 1, 0], ["v", 0, 1]]

[assess]
epoch = 2006.5
grid = [9, 5]

[[requirement]]
name = "alignment"
statistic = "p95"
limit = 0.05
unit = "pix"

[products.release]
name = "acs_wfc"
reference = "start_idc.fits"
[[products.release.period]]
name = "pre"
years = [2002.2, 2009.4]
segment = 0
[[products.release.period]]
name = "post"
years = [2009.4, 2015.0]
segment = 1
"""

REQUIREMENTS = """\
[[requirement]]
name = "loose"
statistic = "p95"
limit = 1.0
unit = "pix"
probability = 0.95

[[requirement]]
name = "in mas"
statistic = "rms"
limit = 50.0
unit = "mas"
probability = 0.9
region = "whole"

[[requirement]]
name = "tight"
statistic = "max"
limit = 1e-4
probability = 0.5
"""
