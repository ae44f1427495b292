"""A million environment steps with random actions: no NaN, no growth of memory, the same again under the same seed.

    python -m benchmarks.soak                         10^6 steps over all assets that are found
    python -m benchmarks.soak --steps 20000 --assets door

Each asset runs in the batched environment, its models randomised, under random actions of both kinds. Numbers that are
not finite, observations outside their space, rises of resident memory after a warm-up, and MuJoCo's warnings are
counted; at the end a stretch is run twice from the same seed and compared bit for bit.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

os.environ.setdefault("MUJOCO_GL", "egl")

WARM_UP = 0.2
"""Share of an environment's steps before memory is measured first: arenas and caches grow to their size there."""
GROWTH = 16 << 20
"""Bytes of resident memory by which it may end above that: pages that an allocator keeps, not a leak of every step."""


def resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def checked(made: tuple, env, counts: dict[str, int]) -> None:
    """Count what must not be in one step's answer."""
    observation, reward, _, _, info = made
    counts["not_finite"] += int(not np.isfinite(observation).all()) + int(not np.isfinite(reward).all())
    counts["not_finite"] += sum(int(not np.isfinite(info[k]).all()) for k in ("joint_progress", "final_q_error"))
    space = env.single_observation_space
    counts["outside"] += int((observation < space.low - 1e-6).any() or (observation > space.high + 1e-6).any())
    counts["diverged"] += int(info["diverged"].sum())
    counts["warnings"] += int(np.sum(info["warnings"])) if "warnings" in info else 0


def digest(asset: object, n: int, steps: int, action: str, seed: int) -> bytes:
    """All that a stretch of random actions gives, as bytes."""
    from taa_envs.vector import BatchedArticulationEnv

    env = BatchedArticulationEnv(asset, n, action=action, randomize=True)
    draw, parts = np.random.default_rng(seed), []
    observation, _ = env.reset(seed=seed)
    for _ in range(steps):
        parts.append(observation.tobytes())
        observation, reward, terminated, truncated, _ = env.step(
            draw.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        )
        parts.append(reward.tobytes() + terminated.tobytes() + truncated.tobytes())
    env.close()
    return b"".join(parts)


def soak(asset: object, steps: int, n: int, seed: int) -> dict:
    """One asset's row.

    Args:
        asset: id, folder or asset.
        steps: environment steps, all simulations together.  n: simulations at once.
    """
    from taa_envs.registry import get_asset
    from taa_envs.vector import BatchedArticulationEnv

    asset = get_asset(asset)
    counts = dict.fromkeys(("not_finite", "outside", "diverged", "warnings"), 0)
    begin, done, grown = time.monotonic(), 0, 0
    for action in ("residual", "absolute"):
        env = BatchedArticulationEnv(asset, n, action=action, randomize=True)
        env.reset(seed=seed)
        draw = np.random.default_rng(seed)
        rounds = max(2, -(-steps // (2 * n)))
        for k in range(rounds):
            if k == int(WARM_UP * rounds):
                start = resident()
            checked(env.step(draw.uniform(-1, 1, env.action_space.shape).astype(np.float32)), env, counts)
            done += n
        grown = max(grown, resident() - start)  # of this environment alone: making the next one takes memory too
        env.close()
    same = all(
        digest(asset, 2, 60, action, seed) == digest(asset, 2, 60, action, seed) for action in ("residual", "absolute")
    )
    return {
        "asset": asset.id,
        "steps": done,
        **counts,
        "grown_mb": round(grown / (1 << 20), 1),
        "same_again": same,
        "steps_per_s": round(done / (time.monotonic() - begin)),
        "fine": same and grown < GROWTH and not counts["not_finite"] and not counts["outside"],
    }


def main() -> None:
    from taa_envs.registry import find_assets

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1_000_000, help="over all assets together")
    parser.add_argument("--assets", nargs="*", help="ids or folders (default: all that are found)")
    parser.add_argument("--envs", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    assets = args.assets or sorted(find_assets())
    if not assets:
        sys.exit("no assets are found; set TAA_ASSETS")
    columns = (
        "asset",
        "steps",
        "not_finite",
        "outside",
        "diverged",
        "warnings",
        "grown_mb",
        "same_again",
        "steps_per_s",
    )
    print("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns))
    rows = []
    for asset in assets:
        rows.append(soak(asset, -(-args.steps // len(assets)), args.envs, args.seed))
        print("| " + " | ".join(str(rows[-1][c]) for c in columns) + " |", flush=True)
    print(f"{sum(r['steps'] for r in rows)} steps over {len(rows)} assets")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    sys.exit(0 if all(r["fine"] for r in rows) else 1)


if __name__ == "__main__":
    main()
