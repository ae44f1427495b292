"""A table of policies: each asset, several seeds, so many minutes each, beside the open-loop replay.

    python -m train.zoo                                   # every shipped asset
    python -m train.zoo ID ... --seeds 0 1 2 --minutes 15 --out runs/zoo --page docs/zoo.md

One seed of every asset comes before the next seed, and the page is written after every run: what is there when it is
stopped is a table of what was done. What is done stays done: a run that was killed goes on, and finished evaluations
are read, not made again. A training run is allowed so many minutes by the clock of a machine on which nothing else is
to run.
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from taa_envs.asset import Asset
from taa_envs.files import written_whole
from taa_envs.registry import find_assets, get_asset, shipped_folder
from train.config import load_config
from train.evaluate import evaluate
from train.film import wall
from train.run import digest, train

GOAL = 0.95
"""Success that a policy is to reach."""
POOR = 0.75
"""A replay that succeeds less often than this is one on which a policy is to improve."""
FILMED = 1_000_000
"""Seed of the episode that the page shows: the first of :func:`train.evaluate.evaluate`."""


@dataclass(frozen=True)
class Entry:
    """One asset's row. runs: an evaluation (:func:`train.evaluate.evaluate`) a seed, with ``trained`` beside it."""

    asset: Asset
    runs: list[dict[str, Any]]
    curves: list[Path]

    def pooled(self, who: str) -> tuple[float, float, float]:
        """Success over all seeds' episodes of "policy", or the replay's, with its 95 % Wilson interval."""
        runs = self.runs if who == "policy" else self.runs[:1]  # every seed is compared in the same episodes
        count = sum(run["episodes"] for run in runs)
        wins = sum(round(run[who]["success"] * run["episodes"]) for run in runs)
        interval = binomtest(wins, count).proportion_ci(0.95, method="wilson")
        return wins / count, float(interval.low), float(interval.high)


def make(asset: Asset, algo: str, seed: int, minutes: float, steps: int | None, episodes: int, out: Path,
         replay: dict[str, Any] | None = None) -> tuple[dict[str, Any], Path]:
    """Train and evaluate unless that was done: the evaluation, with ``trained`` beside it, and the curve's file.

    replay: of an evaluation of the same asset with as many episodes.
    """
    folder = out / f"{asset.id}-{algo}-{seed}"
    file = folder / "zoo.json"
    wanted = {"minutes": minutes, "steps": steps, "episodes": episodes, "asset_sha256": digest(asset)}
    known = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if known.get("wanted") != wanted:
        trained = train(asset, load_config(algo, seed=seed, steps=steps), folder, minutes=minutes)
        known = {"wanted": wanted, "trained": trained, **evaluate(asset, folder, episodes, replay=replay)}
        with written_whole(file) as partial:
            partial.write_text(json.dumps(known, indent=1), encoding="utf-8")
    print(f"{asset.id} seed {seed}: {known['policy']['success']:.0%}, replay {known['replay']['success']:.0%}, "
          f"{known['trained']['steps']} steps in {known['trained']['seconds']:.0f} s "
          f"({known['trained']['processor']:.0f} s of processor)", flush=True)
    return known, folder / "curve.csv"


def table(entries: Sequence[Entry]) -> str:
    """Markdown."""
    rows = ["| asset | joint | replay | policy, all seeds | each seed | gain | steps | minutes | processor minutes |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"]
    for entry in entries:
        (replay, *around), (policy, *about) = entry.pooled("replay"), entry.pooled("policy")
        trained = [run["trained"] for run in entry.runs]
        rows.append(
            f"| {entry.asset.id} | {entry.asset.joint_type} | {replay:.0%} ({around[0]:.0%} to {around[1]:.0%}) | "
            f"**{policy:.0%}** ({about[0]:.0%} to {about[1]:.0%}) | "
            + ", ".join(f"{run['policy']['success']:.0%}" for run in entry.runs)
            + f" | {100 * (policy - replay):+.0f} | {np.mean([t['steps'] for t in trained]) / 1000:.0f} k | "
            f"{np.mean([t['seconds'] for t in trained]) / 60:.1f} | "
            f"{np.mean([t['processor'] for t in trained]) / 60:.1f} |")
    return "\n".join(rows)


def summary(entries: Sequence[Entry]) -> str:
    """What the table says, in a sentence or two."""
    rates = {e.asset.id: e.pooled("policy")[0] for e in entries}
    short = {i: rate for i, rate in sorted(rates.items(), key=lambda item: item[1]) if rate < GOAL}
    gains = [100 * (rates[e.asset.id] - e.pooled("replay")[0]) for e in entries if e.pooled("replay")[0] < POOR]
    text = f"{len(rates) - len(short)} of {len(rates)} assets reach {GOAL:.0%}"
    text += "; " + ", ".join(f"{i} {rate:.1%}" for i, rate in short.items()) + "." if short else "."
    if gains:
        text += (f" Where the replay succeeds in less than {POOR:.0%} ({len(gains)} of them) the policy is "
                 f"{min(gains):.0f} to {max(gains):.0f} points above it.")
    return text


