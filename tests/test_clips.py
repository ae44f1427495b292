"""The whole chain on whole videos: rendered ones always, real ones where they are present.

The demo clip's is in reconstruct/test_pipeline.py.
"""

import numpy as np
import pytest

from benchmarks.clips import annotations, run
from taa_envs.asset import load_asset
from taa_envs.refine import refine

pytestmark = pytest.mark.slow
PRESENT = annotations()
SLIPPERY = ("dishwasher.mp4",)
"""Where the landmarks' last digits, which differ between machines, decide whether the grip slips (docs/limits.md)."""

OPEN = ("stapler_fold.mp4", "suitcase.mp4")
"""Sure or ambiguous by the machine's last digits: the stapler's axis is held to 9 to 11 deg, where 10 are asked; the
suitcase's handle is a slide with p 0.73 to 1.00."""


def real(name):
    return pytest.param(
        name, marks=pytest.mark.skipif(name not in PRESENT, reason=f"shared/data/videos/{name} is absent")
    )


@pytest.mark.parametrize(
    "name", [real(n) for n in ("treasurebox01.avi", "stapler_fold.mp4", "dishwasher.mp4", "suitcase.mp4")]
)
def test_real_clip_gives_the_annotated_joint_and_a_replay(name, tmp_path):
    truth, row = PRESENT[name], run(name, tmp_path)
    assert row["verdict"] == "ok" or (name in OPEN and row["verdict"] == "ambiguous"), row
    assert row["type"] == truth["joint"]
    assert row.get("angle_deg", 0) < 8
    assert row.get("distance", 0) < 0.04
    if "range_deg" in truth:
        # Estimated by eye: one more degree to either side.
        assert truth["range_deg"][0] - 1 <= row["range"] <= truth["range_deg"][1] + 1
    assert max(row["replay"]["controls"].values()) < 0.1
    if name not in SLIPPERY:
        assert row["replay"]["joint_progress"] >= 0.7
    elif row["replay"]["joint_progress"] < 0.7:
        assert row["replay"]["joint_progress"] > 0.5 or any("--refine" in note for note in row["notes"])
        # A hand that holds has to be within what its placement leaves open.
        found = refine(load_asset(row["asset"]), seconds=60)
        assert found.after.joint_progress >= 0.7
        assert max(found.after.controls.values()) < 0.1


@pytest.mark.parametrize("name", [real("kitchen_pot.mp4")])
def test_a_lid_that_is_lifted_away_is_refused(name, tmp_path):
    row = run(name, tmp_path)
    assert row["verdict"] == "refused"
    assert "free body" in row["reason"] or "no joint" in row["reason"]
    assert row["asset"] is None


@pytest.mark.parametrize("name", [real("microwave.mp4")])
def test_a_door_that_springs_open_is_not_driven_by_contact(name, tmp_path):
    row = run(name, tmp_path)
    assert row["type"] == "revolute"
    assert row["angle_deg"] < 8 and row["distance"] < 0.04
    assert row["replay"]["joint_progress"] < 0.1
    assert row["replay"]["contact_fraction"] == 0


@pytest.mark.parametrize("name", [real("microwave01.avi")])
def test_a_door_that_a_hook_in_the_hand_opens(name, tmp_path):
    """The hook has more tracks than the door, whose paint is even; no line of its hinge is annotated."""
    row = run(name, tmp_path)
    assert (row["verdict"], row["type"]) == ("ambiguous", "revolute"), row["reason"]
    assert "what a hand carries" in row["reason"]
    # By eye 20 to 25 deg.
    assert 15 <= row["range"] <= 35
    assert row["replay"]["joint_progress"] >= 0.7 and max(row["replay"]["controls"].values()) < 0.1


@pytest.mark.parametrize("name", ["still", "lift"])
def test_rendered_clip_without_a_joint_is_refused(name, tmp_path):
    row = run(name, tmp_path)
    assert row["verdict"] == "refused", row


@pytest.mark.parametrize("name", ["locker", "puncher", "stapler"])
def test_joints_that_need_exact_tracks_and_a_wide_search(name, tmp_path):
    """A door that ends facing the camera, a small lid whose labels shear as it turns, moved by less than a finger's
    length, and one beside which the arm's shadow has more tracks."""
    from benchmarks.clips import true_errors
    from reconstruct.pipeline import fit_scene, reconstruct
    from reconstruct.synth import load_truth, render_clip

    clip = render_clip(name, tmp_path)
    made = reconstruct(clip / "video.mp4", name, scene=tmp_path / "scene", out=tmp_path / "assets",
                       until=None if name == "puncher" else "joint")
    joint, truth = fit_scene(tmp_path / "scene"), load_truth(clip)
    assert (joint["verdict"], joint["type"]) == ("ok", "revolute"), joint["reason"]
    errors = true_errors(joint, truth)
    assert errors["angle_deg"] < 1.0 and errors["distance"] < 0.02
    assert np.ptp(joint["q"]) == pytest.approx(np.ptp(truth.q), rel=0.06)
    if name == "puncher":
        assert made.replay["joint_progress"] > 0.9 and max(made.replay["controls"].values()) < 0.05


def test_a_clip_that_is_none_is_named_in_one_line(monkeypatch, capsys):
    from benchmarks.clips import main

    monkeypatch.setattr("sys.argv", ["clips", "--only", "demo", "nothere"])
    with pytest.raises(SystemExit):
        main()
    assert "no clip 'nothere'; there are demo, " in capsys.readouterr().err
