"""Errors of an answer against the truth; failures count as failures."""

from __future__ import annotations

import numpy as np

from benchmarks.articulation.bound import Bound, foot
from benchmarks.articulation.engines import Answer
from benchmarks.articulation.noise import Given

FAILED_DEG, FAILED_M = 90.0, 1.0
CONFIDENT = 0.9


def score(given: Given, answer: Answer, best: Bound | None) -> dict:
    """One row of the result file.

    A case without an answer (refused, failed) scores 90 deg and 1 m everywhere and has a wrong type. A slide has no
    location; a hinge taken for a slide misses its axis by 1 m. Angles in deg, lengths in mm.

    Returns:
        axis_deg; location_mm, between the two infinite lines; centroid_mm, distance of the fitted axis from the true
        one's point nearest to the moving link's centroid; q_deg or q_mm, RMS over the frames in which the object itself
        does not hide the link; point_mm, RMS over the same frames and all moving points of the induced displacement's
        error, and point_share of the object's diagonal; ratio_axis and ratio_location, error over the median error of
        an estimator at the Cramer-Rao bound; covered_*, whether the stated 95 % interval holds the truth (for q the
        share of frames).
    """
    scene, model = given.scene, given.scene.model
    kind, hinge = model.kind, model.kind == "revolute"
    row = {
        "case": scene.name, "object": model.name, "source": model.source, "motion": scene.motion, "orbit": scene.orbit,
        "small": scene.small, "row": given.row, "kind": kind, "diagonal_m": scene.diagonal,
        "range": float(np.ptp(scene.shot.q)), "verdict": answer.verdict, "reason": answer.reason, "type": answer.type,
        "probability": max(answer.probability.values(), default=0.0), "seconds": answer.seconds,
        "failed": answer.axis is None, "type_right": answer.axis is not None and answer.type == kind,
    }  # fmt: skip
    # Wrong with a stated probability of 0.9 or more, whatever the verdict: `ambiguous` may be for another reason.
    row["confidently_wrong"] = bool(
        answer.axis is not None and not row["type_right"] and row["probability"] >= CONFIDENT
    )
    if answer.axis is None:
        row |= {"axis_deg": FAILED_DEG, "location_mm": 1e3 * FAILED_M if hinge else None,
                "centroid_mm": 1e3 * FAILED_M if hinge else None, "q_deg": FAILED_DEG if hinge else None,
                "q_mm": None if hinge else 1e3 * FAILED_M, "point_mm": 1e3 * FAILED_M,
                "point_share": FAILED_M / scene.diagonal}  # fmt: skip
        return row | {"ratio_axis": np.inf, "ratio_location": np.inf if hinge else None} if best else row
    row["axis_deg"] = angle_deg(scene.axis, answer.axis)
    truth = scene.shot.q - scene.shot.q[0]
    sign = 1.0 if scene.axis @ answer.axis >= 0 else -1.0
    row |= {"location_mm": None, "centroid_mm": None, "q_deg": None, "q_mm": None}
    error = sign * answer.q - truth
    shown = (scene.visible & scene.moving[:, None]).sum(0) >= 3
    if answer.type != kind:
        row["q_deg" if hinge else "q_mm"] = FAILED_DEG if hinge else 1e3 * FAILED_M
    elif hinge:
        row["q_deg"] = float(np.degrees(np.sqrt(np.mean(error[shown] ** 2))))
    else:
        row["q_mm"] = float(1e3 * np.sqrt(np.mean(error[shown] ** 2)))
    centre = foot(scene)
    miss = None
    if hinge:
        row |= {"location_mm": 1e3 * FAILED_M, "centroid_mm": 1e3 * FAILED_M}
        if answer.point is not None:
            row["location_mm"] = 1e3 * line_distance(scene.point, scene.axis, answer.point, answer.axis)
            off = answer.point - centre
            miss = off - (off @ answer.axis) * answer.axis
            row["centroid_mm"] = 1e3 * float(np.linalg.norm(miss))
    X = scene.points[scene.moving]
    moved = lambda T: np.einsum("tij,nj->tni", T[:, :3, :3], X) + T[:, None, :3, 3]  # noqa: E731
    gap = np.linalg.norm(moved(answer.link_pose) - moved(scene.link_poses()), axis=-1)
    row["point_mm"] = float(1e3 * np.sqrt(np.mean(gap[shown] ** 2)))
    row["point_share"] = row["point_mm"] / 1e3 / scene.diagonal
    if row["type_right"]:
        row |= _coverage(row, answer, error)
    if best is not None:
        row["ratio_axis"] = np.radians(row["axis_deg"]) / typical(best.axis)
        row["bound_axis_deg"] = float(np.degrees(typical(best.axis)))
        if hinge:
            row["ratio_location"] = row["centroid_mm"] / 1e3 / typical(best.point)
            row["bound_location_mm"] = 1e3 * typical(best.point)
        held = np.isfinite(best.q) & (best.q > 0)
        if held.any() and row["type_right"]:
            row["ratio_q"] = float(np.sqrt(np.mean(error[held] ** 2) / np.mean(best.q[held] ** 2)))
    return row


def _coverage(row: dict, answer: Answer, error: np.ndarray) -> dict:
    out: dict = {}
    std = answer.std
    if np.isfinite(std.get("axis_deg", np.nan)):
        out["stated_axis_deg"] = std["axis_deg"]
        out["covered_axis"] = bool(row["axis_deg"] <= 1.96 * std["axis_deg"] + 1e-6)
    if row["centroid_mm"] is not None and np.isfinite(std.get("point_m", np.nan)):
        out["stated_centroid_mm"] = 1e3 * std["point_m"]
        out["covered_location"] = bool(row["centroid_mm"] / 1e3 <= 1.96 * std["point_m"] + 1e-9)
    held = np.isfinite(std["q"]) & (std["q"] > 0)
    if held.any():
        out["covered_q"] = float(np.mean(np.abs(error[held]) <= 1.96 * std["q"][held]))
    return out


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two lines, deg; exact for lines that are nearly parallel."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b))))


def line_distance(p: np.ndarray, a: np.ndarray, c: np.ndarray, b: np.ndarray) -> float:
    """Distance between the lines p + s a and c + s b; of parallel ones too."""
    normal = np.cross(a, b)
    size = np.linalg.norm(normal)
    if size < 1e-9:
        off = c - p
        return float(np.linalg.norm(off - (off @ a) * a))
    return float(abs((c - p) @ normal) / size)


def typical(covariance: np.ndarray) -> float:
    """Median length of a vector with this covariance (Monte Carlo with a fixed seed)."""
    w, V = np.linalg.eigh(covariance)
    draw = np.random.default_rng(0).normal(size=(4000, 3)) * np.sqrt(np.maximum(w, 0))
    return float(np.median(np.linalg.norm(draw @ V.T, axis=1)))