def page(entries: Sequence[Entry], command: str, figure: str | None, film: str | None = None) -> str:
    """Markdown page around the table. figure, film: pictures of the curves and of :func:`train.film.wall`."""
    run = entries[0].runs[0]
    lines = ["# Policy zoo", "", f"**{summary(entries)}**", "",
             f"`{command}` trains and evaluates all of it (settings: `train/configs`). Success in {run['episodes']} "
             "episodes a seed under each asset's own randomisation, none of them seen in training, with 95 % Wilson "
             "intervals; the replay runs in the same episodes. The intervals count episodes as if seeds were alike; "
             f"how seeds differ is in their own column. {platform.processor() or platform.machine()}, MuJoCo and "
             "Stable-Baselines3 of the lock file.", "", table(entries), ""]
    if figure is not None:
        lines += [f"![Success in training over environment steps, a line a seed.]({figure})", "",
                  "*Dots: evaluations without noise, in episodes that are not the table's: the first is the replay, "
                  "the second the policy after its guide's lessons (nothing is evaluated in between), and one that "
                  "is `enough` ends the training. Lines: with the noise that training explores with, over 100 "
                  "episodes (each counted once all that began with it have ended). Dashed: the replay in the table's "
                  "episodes.*", ""]
    if film is not None:
        lines += [f"![Every asset: a policy and the replay in one episode.]({film})", "",
                  f"*The first seed's policy (left) beside the open-loop replay (right), in the table's first episode, "
                  f"whatever came of it (seed {FILMED}). `taa evaluate ID POLICY --video FILE` films more.*", ""]
    return "\n".join(lines)


def draw(file: Path, entries: Sequence[Entry]) -> None:
    """Curves of every run, a panel an asset."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(3, len(entries))
    rows = -(-len(entries) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.2 * columns, 2.4 * rows), squeeze=False, sharey=True,
                                layout="constrained")
    for ax, entry in zip(axes.flat, entries, strict=False):
        for k, curve in enumerate(entry.curves):
            with curve.open(newline="", encoding="utf-8") as f:
                points = [[float(r[name]) for name in ("steps", "success", "evaluated")] for r in csv.DictReader(f)]
            steps, success, evaluated = np.array(points).T
            ax.plot(steps / 1000, success, linewidth=1, color=f"C{k}")
            ax.plot(steps / 1000, evaluated, ".", markersize=5, color=f"C{k}")
        ax.axhline(entry.pooled("replay")[0], color="0.4", linestyle="--", linewidth=1)
        ax.set_title(entry.asset.id, fontsize=9)
        ax.set_ylim(0, 1.03)
        ax.set_xlabel("thousand steps", fontsize=8)
        ax.tick_params(labelsize=8)
    for ax in list(axes.flat)[len(entries):]:
        ax.axis("off")
    axes[0, 0].set_ylabel("success (dashed: replay)", fontsize=8)
    figure.savefig(file, dpi=140)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ids", nargs="*", help="assets (default: all that ship)")
    parser.add_argument("--algo", default="ppo", choices=["ppo", "sac"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--minutes", type=float, default=15.0, help="by the clock, of training a seed")
    parser.add_argument("--steps", type=int, help="environment steps of training at most (default: the settings')")
    parser.add_argument("--episodes", type=int, default=100, help="of evaluation a seed")
    parser.add_argument("--out", type=Path, default=Path("runs/zoo"))
    parser.add_argument("--page", type=Path, help="Markdown file to write; the figure goes to images/zoo.png beside it")
    arguments = parser.parse_args(argv)
    shipped = shipped_folder().resolve()
    ids = arguments.ids or [i for i, folder in sorted(find_assets().items()) if folder.resolve().parent == shipped]
    if not ids:
        parser.error("no asset ships with this version; name some")
    entries = [Entry(get_asset(i), [], []) for i in ids]
    command = "python -m train.zoo " + " ".join(
        [*arguments.ids, f"--algo {arguments.algo}", "--seeds", *map(str, arguments.seeds),
         f"--minutes {arguments.minutes:g}", f"--episodes {arguments.episodes}"]
        + ([f"--steps {arguments.steps}"] if arguments.steps else []))
    for seed in arguments.seeds:
        for entry in entries:
            run, curve = make(entry.asset, arguments.algo, seed, arguments.minutes, arguments.steps,
                              arguments.episodes, arguments.out, entry.runs[0]["replay"] if entry.runs else None)
            entry.runs.append(run)
            entry.curves.append(curve)
            if arguments.page is not None:
                write_page(arguments.page, [e for e in entries if e.runs], command)
    print(table(entries))
    if arguments.page is not None:
        film = arguments.page.parent / "images" / "zoo.webp"
        runs = [arguments.out / f"{e.asset.id}-{arguments.algo}-{arguments.seeds[0]}" for e in entries]
        wall([(e.asset, run) for e, run in zip(entries, runs, strict=True)], film, seed=FILMED)
        write_page(arguments.page, entries, command, "images/zoo.webp")


def write_page(file: Path, entries: Sequence[Entry], command: str, film: str | None = None) -> None:
    """The page and its figure, ``images/zoo.png`` beside it."""
    figure = file.parent / "images" / "zoo.png"
    figure.parent.mkdir(parents=True, exist_ok=True)
    draw(figure, entries)
    with written_whole(file) as partial:
        partial.write_text(page(entries, command, "images/zoo.png", film), encoding="utf-8")


if __name__ == "__main__":
    main()
