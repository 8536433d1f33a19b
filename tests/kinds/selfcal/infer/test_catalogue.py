"""What the catalogue says of stars that may be none."""

from __future__ import annotations

import numpy as np

from bayesdist.kinds.selfcal.infer import self_calibrate, star_catalogue
from tests.kinds.selfcal.infer.fields import field


def test_a_star_without_members_is_somewhere_in_the_match_circle():
    """Its normal density is at the middle that of the disc: 2 pi sigma^2 = pi R^2."""
    simulated, radius = field(7, 6, 600, disturbed=0.3), 1.0
    found = self_calibrate(
        simulated.model,
        simulated.unlabelled,
        simulated.theta,
        match_radius=radius,
        start_radius=2.0,
    )
    catalogue = star_catalogue(found.mode)
    lost = catalogue.n_members < 0.01
    assert lost.sum() > 10
    off = np.sqrt(np.trace(catalogue.own, axis1=1, axis2=2) / 2)
    # on a sky whose pixels differ in size by a hundredth
    np.testing.assert_allclose(off[lost], radius / np.sqrt(2), rtol=0.02)
    np.testing.assert_array_equal(catalogue.cov[lost], catalogue.own[lost])
    assert off[~lost].max() < radius / np.sqrt(2)
