"""Text files from strangers: training settings and joint logs are read, or are one clear error."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diagnose.log import MAX_BYTES, load_log
from taa_envs.cli_commands import read_joint_log
from taa_envs.errors import TaaEnvsError
from train.config import load_config

GOOD = "envs = 2\nsteps = 10\ncheckpoint_every = 5\n"


@pytest.mark.parametrize(
    "text, words",
    [
        ("x = " + "[" * 3000, "settings"),
        ("envs = true\nsteps = 1\ncheckpoint_every = 1", "envs"),
        (GOOD + "what = 1", "what"),
        (GOOD.replace("2", "9" * 30), "envs"),
        (GOOD + 'policy = "x"', "policy"),
        (GOOD + "algorithm = 3", "algorithm"),
        (GOOD + "seed = 1.5", "seed"),
        (GOOD + "reward = 1979-05-27", "reward"),
        (GOOD + "t = 1979-13-99", "settings"),
        (GOOD + 'algo = "sac"', "settings"),
        (GOOD + "randomize = 3", "randomize"),
        ("#" * 70_000, "KiB"),
        ("\udcff", "settings"),
    ],
)
def test_settings_of_a_stranger(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "c.toml"
    file.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(TaaEnvsError, match=words) as caught:
        load_config("ppo", file)
    assert "\n" not in str(caught.value) and "; " in str(caught.value)


values = st.recursive(
    st.booleans() | st.integers() | st.floats() | st.text(max_size=8).map(repr),
    lambda inner: st.lists(inner, max_size=3),
)


@settings(max_examples=150, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(
            [
                "envs",
                "steps",
                "checkpoint_every",
                "reward",
                "action",
                "randomize",
                "seed",
                "algorithm",
                "policy",
                "other",
            ]
        ),
        values,
        max_size=6,
    ),
    st.booleans(),
)
def test_any_settings(entries: dict, whole: bool) -> None:
    lines = GOOD if whole else ""
    known = {line.split(" ")[0] for line in lines.splitlines()}
    for key, value in entries.items():
        if key not in known:
            lines += f"{key} = {str(value).lower() if isinstance(value, bool) else value}\n"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "c.toml"
        file.write_text(lines, encoding="utf-8")
        try:
            made = load_config("sac", file)
        except TaaEnvsError as error:
            assert "\n" not in str(error)
        else:
            assert made.envs == 2 and made.as_dict()["algo"] == "sac"


cell = st.sampled_from(["0", "1.5", "-2e3", "nan", "inf", "", "x", '"', "1_0", "１", "\0", "1e999", "=1+1", "é"])


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.sampled_from(
            ["time", "q", "torque", "force_x", "force_y", "force_z", "point_x", "point_y", "point_z", "note", ""]
        ),
        max_size=10,
    ),
    st.lists(st.lists(cell, max_size=10), max_size=30),
)
def test_any_table_is_a_log_or_one_error(names: list[str], rows: list[list[str]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "log.csv"
        file.write_text("\n".join(",".join(row) for row in [names, *rows]), encoding="utf-8")
        for read in (load_log, read_joint_log):
            try:
                read(file)
            except TaaEnvsError as error:
                assert len(str(error).splitlines()) == 1


def test_logs_without_end(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text("time,q\n" + "1" * 200_000 + ",1\n")
    with pytest.raises(TaaEnvsError, match="CSV"):
        load_log(file)
    with file.open("ab") as f:
        f.truncate(MAX_BYTES + 1)
    for read in (load_log, read_joint_log):
        with pytest.raises(TaaEnvsError, match="MiB"):
            read(file)
