"""What corrections of the replay would bring, were everything known: where a policy has room to gain.

    python -m benchmarks.corrections ID ... --episodes 24

The same randomised episodes are played open loop and by each way of the guide that policies imitate before they are
trained (:mod:`train.guide`), with exact hands and with clumsy ones. The guide reads the draw, which a policy sees only
through its finger tips: these runs tell what fails and what would not, they are no controllers.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from taa_envs.asset import Asset
from taa_envs.registry import get_asset
from taa_envs.vector import BatchedArticulationEnv
from train.evaluate import episodes
from train.guide import SLIP, WAYS, Way, play

HOLD = 5  # environment steps for which an action is held, as in train/configs/ppo.toml


def successes(asset: Asset, count: int, seed: int = 1_000_000) -> list[tuple[float, ...]]:
    """Of the replay, then of every way: exact, and so clumsy as it is at most in the guide's trials."""
    env = BatchedArticulationEnv(asset, count, randomize=True, hold=HOLD)
    out: list[tuple[float, ...]] = [(float(episodes(asset, None, count, seed=seed)["success"].mean()),)]
    out += [tuple(float(np.mean(play(env, seed, [way] * count, slip=slip).won)) for slip in (0.0, SLIP))
            for way in WAYS]
    env.close()
    return out


def words(way: Way) -> str:
    pace = f" at {1 + 1.5 * way.pace:.2g} of the pace" if way.pace else ""
    more = [text for held, text in ((way.follow, "goes after the link"), (np.isfinite(way.wait), "waits for it"),
                                    (way.inward, f"{100 * way.inward:g} cm further in")) if held]
    return ", ".join([f"{100 * way.first:g} to {100 * way.last:g} cm{pace}", *more])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("assets", nargs="+", help="ids or folders")
    parser.add_argument("--episodes", type=int, default=24)
    arguments = parser.parse_args()
    print("| asset | replay | " + " | ".join(map(words, WAYS)) + " |\n|" + " --- |" * (2 + len(WAYS)))
    for name in arguments.assets:
        asset = get_asset(Path(name) if Path(name).is_dir() else name)
        shares = " | ".join(", ".join(f"{x:.0%}" for x in row) for row in successes(asset, arguments.episodes))
        print(f"| {asset.id} | {shares} |", flush=True)


if __name__ == "__main__":
    main()
