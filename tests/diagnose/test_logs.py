"""Broken logs and models get one clear line each."""

from __future__ import annotations

import numpy as np
import pytest

from diagnose import JointLog, LogError, diagnose, load_log
from diagnose.log import check_units, drop_stale
from taa_envs.errors import TaaEnvsError

GOOD = "time,q,torque,note\n" + "".join(f"{i * 0.01:.2f},{0.01 * i:.4f},0,x\n" for i in range(40))
BROKEN = {
    "empty": ("", "empty"),
    "no column": (GOOD.replace("time,q", "time,angle"), "no column q"),
    "nan": (GOOD.replace("0.05,0.0500", "0.05,nan"), "not finite"),
    "unsorted": (GOOD.replace("0.05,", "0.95,"), "does not increase"),
    "doubled": (GOOD.replace("0.06,", "0.05,"), "does not increase"),
    "three samples": ("time,q\n0,0\n0.1,0\n0.2,0\n", "3 samples"),
    "words": (GOOD.replace("0.05,0.0500", "0.05,open"), "must be numbers"),
    "force without point": (GOOD.replace("torque", "force_x"), "needs force_x, force_y"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_log_is_refused_in_one_line(tmp_path, name):
    text, words = BROKEN[name]
    file = tmp_path / "log.csv"
    file.write_text(text)
    with pytest.raises(LogError, match=words) as caught:
        load_log(file)
    assert "\n" not in str(caught.value)


def test_good_log_keeps_what_it_says(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(GOOD)
    log = load_log(file)
    assert log.q[10] == pytest.approx(0.1) and log.torque is not None and log.force is None
    assert log.dt == pytest.approx(0.01)


def test_degrees_are_recognised():
    t = np.arange(100) * 0.01
    log = JointLog("deg", t, np.degrees(np.sin(t)))
    with pytest.raises(LogError, match="degrees"):
        check_units(log, hinge=True, model_range=None)
    check_units(JointLog("rad", t, np.sin(t)), hinge=True, model_range=None)


def test_unknown_model_and_joint(tmp_path):
    log = JointLog("x", np.arange(100) * 0.01, np.arange(100) * 0.01)
    with pytest.raises(TaaEnvsError, match="no such model"):
        diagnose(tmp_path / "none.xml", [log])
    model = tmp_path / "m.xml"
    model.write_text("<mujoco><worldbody><body><joint name='lid'/><geom size='.1'/></body></worldbody></mujoco>")
    with pytest.raises(TaaEnvsError, match="it has: lid"):
        diagnose(model, [log], "door")


def test_stale_rows_are_left_out_and_rounded_ones_are_not():
    t = np.arange(300) * 0.01
    rng = np.random.default_rng(0)
    q = np.sin(2 * t) + 1e-3 * rng.standard_normal(300)
    stale = q.copy()
    for k in range(5, 300, 9):
        stale[k] = stale[k - 1]
    kept, count = drop_stale(JointLog("x", t, stale))
    assert count >= 30 and len(kept.q) == 300 - count
    assert drop_stale(JointLog("x", t, q))[1] == 0
    assert drop_stale(JointLog("x", t, np.round(q, 2)))[1] == 0
