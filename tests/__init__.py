"""Tests of bayesdist.

Where several processes run them, each has a core for itself and its children.  Threads of one would
wait for those of the others, and spin while they wait: small solves and small passes over the stars
then take several times the processor time.
"""

import os

ALONE = "PYTEST_XDIST_WORKER" not in os.environ

if not ALONE:  # before anything imports numpy
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
