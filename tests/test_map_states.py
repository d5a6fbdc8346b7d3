"""Which states of the map a recording is compared with."""

from __future__ import annotations

import numpy as np
from map_worlds import a_map, a_session, observed, true_shape

from reobj.maps.update import states_for

MONDAY = true_shape(center=(1.0, 2.0, 0.5))
TUESDAY = true_shape(center=(-1.0, 0.5, 0.5))


def test_a_recording_is_compared_with_its_own_observations() -> None:
    """The first object moved after Monday, the second one was not detected on Monday."""
    objects = [
        [observed(1, "new", MONDAY), observed(2, "moved", TUESDAY)],
        [observed(2, "new", MONDAY)],
    ]
    room = a_map(objects, sessions=(a_session(1), a_session(2)))
    own = {1: room.objects[0].observations[0]}
    for known, place in (({}, TUESDAY), (own, MONDAY)):
        moved, other = states_for(room, known)
        np.testing.assert_allclose(moved.center, place["center"], atol=1e-6)
        np.testing.assert_allclose(other.center, MONDAY["center"], atol=1e-6)


def test_the_class_of_an_object_is_that_of_all_sessions() -> None:
    monday = observed(1, "new", MONDAY, classes={"tv": 20.0})
    tuesday = observed(2, "stayed", MONDAY, classes={"laptop": 5.0})
    room = a_map([[monday, tuesday]], sessions=(a_session(1), a_session(2)))
    (state,) = states_for(room, {1: tuesday})
    assert state.class_name == "tv" and state.classes == {"laptop": 5.0}
