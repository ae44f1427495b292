"""Refinement of a demonstration: rollouts that equal replays, corrections that stay within bounds, results kept."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taa_envs.asset import Asset, AssetError, load_asset, save_asset
from taa_envs.corrections import DEFAULTS, NAMES, Corrections, rotations
from taa_envs.refine import BOUND, corrected, refine, robustness, score
from taa_envs.refined import with_reference, write_refinement
from taa_envs.replay import replay, simulate
from taa_envs.rollouts import OutOfTime, Rollouts
from taa_envs.scene import build_scene
from taa_envs.simulation import HandPath
from tests.taa_envs.made import door_arguments


def unit(name: str, amount: float = 1.0) -> np.ndarray:
    z = np.zeros(len(NAMES))
    z[NAMES.index(name)] = amount
    return z


def test_rollouts_are_replays(door: Asset) -> None:
    scene = build_scene(door)
    paths = [Corrections.of(door).path(z) for z in (np.zeros(len(NAMES)), unit("depth"), unit("time", -1.0))]
    for path, made in zip(paths, Rollouts(scene, n=2).run(paths), strict=True):
        single = simulate(scene, path)
        np.testing.assert_allclose(made.q, single.q, atol=1e-9)
        np.testing.assert_array_equal(made.contact, single.contact[:-1])
        assert not made.diverged


def test_no_correction_is_the_demonstration(door: Asset) -> None:
    path = Corrections.of(door).path(np.zeros(len(NAMES)))
    np.testing.assert_allclose(path.joints, door.reference.hand_joints, atol=1e-12)
    np.testing.assert_array_equal(path.time, door.reference.time)


@given(z=st.lists(st.floats(-BOUND, BOUND), min_size=len(NAMES), max_size=len(NAMES)))
@settings(max_examples=25, deadline=None)
def test_corrections_stay_within_what_is_stated(pushed_door: Asset, z: list[float]) -> None:
    """No landmark moves farther than the deviations, all together, allow; and the motion stays as smooth as it was."""
    c = Corrections.of(pushed_door)
    path = c.path(np.array(z))
    reference = pushed_door.reference.hand_joints
    reach = np.linalg.norm(reference - reference[:, [4, 8, 12, 16, 20]].mean(1, keepdims=True), axis=-1).max()
    shift = np.linalg.norm([c.std["depth"], c.std["across"], c.std["up"]]) + c.std["stroke"] + 2 * c.std["close"]
    assert np.linalg.norm(path.joints - reference, axis=-1).max() <= BOUND * (
        shift + c.std["index"]) + reach * np.expm1(BOUND * c.std["size"]) + 1e-9
    assert np.isfinite(path.joints).all()
    jump = np.linalg.norm(np.diff(path.joints - reference, axis=0), axis=-1).max()
    assert jump < 0.02


@pytest.mark.parametrize("name", ["depth", "across", "up"])
def test_a_shift_rides_on_the_link(door: Asset, name: str) -> None:
    c = Corrections.of(door)
    moved = c.path(unit(name)).joints - door.reference.hand_joints
    turn = rotations(door, door.reference.q)
    local = np.einsum("tji,tnj->tni", turn, moved)
    np.testing.assert_allclose(local, np.broadcast_to(local[0, 0], local.shape), atol=1e-12)
    assert np.linalg.norm(local[0, 0]) == pytest.approx(c.std[name])


def test_deviations_are_the_assets(tmp_path: Path) -> None:
    arguments = door_arguments()
    entry = {"value": 0.0, "unit": "m", "origin": "fitted"}
    stated = {key: {**entry, "std": 0.5 * std} for key, std in DEFAULTS.items()}
    asset = save_asset(tmp_path, "stated", provenance=stated, **arguments)
    c = Corrections.of(asset)
    assert c.stated and c.std["depth"] == 0.5 * DEFAULTS["hand.depth"]
    plain = Corrections.of(save_asset(tmp_path, "plain", **arguments))
    assert not plain.stated and plain.std["depth"] == DEFAULTS["hand.depth"]


@pytest.fixture(scope="module")
def missing(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """A pushed door whose hand was placed 3 cm short of it: the replay misses."""
    arguments = door_arguments(push=True, q_end=0.2)
    arguments["reference"]["hand_joints"] = arguments["reference"]["hand_joints"] + [0.0, -0.03, 0.0]
    return save_asset(tmp_path_factory.mktemp("missing"), "missing", **arguments)


@pytest.fixture(scope="module")
def found(missing: Asset):
    return refine(missing, seed=0, seconds=600.0)


@pytest.mark.slow
def test_a_hand_that_misses_is_brought_to_push(missing: Asset, found) -> None:
    assert found.before.joint_progress < 0.9
    assert found.after.joint_progress >= 0.98 and found.after.final_q_error <= 0.03
    assert max(found.after.controls.values()) <= 0.05
    assert found.changed
    for name, value in found.parameters.items():
        assert abs(value) <= BOUND * found.std[name] + 1e-12
    # The refined replay is a replay like any other: nobody looks at the joint.
    again = replay(replace(missing, reference=found.reference), controls=False)
    assert again.joint_progress == found.after.joint_progress


@pytest.mark.slow
def test_a_refinement_is_kept_beside_the_demonstration(missing: Asset, found, tmp_path: Path) -> None:
    before = (missing.path / "reference.npz").read_bytes()
    folder = write_refinement(missing, found, tmp_path)
    asset = load_asset(folder)
    assert (folder / "reference.npz").read_bytes() == before
    np.testing.assert_array_equal(asset.reference.hand_joints, missing.reference.hand_joints)
    refined = with_reference(asset, "refined", "points")
    np.testing.assert_array_equal(refined.reference.hand_joints, found.reference.hand_joints)
    with gymnasium.make(_registered(asset), reference="refined") as env:
        env.reset(seed=0)
        np.testing.assert_array_equal(env.unwrapped.asset.reference.hand_joints, found.reference.hand_joints)


def _registered(asset: Asset) -> str:
    gymnasium.register(id="TAA/refined-trial", entry_point="taa_envs.env:ArticulationEnv",
                       kwargs={"asset": str(asset.path)})
    return "TAA/refined-trial"


def test_a_refinement_of_another_demonstration_is_refused(door: Asset, tmp_path: Path) -> None:
    asset = save_asset(tmp_path, "door", **door_arguments())
    with pytest.raises(AssetError, match="no refined reference.*--refine"):
        with_reference(asset, "refined", "points")
    with pytest.raises(ValueError, match="known: demonstration, refined"):
        with_reference(asset, "better", "points")
    r = asset.reference
    np.savez(asset.path / "refined-points.npz", time=r.time, q=r.q, hand_joints=r.hand_joints, hand_valid=r.hand_valid,
             contact=r.contact)
    (asset.path / "refined-points.json").write_text('{"of_reference_sha256": "0"}')
    with pytest.raises(AssetError, match="not refined from this demonstration"):
        with_reference(asset, "refined", "points")


def test_a_good_replay_scores_higher_than_a_bad_one(door: Asset) -> None:
    scene = build_scene(door)
    c = Corrections.of(door)
    away = HandPath(door.reference.time, door.reference.hand_joints + [2.0, 0, 0])
    good, bad = Rollouts(scene, n=2).run([c.path(np.zeros(len(NAMES))), away])
    assert score(door, good) > 1.0 and score(door, bad) < 0.0
    assert score(door, replace(good, diverged=True)) == -np.inf


def test_corrected_keeps_frames(door: Asset) -> None:
    made = corrected(door, Corrections.of(door).path(unit("time")))
    np.testing.assert_array_equal(made.time, door.reference.time)
    assert made.hand_joints.shape == door.reference.hand_joints.shape


@pytest.mark.slow
def test_robustness_of_a_hand_that_misses_is_low(door: Asset) -> None:
    assert robustness(door)["worst"] > 0.8
    reference = replace(door.reference, hand_joints=door.reference.hand_joints + [2.0, 0, 0])
    assert robustness(replace(door, reference=reference))["mean"] < 1e-3


@pytest.mark.parametrize("seconds", [20.0, 50.0])
def test_the_wall_clock_ends_a_search_however_slow_the_machine_is(missing: Asset, monkeypatch: pytest.MonkeyPatch,
                                                                  seconds: float) -> None:  # fmt: skip
    """Each step of the batch takes 20 ms of a clock that only we wind: a generation takes 30 s of it."""
    import taa_envs.refine
    import taa_envs.rollouts
    from taa_envs.rows import BatchRows

    class Clock:
        now = 100.0

        def monotonic(self) -> float:
            return self.now

    clock, step = Clock(), BatchRows.step
    for module in (taa_envs.refine, taa_envs.rollouts):
        monkeypatch.setattr(module, "time", clock)

    def slow(self: BatchRows, *args: object) -> None:
        clock.now += 0.02
        step(self, *args)

    monkeypatch.setattr(BatchRows, "step", slow)
    found = refine(missing, seconds=seconds)
    assert found.seconds <= seconds + 1.0
    assert (found.rollouts > 0) == (seconds > 30)
    assert not found.changed or found.after.joint_progress > found.before.joint_progress


def test_replays_that_are_late_are_given_up(door: Asset) -> None:
    runs = Rollouts(build_scene(door), n=2)
    path = HandPath(door.reference.time, door.reference.hand_joints)
    with pytest.raises(OutOfTime):
        runs.run([path, path], deadline=time.monotonic() - 1.0)
