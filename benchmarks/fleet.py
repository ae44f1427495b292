"""The fleet's figures: how a build scales over workers, and what is left when a Ray node dies half-way.

python -m benchmarks.fleet VIDEOS                 1 and 2 local workers, then the same on Ray
python -m benchmarks.fleet VIDEOS --nodes         two local Ray nodes, one killed when half of the videos are done
python -m benchmarks.fleet --synth VIDEOS         first render short clips to build
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from reconstruct.fleet import Build, build


def two_nodes(plan: Build, kill_after: int | None = None) -> dict:
    """Build on a Ray cluster of two nodes of one core each, and kill the second one on the way.

    Args:
        plan: with engine "ray".
        kill_after: number of videos that have ended before the kill; None for half.

    Returns:
        Counts of the manifest, nodes before and after, and how many videos were done at the kill.
    """
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    second = cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    ray.init(address=cluster.address, log_to_driver=False, logging_level="error")
    told: dict = {"nodes_before": sum(n["Alive"] for n in ray.nodes()), "attempts": {}}
    total = 0

    def tell(row, counts: dict[str, int]) -> None:
        nonlocal total
        total = sum(counts.values())
        ended = counts["done"] + counts["refused"] + counts["failed"]
        if "done_when_killed" not in told and ended >= (total // 2 if kill_after is None else kill_after):
            told["done_when_killed"] = ended
            cluster.remove_node(second, allow_graceful=False)

    try:
        begin = time.monotonic()
        manifest = build(plan, tell)
        told["seconds"] = time.monotonic() - begin
        told["counts"] = manifest.counts()
        deadline = time.monotonic() + 60
        while sum(n["Alive"] for n in ray.nodes()) > 1 and time.monotonic() < deadline:
            time.sleep(0.5)
        told["nodes_after"] = sum(n["Alive"] for n in ray.nodes())
    finally:
        ray.shutdown()
        cluster.shutdown()
    return told


def render(folder: Path, count: int) -> None:
    """Short clips to build: the demo clip under different seeds, at half size."""
    import subprocess

    import imageio_ffmpeg

    from reconstruct.synth import render_clip

    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(count):
        with tempfile.TemporaryDirectory() as made:
            clip = render_clip("demo", Path(made), seed=seed)
            subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", "-i", str(clip / "video.mp4"), "-vf",
                            "scale=480:-2", str(folder / f"demo{seed}.mp4")], check=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("videos", type=Path)
    parser.add_argument("--synth", action="store_true", help="render clips into VIDEOS first")
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--nodes", action="store_true")
    parser.add_argument("--engines", nargs="*", default=["local", "ray"])
    parser.add_argument("--workers", nargs="*", type=int, default=[1, 2])
    args = parser.parse_args()
    if args.synth:
        render(args.videos, args.count)
    place = Path(tempfile.mkdtemp(prefix="taa-fleet-"))
    try:
        if args.nodes:
            told = two_nodes(Build(args.videos, place / "nodes", "ray"))
            print(f"two Ray nodes, one killed when {told['done_when_killed']} videos had ended: {told['counts']}, "
                  f"{told['nodes_after']} node left, {told['seconds']:.0f} s")  # fmt: skip
            return
        print("| engine | workers | videos | ended | s | videos an hour | speed-up |")
        print("| --- | --- | --- | --- | --- | --- | --- |")
        plan = Build(args.videos, place)
        for engine in args.engines:
            first = None
            for workers in args.workers:
                begin = time.monotonic()
                counts = build(replace(plan, engine=engine, workers=workers, out=place / f"{engine}{workers}")).counts()
                seconds = time.monotonic() - begin
                first = first or seconds
                ended = ", ".join(f"{n} {state}" for state, n in counts.items() if n)
                total = sum(counts.values())
                print(f"| {engine} | {workers} | {total} | {ended} | {seconds:.0f} | {3600 * total / seconds:.0f} | "
                      f"{first / seconds:.2f} |", flush=True)  # fmt: skip
    finally:
        shutil.rmtree(place, ignore_errors=True)


if __name__ == "__main__":
    main()
