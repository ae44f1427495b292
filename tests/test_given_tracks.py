"""Real clips by the tracks of a learned tracker, which goes on saying where a part is that it has lost."""

from pathlib import Path

import pytest

from benchmarks.clips import REAL, annotations
from benchmarks.given_tracks import run

pytestmark = pytest.mark.slow
PRESENT = annotations()


def tracked(name):
    absent = name not in PRESENT or not (REAL / f"{Path(name).stem}_cotracker.npy").is_file()
    reason = f"shared/data/videos/{name} or its tracks are absent"
    return pytest.param(name, marks=pytest.mark.skipif(absent, reason=reason))


@pytest.mark.parametrize("name", [tracked("dishwasher.mp4"), tracked("microwave.mp4")])
def test_a_door_that_the_tracker_loses_on_its_way_is_a_hinge(name):
    row = run(name, PRESENT[name])
    assert (row["verdict"], row["type"]) == ("ok", "revolute"), row
    assert row["angle_deg"] < 6 and row["distance"] < 0.03
    assert "agree on no state" in row["reason"] or "follow it" in row["reason"]


@pytest.mark.parametrize("name", [tracked("kitchen_pot.mp4"), tracked("suitcase.mp4")])
def test_what_tracks_do_not_hold_is_not_called_certain(name):
    """A lid that is lifted away, and a handle with 7 of 400 tracks on it before a camera that trembles."""
    assert run(name, PRESENT[name])["verdict"] != "ok"
