"""The whole job in a dozen lines of Python, on simulated WISE pairs (writes w2.hdr)."""

import numpy as np

import bayesdist as bd
from bayesdist.missions.wise import simulate_wise

rng = np.random.default_rng(1)
matches, truth = simulate_wise(6000, rng=rng)  # or bd.read_matches("stars.ecsv")
model = bd.build_model(matches, order=4, size=(1016, 1016))
fit = bd.fit_linear(matches, model)
posterior = bd.sample(fit, matches, seed=1)
print("converged:", posterior.convergence.converged, *posterior.convergence.reasons)
print("largest radius, formal:   ", bd.uncertainty_map(fit).radius_max, model.unit)
print("largest radius, posterior:", bd.uncertainty_map(posterior).radius_max, model.unit)
diagnostics = bd.diagnose(posterior, matches, fit=fit)  # what the model leaves out
given = {"diagnostics": diagnostics, "catalogue": bd.Catalogue("2MASS", 0.005, "pix")}
print(bd.error_budget(posterior, **given))
field_wide = bd.Requirement("field-wide", "p95", 0.03, probability=0.95)
print(bd.check_requirements(posterior, [field_wide], **given)[0].verdict)
calibration = bd.Calibration.from_solution(posterior, name="W2")
calibration.write("sip", "w2.hdr", linear="sip", scale_mas=2750)
