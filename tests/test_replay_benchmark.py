"""The replay benchmark's table: failures count, the paper's rows stand beside ours."""

from __future__ import annotations

from benchmarks.replay import PAPER, hand_table, table


def rows() -> list[dict]:
    good = {"clip": "drawer", "cues": "pixels", "joint_progress": 1.0, "final_q_error": 0.02,
            "controls": {"no_hand": 0.0, "mirrored_hand": 0.03, "late_hand": 0.0},
            "robust": {"mean": 0.98, "worst": 0.9},
            "hands": {"points": {"before": 1.0, "progress": 1.0, "error": 0.01, "seconds": 12.0},
                      "leap": {"before": 0.5, "progress": 0.9, "error": 0.1}}}  # fmt: skip
    refused = {"clip": "stapler", "cues": "pixels", "joint_progress": 0.0, "final_q_error": 1.0, "controls": {},
               "failed": "refused: no joint"}  # fmt: skip
    return [good, refused]


def test_a_refusal_counts_as_no_progress() -> None:
    text = table(rows())
    mean = next(line for line in text.splitlines() if "mean, rendered, pixels alone" in line)
    assert [c.strip() for c in mean.split("|")][3:5] == ["50%", "51%"]
    assert "refused: no joint" in text and "| 3% |" in text


def test_the_papers_rows_are_there() -> None:
    text = table(rows())
    for name, progress, error in PAPER:
        assert f"| {name} (paper) | | {progress:.0%} | {error:.0%} |" in text
    assert sum(p for _, p, _ in PAPER) / 4 == 0.7275


def test_hands_without_an_asset_count() -> None:
    text = hand_table(rows())
    assert "50% to 90%" in text and text.count("0% (no asset)") == 2
    assert "| **mean** | pixels | 50% | 45% |" in text
