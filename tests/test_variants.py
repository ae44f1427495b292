"""Real clips mirrored, backwards, smaller: the files, the annotation that goes along, and the table."""

import numpy as np
import pytest

from benchmarks.clips import annotations, image_errors
from benchmarks.variants import KINDS, cell, change, change_truth, margin, run, table, write_video

SHAPE = (7, 60, 90, 3)


@pytest.fixture
def frames():
    return np.random.default_rng(0).integers(0, 255, SHAPE, np.uint8)


def test_a_variant_is_the_clip_but_for_what_its_name_says(frames):
    same, fps = change(frames, 30.0, "as it is")
    assert same is frames and fps == 30
    np.testing.assert_array_equal(change(frames, 30.0, "mirrored")[0][:, :, 0], frames[:, :, -1])
    np.testing.assert_array_equal(change(frames, 30.0, "backwards")[0][0], frames[-1])
    assert change(frames, 30.0, "smaller")[0].shape == (7, 40, 60, 3)
    half, fps = change(frames, 30.0, "half rate")
    assert len(half) == 4 and fps == 15
    assert change(frames, 30.0, "darker")[0].max() == 102
    smooth = np.broadcast_to(np.linspace(0, 200, 90).astype(np.uint8)[:, None], SHAPE)
    off = np.abs(change(smooth, 30.0, "compressed")[0].astype(int) - smooth)
    assert off.any() and off.mean() < 6
    cut = margin(90, 60)
    held = change(smooth, 30.0, "shaken")[0]
    np.testing.assert_array_equal(held[0], smooth[0, cut:-cut, cut:-cut])
    assert (held[1:] != held[0]).any() and held[1:].min() > 0  # nothing from beyond the picture
    with pytest.raises(ValueError, match="no variant 'upside down'; there are as it is, mirrored"):
        change(frames, 30.0, "upside down")


@pytest.mark.parametrize("truth", [
    {"axis_line": [[0.1, 0.2], [0.7, 0.4]]}, {"axis_point": [0.2, 0.3]}, {"direction": [[0.2, 0.9], [0.6, 0.1]]}
])  # fmt: skip
@pytest.mark.parametrize("kind", KINDS)
def test_the_annotation_goes_along(truth, kind):
    """What is right of the clip is right of its variant, and what is wrong stays as wrong."""
    truth = {**truth, "width": 90, "height": 60}
    drawn = np.array(truth.get("axis_line") or truth.get("direction") or [[0.1, 0.3], [0.4, 0.3]]) * [90, 60]

    def of_variant(line):
        if kind == "mirrored":
            line = [90, 0] + line * [-1, 1]
        if kind == "backwards" and "direction" in truth:
            line = line[::-1]
        if kind == "shaken":
            line = line - margin(90, 60)
        return line * 2 / 3 if kind == "smaller" else line

    for off in (0.0, 6.0):
        line = drawn + [[0, 0], [0, off]]
        found = image_errors(of_variant(line), change_truth(truth, kind))
        wanted = image_errors(line, truth)
        if kind == "shaken" and "distance" in wanted:  # of a smaller picture
            wanted["distance"] *= np.hypot(90, 60) / np.hypot(90 - 2 * margin(90, 60), 60 - 2 * margin(90, 60))
        assert found == pytest.approx(wanted, abs=1e-4)
    assert truth["width"] == 90


def test_variant_files_are_lossless(frames, tmp_path):
    from reconstruct.container import open_video

    write_video(tmp_path / "x.avi", frames, 15.0)
    capture = open_video(tmp_path / "x.avi")
    assert capture.get(5) == 15
    for frame in frames:
        np.testing.assert_array_equal(capture.read()[1], frame)
    assert not capture.read()[0]


def test_wrong_answers_are_called_wrong_in_the_table():
    rows = [{"clip": "a.mp4", "kind": "as it is", "truth": "revolute", "verdict": "ok", "type": "revolute",
             "range": 71.2, "angle_deg": 1.23, "distance": 0.012},
            {"clip": "a.mp4", "kind": "mirrored", "truth": "revolute", "verdict": "ambiguous", "type": "prismatic",
             "range": 0.2},
            {"clip": "b.mp4", "kind": "mirrored", "truth": "none", "verdict": "refused"}]  # fmt: skip
    assert cell(rows[0]) == "revolute, 71 deg, 1.2 deg off, 1.2%"
    assert cell(rows[1]) == "prismatic (ambiguous) (wrong)"
    assert cell(rows[2]) == "refused" and cell({**rows[2], "truth": "revolute"}) == "refused (wrong)"
    assert cell({**rows[2], "verdict": "error"}) == "error (wrong)"
    lines = table(rows).splitlines()
    assert lines[0] == "| clip | truth | as it is | mirrored |"
    assert lines[2].startswith("| a.mp4 | revolute | revolute, 71 deg") and lines[3] == "| b.mp4 | none |  | refused |"


@pytest.mark.slow
@pytest.mark.skipif("dishwasher.mp4" not in annotations(), reason="shared/data/videos/dishwasher.mp4 is absent")
def test_a_mirrored_dishwasher_is_the_same_hinge():
    """It was refused: the camera at rest went along with a slide, of which the hinge took its path."""
    row = run("dishwasher.mp4", "mirrored")
    assert row["verdict"] == "ok" and row["type"] == "revolute", row
    assert row["angle_deg"] < 8 and row["distance"] < 0.04
