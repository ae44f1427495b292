"""Films of a policy beside the open-loop replay."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv
from taa_envs.files import written_whole
from taa_envs.registry import max_episode_steps
from train.evaluate import act, check, episodes
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


def strip(asset: Asset, policy_file: str | os.PathLike, file: Path, *, seed: int = 1_000_000, tries: int = 20,
          columns: int = 5, height: int = 200) -> int | None:
    """Write a PNG of the first episode in which the policy (above) succeeds and the replay (below) does not.

    Returns:
        the episode's seed; None where there is no such episode among the tries, and nothing is written.
    """
    from PIL import Image

    policy, described = load_policy(policy_file)
    check(asset, policy, described)
    won, lost = (episodes(asset, acting, tries, seed=seed, action=described["action"])["success"]
                 for acting in (policy, None))
    wanted = np.flatnonzero(won & ~lost)
    if not len(wanted):
        return None
    episode = seed + int(wanted[0])
    frames = [list(pictures) for pictures in _pairs(asset, policy, described["action"], episode, height, every=5)]
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, columns).round().astype(int)]
    with written_whole(Path(file)) as partial:
        Image.fromarray(np.vstack([np.hstack([f[who] for f in chosen]) for who in (0, 1)])).save(partial, optimize=True)
    return episode
