"""The taa command: exit codes, the one line of an error, and what --json leaves on stdout."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import pytest

from taa_envs import cli
from taa_envs.asset import save_asset
from taa_envs.registry import shipped_folder
from tests.taa_envs.made import door_arguments

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def assets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("assets")
    save_asset(folder, "door", **door_arguments(push=True))
    return folder


@pytest.fixture
def taa(assets, monkeypatch, capfd, tmp_path):
    """Run a command in an empty folder; returns (exit code, stdout, stderr)."""
    monkeypatch.setenv("TAA_ASSETS", str(assets))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.chdir(tmp_path)

    def run(*args: object) -> tuple[int, str, str]:
        capfd.readouterr()
        code = cli.main([str(a) for a in args])
        out, err = capfd.readouterr()
        return code, out, err

    return run


def one_error(err: str) -> str:
    """The only line on stderr, without its prefix."""
    lines = err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), err
    return lines[0].removeprefix("error: ")


@pytest.mark.parametrize("args", [[], ["dance"], ["reconstruct", "x.mp4"], ["export", "door", "--format", "stl"]])
def test_usage_errors_exit_with_2(args, capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(args)
    assert exit_.value.code == 2 and capsys.readouterr().out == ""


def test_list_and_show(taa):
    code, out, _ = taa("list", "--json")
    shipped = {folder.parent.name for folder in shipped_folder().glob("*/asset.json")}
    assert code == 0 and {a["id"] for a in json.loads(out)["assets"]} == {"door", *shipped}
    code, out, _ = taa("show", "door", "--json")
    shown = json.loads(out)
    assert code == 0 and shown["joint"]["type"] == "revolute" and shown["provenance"]
    code, out, _ = taa("show", "door")
    assert code == 0 and "assumed" in out


def test_unknown_asset_names_the_known_ones(taa):
    code, out, err = taa("show", "dor")
    assert code == 1 and out == "" and "door" in one_error(err)
    code, out, err = taa("show", "dor", "--json")
    assert code == 1 and "door" in json.loads(out)["error"]


def test_replay_prints_the_contract_object(taa):
    code, out, _ = taa("replay", "door", "--json")
    result = json.loads(out)
    assert code == 0 and set(result["controls"]) == {"no_hand", "mirrored_hand", "late_hand"}
    assert {"joint_progress", "final_q_error", "max_progress", "contact_fraction", "max_penetration_m",
            "wrong_way"} <= set(result)  # fmt: skip


@pytest.mark.slow
def test_replay_video_has_a_frame_for_every_sample(taa, tmp_path):
    import cv2

    code, _, err = taa("replay", "door", "--video", tmp_path / "out.mp4")
    assert code == 0, err
    cap = cv2.VideoCapture(str(tmp_path / "out.mp4"))
    count = 0
    while cap.grab():
        count += 1
    assert count > 10 and not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    code, _, err = taa("replay", "door", "--video", tmp_path / "nowhere" / "out.mp4")
    assert code == 1 and "nowhere" in one_error(err)


def test_unknown_hand_names_the_known_ones(taa):
    code, _, err = taa("replay", "door", "--hand", "hook")
    assert code == 1 and "points" in one_error(err)


def test_score_a_joint_log(taa, tmp_path):
    from taa_envs.registry import get_asset

    door = get_asset("door")
    log = tmp_path / "log.csv"
    rows = [f"{t},{q},7" for t, q in zip(door.reference.time, door.reference.q, strict=True)]
    log.write_text("time,q,extra\n" + "\n".join(rows))
    code, out, _ = taa("score", "door", log, "--json")
    assert code == 0 and json.loads(out)["max_progress"] == pytest.approx(1.0, abs=1e-6)
    log.write_text("time,angle\n0,0\n")
    code, _, err = taa("score", "door", log)
    assert code == 1 and "no column q" in one_error(err)
    log.write_text("time,q\n0,0\n1,much\n")
    code, _, err = taa("score", "door", log)
    assert code == 1 and "line 3" in one_error(err)
    code, _, err = taa("score", "door", tmp_path / "none.csv")
    assert code == 1 and "none.csv" in one_error(err)


def test_export_is_a_model_that_loads_by_itself(taa, tmp_path):
    import mujoco

    code, out, _ = taa("export", "door", "--out", tmp_path / "door", "--json")
    assert code == 0
    model = mujoco.MjModel.from_xml_path(str(Path(json.loads(out)["path"]) / "model.xml"))
    assert model.njnt == 1 and model.nu == 0
    code, _, err = taa("export", "door", "--out", tmp_path / "door")
    assert code == 1 and "--overwrite" in one_error(err)
    assert taa("export", "door", "--out", tmp_path / "door", "--overwrite")[0] == 0
    assert [p.name for p in tmp_path.iterdir()] == ["door"]


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["no.mp4", "--id", "x"], "no such file"),
        (["text.mp4", "--id", "x"], "not a video"),
        (["text.mp4", "--id", "Not Legal"], "not valid"),
        (["text.mp4", "--id", "x", "--hand", "hamer"], "known: mediapipe"),
        (["text.mp4", "--id", "x", "--focal", "-3"], "focal length"),
        (["text.mp4", "--id", "taken", "--out", "out"], "--overwrite"),
    ],
)
def test_reconstruct_says_what_is_wrong(taa, tmp_path, args, words):
    (tmp_path / "text.mp4").write_text("this is no video")
    (tmp_path / "out" / "taken").mkdir(parents=True)
    code, out, err = taa("reconstruct", *args)
    last = err.strip().splitlines()[-1]
    assert code == 1 and out == "" and last.startswith("error: ") and words in last and "; " in last
    assert "Traceback" not in err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "text.mp4"]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/x/y"), "disk is full at /x/y"),
        (PermissionError(errno.EACCES, "Permission denied", "/x/y"), "no permission for /x/y"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "/x/y"), "/x/y"),
        (KeyboardInterrupt(), "interrupted"),
        (MemoryError(), "out of memory"),
        (RuntimeError("odd\nthing"), "RuntimeError: odd thing; run again with --debug"),
    ],
)
def test_every_failure_is_one_line(taa, monkeypatch, error, words):
    def fail():
        raise error

    monkeypatch.setattr("taa_envs.cli_commands.list_assets", fail)
    code, out, err = taa("list")
    assert code == 1 and out == "" and words in one_error(err)
    code, out, err = taa("list", "--json")
    assert code == 1 and words in json.loads(out)["error"]
    assert "Traceback" in taa("list", "--debug")[2]


def test_stdout_holds_the_object_alone_even_if_a_library_prints(taa, monkeypatch):
    def noisy():
        print("from Python")
        os.write(1, b"from native code\n")
        return cli.Outcome({"x": 1}, lambda: None)

    monkeypatch.setattr("taa_envs.cli_commands.list_assets", noisy)
    code, out, err = taa("list", "--json")
    assert code == 0 and json.loads(out) == {"x": 1} and "native" in err


def test_synth_refuses_unknown_and_taken_clips(taa, tmp_path):
    code, _, err = taa("synth", tmp_path / "out", "--clip", "zebra")
    assert code == 1 and "demo" in one_error(err)
    (tmp_path / "out" / "demo").mkdir(parents=True)
    code, _, err = taa("synth", tmp_path / "out", "--clip", "demo")
    assert code == 1 and "--overwrite" in one_error(err)


def test_doctor_knows_the_providers(taa):
    code, out, _ = taa("doctor", "--json")
    data = json.loads(out)
    assert code == 0 and data["packages"]["mujoco"]
    assert {"hand", "track", "segment", "depth", "mesh", "camera"} <= {p["cue"] for p in data["providers"]}


def test_missing_egl_names_the_system_libraries(taa, monkeypatch):
    failed = subprocess.CompletedProcess([], 1, "", "gladLoadGL error")
    monkeypatch.setattr("subprocess.run", lambda *a, **k: failed)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    code, _, err = taa("doctor", "--rendering")
    assert code == 1 and "libegl1" in one_error(err) and "libgl1-mesa-dri" in err


def test_as_a_process(assets):
    environment = {**os.environ, "TAA_ASSETS": str(assets)}
    command = [sys.executable, "-m", "taa_envs.cli"]
    done = subprocess.run([*command, "list", "--json"], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and len(json.loads(done.stdout)["assets"]) >= 1
    done = subprocess.run([*command, "show", "dor"], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1 and done.stdout == "" and done.stderr.startswith("error: ")


def test_importing_the_command_is_light():
    code = "import sys, taa_envs.cli; sys.exit(sum(m in sys.modules for m in ('torch', 'cv2', 'mujoco', 'rich')))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_the_line_that_makes_a_refined_asset_is_python_that_does(taa, assets, tmp_path):
    """By its id where it is found by that, else by its folder: a copy elsewhere is not TAA/<id>."""
    import gymnasium

    import taa_envs.env

    def line(*args: object) -> str:
        code, out, err = taa("replay", *args, "--refine", "--seconds", 1)
        assert code == 0, err
        joined = "".join(out.split("\n"))
        return joined[joined.index("note: use it: ") + len("note: use it: ") :].split(")")[0] + ")"

    assert line("door", "--out", tmp_path / "copies").startswith("taa_envs.env.ArticulationEnv(")
    shutil.copytree(assets / "door", tmp_path / "elsewhere" / "door")
    for asked, by_id in (("door", True), (tmp_path / "elsewhere" / "door", False)):
        words = line(asked)
        assert words.startswith("gymnasium.make('TAA/door'") == by_id
        taa_envs.register_assets()
        env = eval(words, {"gymnasium": gymnasium, "taa_envs": taa_envs})
        assert env.unwrapped.asset.id == "door"
        env.close()
