"""Films of a policy beside the open-loop replay."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv
from taa_envs.files import written_whole
from taa_envs.registry import CONTROL_PERIOD, max_episode_steps
from train.evaluate import act, check
from train.policy import Policy, load_policy


def _pairs(asset: Asset, policy: Policy, action: str, seed: int, height: int, every: int = 2
           ) -> Iterator[list[np.ndarray]]:
    """Pictures (policy, replay) of one randomised episode after so many steps each, to the end of both."""
    envs = [ArticulationEnv(asset, action=action, randomize=True, render_mode="rgb_array", height=height - height % 2)
            for _ in range(2)]
    seen = [env.reset(seed=seed)[0] for env in envs]
    pictures, over = [env.render() for env in envs], [False, False]
    yield pictures
    actions = [np.zeros(0, np.float32)] * 2
    for step in range(max_episode_steps(asset.demo["duration"])):
        for i, (env, acting) in enumerate(zip(envs, (policy, None), strict=True)):
            if over[i]:
                continue
            if acting is None or step % acting.hold == 0:
                actions[i] = act(acting, env, seen[i])
            seen[i], _, over[i], _, _ = env.step(actions[i])
            if step % every == 0 or over[i]:
                pictures[i] = env.render()
        if step % every == 0 or all(over):
            yield pictures
        if all(over):
            break
    for env in envs:
        env.close()


def record(asset: Asset, policy_file: str | os.PathLike, file: Path, *, seed: int = 1_000_000, count: int = 3,
           height: int = 360) -> None:
    """Write an MP4: the policy (left) beside the open-loop replay (right) in the same randomised episodes."""
    import imageio_ffmpeg

    policy, described = load_policy(policy_file)
    check(asset, policy, described)
    with written_whole(Path(file)) as partial:
        writer = None
        for episode in range(count):
            for pictures in _pairs(asset, policy, described["action"], seed + episode, height):
                frame = np.hstack(pictures)
                frame = np.ascontiguousarray(frame[:, :frame.shape[1] - frame.shape[1] % 2])
                if writer is None:
                    writer = imageio_ffmpeg.write_frames(str(partial), (frame.shape[1], frame.shape[0]), fps=25,
                                                         macro_block_size=1, quality=6)
                    writer.send(None)
                writer.send(frame)
        if writer is not None:
            writer.close()


def wall(shown: Sequence[tuple[Asset, Path]], file: Path, *, seed: int = 1_000_000, columns: int = 3, height: int = 120,
         every: int = 4) -> None:
    """Write an animated WebP: one drawn episode of every asset, the policy (left) beside the open-loop replay (right).

    Args:
        shown: assets and their policies.
        seed: of the episode, the same for all: none is picked.
        every: environment steps of 0.02 s a picture.
    """
    from PIL import Image, ImageDraw

    films = []
    for asset, policy_file in shown:
        policy, described = load_policy(policy_file)
        check(asset, policy, described)
        frames = []
        for pictures in _pairs(asset, policy, described["action"], seed, height, every):
            image = Image.fromarray(np.hstack(pictures))
            ImageDraw.Draw(image).text((4, 2), asset.id, fill="white", stroke_width=1, stroke_fill="black")
            frames.append(np.array(image))
        films.append(frames)
    longest = max(map(len, films))
    width = max(film[0].shape[1] for film in films)
    walls = []
    for k in range(longest + 5):  # the end stays for a moment
        canvas = np.zeros((-(-len(films) // columns) * height, columns * width, 3), np.uint8)
        for i, film in enumerate(films):
            tile, at = film[min(k, len(film) - 1)], divmod(i, columns)
            canvas[at[0] * height:][: tile.shape[0], at[1] * width:][:, : tile.shape[1]] = tile
        walls.append(Image.fromarray(canvas))
    with written_whole(Path(file)) as partial:
        walls[0].save(partial, format="webp", save_all=True, append_images=walls[1:],
                      duration=round(1000 * every * CONTROL_PERIOD), loop=0, quality=55, method=6)
