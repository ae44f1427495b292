"""Episodes of ``TAA/<id>`` as Minari datasets: replays and policies recorded, loaded back, played again.

    name = record(asset)                       # TAA/<id>/replay-v0: open-loop replays
    for row in replayed(asset, name): ...      # the same actions again: the recorded score and the new one

Datasets lie where Minari has them: ``$MINARI_DATASETS_PATH`` or
``~/.minari/datasets``; ``minari.load_dataset(name)`` reads them without this package.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from taa_envs.asset import Asset
from taa_envs.errors import TaaEnvsError
from taa_envs.files import folder_written_whole
from taa_envs.registry import CONTROL_PERIOD, ENTRY_POINT, NAMESPACE, VECTOR_ENTRY_POINT, max_episode_steps
from taa_envs.scoring import score_actions

KEY = "taa"  # of the metadata that only this module reads
_NAME = re.compile(r"[-_\w]+(/[-_\w]+)*-v\d+", re.ASCII)


def is_dataset_name(name: str) -> bool:
    """Whether it reads like one: a path of words with a version, ``TAA/door/replay-v0``."""
    return _NAME.fullmatch(name) is not None


def default_name(asset: Asset, what: str = "replay") -> str:
    """``TAA/<id>/<what>-v0``."""
    return f"{NAMESPACE}/{asset.id}/{what}-v0"


def _digest(asset: Asset) -> str:
    return hashlib.sha256(asset.model_path.read_bytes()).hexdigest()


def record(asset: Asset, name: str | None = None, episodes: int = 20, *, seed: int = 0, hand: str = "points",
           randomize: bool = True, act: Callable[[np.ndarray], np.ndarray] | None = None, hold: int = 1,
           algorithm: str = "open-loop replay", overwrite: bool = False,
           progress: Callable[[float], None] | None = None) -> str:
    """Play episodes and write them as a Minari dataset, whole or not at all.

    Episode i runs under seed ``seed + i``, which the dataset keeps. Beside observations, actions and rewards it has the
    infos ``q`` (rad or m), ``joint_progress`` and ``is_success``, one more than actions.

    Args:
        name: of the dataset, default ``TAA/<id>/replay-v0``.
        randomize: draw each episode from the asset's own uncertainties; False: all start unperturbed.
        act: action (A,) of an observation, held for so many steps (``hold``); None for the open-loop replay.
        algorithm: how Minari's metadata call it.
        progress: called with the share done.

    Returns:
        The name.

    Raises:
        TaaEnvsError: the name is none, or a dataset of that name is there already.
    """
    import gymnasium
    import minari
    import mujoco
    from gymnasium.envs.registration import EnvSpec
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage
    from minari.storage import get_dataset_path

    name = default_name(asset) if name is None else name
    if not is_dataset_name(name):
        raise TaaEnvsError(f"{name!r} is no dataset's name; give one like {default_name(asset)}")
    if episodes < 1:
        raise TaaEnvsError("at least one episode is needed")
    target = Path(get_dataset_path(name))
    if target.exists() and not overwrite:
        raise TaaEnvsError(f"a dataset {name} is there already; choose another name or use --overwrite")
    limit = max_episode_steps(asset.demo["duration"])
    spec = EnvSpec(id=f"{NAMESPACE}/{asset.id}", entry_point=ENTRY_POINT, vector_entry_point=VECTOR_ENTRY_POINT,
                   max_episode_steps=limit, kwargs={"asset": asset.id, "hand": hand, "randomize": randomize})
    from taa_envs.env import ArticulationEnv

    env = gymnasium.wrappers.TimeLimit(ArticulationEnv(asset, hand=hand, randomize=randomize), limit)
    made: list[Any] = []
    for i in range(episodes):
        columns = _episode(env, seed + i, act, hold)
        made.append(EpisodeBuffer(id=i, seed=seed + i, **columns))
        if progress is not None:
            progress((i + 1) / episodes)
    about = {"asset": asset.id, "model_sha256": _digest(asset), "hand": hand, "randomize": randomize,
             "mujoco": mujoco.__version__, "control_period": CONTROL_PERIOD}
    with folder_written_whole(target, overwrite) as work:
        storage = MinariStorage.new(work / "data", env.observation_space, env.action_space, spec)
        storage.update_metadata({
            "dataset_id": name, "algorithm_name": algorithm, "minari_version": minari.__version__,
            "requirements": [f"mujoco=={mujoco.__version__}", "taa-envs"], KEY: json.dumps(about),
            "description": f"{algorithm} of the asset {asset.id}, "
                           + ("randomised by its own uncertainties" if randomize else "unperturbed")})
        storage.update_episodes(made)
    _name_spaces(name)
    env.close()
    return name


def _episode(env: Any, seed: int, act: Callable[[np.ndarray], np.ndarray] | None, hold: int) -> dict[str, Any]:
    bare = env.unwrapped
    observation, info = env.reset(seed=seed)
    columns: dict[str, list] = {"observations": [observation], "actions": [], "rewards": [], "terminations": [],
                                "truncations": []}
    infos: dict[str, list] = {"q": [], "joint_progress": [], "is_success": []}

    def note(info: Mapping[str, Any]) -> None:
        for key, values in infos.items():
            values.append(bare.q if key == "q" else info[key])

    note(info)
    over, step = False, 0
    while not over:
        if act is None:
            action = bare.reference_action()
        elif step % hold == 0:
            action = np.asarray(act(observation), np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        for key, value in zip(columns, (observation, action, reward, terminated, truncated), strict=True):
            columns[key].append(value)
        note(info)
        over, step = terminated or truncated, step + 1
    return {**{key: np.array(values) for key, values in columns.items()},
            "infos": {key: np.array(values) for key, values in infos.items()}}


def _name_spaces(name: str) -> None:
    """Tell Minari of the folders that a dataset's name goes through."""
    from minari.namespace import create_namespace, list_local_namespaces

    space = name.rpartition("/")[0]
    if space and space not in list_local_namespaces():
        create_namespace(space)


