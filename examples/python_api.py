"""A calibration in Python, on simulated WISE pairs (writes w2.hdr and the folder w2-run)."""

import bayesdist as bd
from bayesdist.missions.wise import simulate_wise

stars, truth = simulate_wise(6000, rng=1)  # or bd.read_matches("stars.ecsv")
catalogue = bd.Catalogue("2MASS", sigma=0.005, unit="pix", source="a guess for this example")
need = bd.Requirement("field-wide", "p95", 0.03, probability=0.95)
run = bd.calibrate(stars, order=4, size=(1016, 1016), catalogue=catalogue, requirements=need)
print(run)  # verdict, warnings, error budget; a table in a notebook
print("largest radius, formal:   ", bd.uncertainty_map(run.fit).radius_max, run.model.unit)
print("largest radius, posterior:", run.map().radius_max, run.model.unit)
print(run.budget(at=(10, 10), to=(1000, 1000)))  # of a separation
run.write("sip", "w2.hdr", axes="linear")
run.save("w2-run")  # as the command line does; bd.open_run("w2-run") reads it
