"""The first weeks of a mission: star lists that nobody has paired, and a poor guess of the optics.

Pairs and distortion are found in turn, from no model at all, from an optical model as it was
delivered, and from the same model turned by 270 degrees.  Every start should end at the truth.
"""

import numpy as np

from bayesdist.missions.wise.bring_up import bring_up
from bayesdist.missions.wise.pairs.section import RadialLimit
from bayesdist.missions.wise.simulate.bringup import optical_model, simulate_unpaired

STARTS = {
    "from nothing": None,
    "from the optical model as delivered": optical_model(turn=270)[1],
    "from the optical model, turned by 270 degrees": optical_model(turn=0)[1],
}
ACCEPT = RadialLimit(0.9, 1.3)  # pixels, in the centre and in the corners: the field is crowded
CORNERS = np.array([[1.0, 1.0, 1016.0, 1016.0], [1.0, 1016.0, 1.0, 1016.0]])


def worst_corner(theta, scene):
    """Largest error of a model in the four corners, pixels; of the bare pixels without a model."""
    found = CORNERS.T if theta is None else scene.model.predict(theta, *CORNERS)
    return np.hypot(*(found - scene.model.predict(scene.theta, *CORNERS)).T).max()


scene = simulate_unpaired(12, rng=np.random.default_rng(8), density=5e-3)
print(f"{len(scene.detections.x)} detections, {len(scene.reference.x)} reference stars")
for name, start in STARTS.items():
    print(f"\n{name}, {worst_corner(start, scene):.2f} px off in the worst corner")
    up = bring_up(scene.detections, scene.reference, scene.model, start, acceptance=ACCEPT)
    print("round  order  pairs  coverage  rms [px]  worst corner [px]")
    for k, one in enumerate(up.rounds, 1):
        print(
            f"{k:5}{one.order:7}{one.n_believed:7}{one.coverage:10.1%}{one.rms:10.4f}"
            f"{worst_corner(one.theta, scene):19.4f}"
        )
    print(up.sentence)