def load(name: str) -> Any:
    """The ``minari.MinariDataset`` of that name.

    Raises:
        TaaEnvsError: there is none, or it cannot be read.
    """
    import minari

    if not is_dataset_name(name):
        raise TaaEnvsError(f"{name!r} is no dataset's name; give one like {NAMESPACE}/door/replay-v0")
    try:
        return minari.load_dataset(name)
    except Exception as error:  # files of strangers: OSError, KeyError, ValueError, h5py's own
        raise TaaEnvsError(f"the dataset {name} cannot be read ({type(error).__name__}: {str(error)[:80]}); see "
                           "`minari list local`") from None


def score_episode(asset: Asset, name: str, episode: int = 0, hand: str = "points") -> dict[str, float]:
    """Scores of one episode's actions played again in ``TAA/<id>``, as :func:`taa_envs.scoring.score_actions` has them.

    An episode recorded here begins as it did there (its seed and randomisation); any other begins unperturbed.

    Raises:
        TaaEnvsError: no such dataset or episode, or one of another asset.
        ValueError: its actions are not this environment's.
    """
    dataset = load(name)
    if not 0 <= episode < dataset.total_episodes:
        raise TaaEnvsError(f"{name} has episodes 0 to {dataset.total_episodes - 1}, not {episode}")
    about = _about(dataset)
    if about and about.get("asset") != asset.id:
        raise TaaEnvsError(f"{name} was recorded with TAA/{about.get('asset')}; score it with that asset")
    actions = np.asarray(dataset[episode].actions)
    if not about:
        return score_actions(asset, actions, hand)
    seed = next(iter(dataset.storage.get_episode_metadata([episode]))).get("seed", 0)
    return score_actions(asset, actions, about["hand"], seed=int(seed), options={"randomize": about["randomize"]})


def replayed(asset: Asset, name: str) -> Iterator[dict[str, Any]]:
    """Every episode of a dataset of this module played again, action by action.

    Yields:
        episode, seed, recorded and again (joint_progress), same (whether all of q is the recorded one to 1e-9).

    Raises:
        TaaEnvsError: no such dataset, not recorded here, or with another model.
    """
    from taa_envs.env import ArticulationEnv

    dataset = load(name)
    about = _about(dataset)
    if about.get("model_sha256") != _digest(asset):
        raise TaaEnvsError(f"{name} was not recorded with this {asset.id}; record it again")
    env = ArticulationEnv(asset, hand=about["hand"], randomize=about["randomize"])
    seeds = [meta.get("seed", 0) for meta in dataset.storage.get_episode_metadata(range(dataset.total_episodes))]
    for i, seed in enumerate(seeds):
        data = dataset[i]
        _, info = env.reset(seed=int(seed))
        q = [env.q]
        for action in data.actions:
            info = env.step(action)[4]
            q.append(env.q)
        recorded = data.infos["q"]
        yield {"episode": i, "seed": int(seed), "recorded": float(data.infos["joint_progress"][-1]),
               "again": info["joint_progress"],
               "same": len(q) == len(recorded) and bool(np.allclose(q, recorded, rtol=0, atol=1e-9))}
    env.close()


def _about(dataset: Any) -> dict[str, Any]:
    try:
        about = json.loads(dataset.storage.metadata.get(KEY, "{}"))
    except (TypeError, ValueError):
        return {}
    return about if isinstance(about, dict) else {}
