"""Whether a stated type probability is a frequency: motions so small that types are hard to tell.

The table's own cases are nearly all certain. Here links of one size move by 0.3 to 5 deg about a hinge within two link
sizes, or along a slide by as much, half of each, seen by few tracks in few frames with the noise of row 2.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from reconstruct.joint.models import joint_transform
from reconstruct.joint.rigid import fit_rigid

K = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1.0]])
MOVING, STATIC, FRAMES = 60, 40, 30
SIZE = 0.3  # m, of the link
BINS = (0.0, 0.6, 0.8, 0.9, 0.97, 1.0 + 1e-9)


def case(seed: int) -> dict:
    """One draw: what it was, what was said, and how sure."""
    rng = np.random.default_rng([seed, 77])
    kind = ("revolute", "prismatic")[seed % 2]
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    centre = np.array([0.0, 0.0, 1.2])
    across = np.cross(axis, rng.normal(size=3))
    arm = SIZE * np.exp(rng.uniform(np.log(0.4), np.log(2.0)))
    point = centre + arm * across / np.linalg.norm(across)
    turn = np.radians(np.exp(rng.uniform(np.log(0.3), np.log(5.0))))
    stroke = turn if kind == "revolute" else turn * arm
    q = stroke * np.sin(np.linspace(0, np.pi / 2, FRAMES))
    X = np.concatenate([centre + rng.uniform(-0.5, 0.5, (MOVING, 3)) * [SIZE, SIZE, 0.06],
                        rng.uniform([-0.4, -0.3, 1.2], [0.4, 0.3, 1.6], (STATIC, 3))])  # fmt: skip
    M = joint_transform(kind, axis, point if kind == "revolute" else None, q)
    world = np.repeat(X[:, None], FRAMES, axis=1)
    world[:MOVING] = np.einsum("tij,nj->nti", M[:, :3, :3], X[:MOVING]) + M[:, :3, 3]
    uv = world[..., :2] / world[..., 2:] * 600 + K[:2, 2] + rng.normal(size=(*world.shape[:2], 2))
    z = world[..., 2] * np.exp(rng.normal(scale=0.02, size=FRAMES) + rng.normal(scale=0.01, size=world.shape[:2]))
    seen = rng.random(world.shape[:2]) < 0.9
    fit = fit_rigid(uv, seen, z, K, np.tile(np.eye(4), (FRAMES, 1, 1)), np.arange(len(X)) < MOVING, seed=seed)
    return {"seed": seed, "kind": kind, "turn_deg": float(np.degrees(turn)), "verdict": fit.verdict, "type": fit.type,
            "probability": max(fit.type_probability.values(), default=0.0)}  # fmt: skip


def calibration(count: int, out: Path) -> list[dict]:
    """So many cases, appended to a file of JSON lines; those that are there are not made again."""
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.is_file() else []
    done = {r["seed"] for r in rows}
    for seed in range(count):
        if seed not in done:
            rows.append(case(seed))
            with out.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    return rows


def reliability(rows: list[dict]) -> str:
    """Stated probability against the share that was right; refusals name no type and are counted beside."""
    said = [r for r in rows if r["verdict"] != "refused"]
    lines = ["| stated p | cases | mean stated p | right |", "| --- | --- | --- | --- |"]
    for low, high in zip(BINS[:-1], BINS[1:], strict=True):
        some = [r for r in said if low <= r["probability"] < high]
        if some:
            stated = np.mean([r["probability"] for r in some])
            right = np.mean([r["type"] == r["kind"] for r in some])
            lines.append(f"| {low:.2f} to {min(high, 1.0):.2f} | {len(some)} | {stated:.3f} | {right:.3f} |")
    return "\n".join([*lines, f"\n{len(rows) - len(said)} of {len(rows)} refused"])
