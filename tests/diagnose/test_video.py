"""An asset's own video as data, and the asset's next revision."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest

import taa_envs
from diagnose import diagnose
from diagnose.log import LogError
from diagnose.revision import next_id, revise
from diagnose.video import assumptions, video_logs
from taa_envs.asset import load_asset, save_asset
from taa_envs.randomize import uncertainties
from tests.taa_envs.made import door_arguments


def coasting(folder, friction):
    """A door whose demonstration ends in a coast without the hand, with the given friction over inertia."""
    save_asset(folder, "coaster", **door_arguments() | {"damping": 1e-3, "frictionloss": 0.4})
    target = folder / "coaster"
    data = json.loads((target / "asset.json").read_text())
    data["id"] = "coaster"
    arrays = dict(np.load(target / "reference.npz"))
    n = len(arrays["time"])
    arrays["time"] = t = np.arange(n) / 25.0
    first = n // 3
    q = np.zeros(n)
    q[:first] = 0.2 * np.clip(np.arange(first) / first, 0, 1)
    s = t[first:] - t[first - 1]
    speed = 0.6
    stop = np.minimum(s, speed / friction)
    q[first:] = 0.2 + speed * stop - 0.5 * friction * stop**2
    arrays["q"] = q + 1e-4 * np.random.default_rng(0).standard_normal(n)
    arrays["contact"] = np.arange(n) < first - 3
    np.savez(target / "reference.npz", **arrays)
    moved = np.abs(arrays["q"] - arrays["q"][0])
    data["demo"] |= {"q_start": float(arrays["q"][0]), "q_demo_end": float(arrays["q"][-1]), "demo_end_frame": n - 1,
                     "q_min": float(arrays["q"].min()), "q_max": float(arrays["q"].max())}  # fmt: skip
    assert moved.max() > 0.3
    (target / "asset.json").write_text(json.dumps(data))
    return load_asset(target)


def test_only_untouched_motion_is_data(tmp_path):
    asset = coasting(tmp_path, friction=0.35)
    (log,) = video_logs(asset)
    r = asset.reference
    assert log.time[0] > r.time[r.contact].max() and log.torque is None
    assert any("ratio to the inertia" in a for a in assumptions(asset))


def test_a_hand_that_never_lets_go_is_no_data(tmp_path):
    asset = coasting(tmp_path, friction=0.35)
    asset.reference.contact[:] = True
    with pytest.raises(LogError, match="without a hand"):
        video_logs(asset)


def test_revision_is_an_environment_and_the_old_one_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("TAA_ASSETS", str(tmp_path))
    asset = coasting(tmp_path, friction=0.35)
    before = (asset.path / "model.xml").read_bytes()
    result = diagnose(asset.model_path, video_logs(asset), known=assumptions(asset), only=("coulomb_friction",))
    assert result.found.best.causes == ("coulomb_friction",) and result.extends
    new = revise(asset, result)
    assert new.id == "coaster-r2" and (asset.path / "model.xml").read_bytes() == before
    entry = new.provenance["joint.frictionloss"]
    assert entry["origin"] == "fitted" and entry["std"] > 0 and "ratio to the inertia" in entry["note"]
    same = new.provenance["diagnosis.coulomb_friction.friction"]
    assert same["origin"] == "fitted" and same["std"] > 0
    assert new.metadata["diagnosis"]["revision_of"] == "coaster"
    assert uncertainties(new)["frictionloss"] == pytest.approx(np.log1p(entry["std"] / entry["value"]))
    taa_envs.register_assets()
    env = gymnasium.make("TAA/coaster-r2", randomize=True)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


def test_next_id_counts():
    assert next_id("door", set()) == "door-r2"
    assert next_id("door", {"door-r2"}) == "door-r3"
    assert next_id("door-r3", {"door-r3"}) == "door-r4"
