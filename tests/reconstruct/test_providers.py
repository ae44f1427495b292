"""The table of providers: what can run here and why not, licences, settings, choosing."""

from __future__ import annotations

import importlib.util
import json
import os
import sys

import pytest

from reconstruct.errors import TaaError
from reconstruct.providers import table
from reconstruct.providers.make import _MODULES, maker_of
from reconstruct.providers.settings import SECTIONS, Settings, load_settings
from reconstruct.providers.table import PROVIDERS, choose, find, is_default, obstacle, states

NEEDS_MORE = {("camera", "da3"), ("depth", "da3"), ("depth", "moge"), ("track", "cotracker3"), ("segment", "sam3")}
OUTSIDE = {(p.stage, p.name) for options in PROVIDERS.values() for p in options if p.kind == "repository"}


@pytest.fixture
def bare(monkeypatch, tmp_path):
    """A machine with taa-envs alone: no optional package, no weights, no taa.toml."""
    real = importlib.util.find_spec
    absent = ("transformers", "depth_anything_3", "moge", "cotracker")
    monkeypatch.setattr(table.importlib.util, "find_spec", lambda m, *a: None if m in absent else real(m, *a))
    monkeypatch.setattr(table, "in_hub_cache", lambda model: False)
    monkeypatch.delenv("TAA_CONFIG", raising=False)
    monkeypatch.chdir(tmp_path)
    return Settings()


@pytest.fixture
def full(monkeypatch, tmp_path):
    """A machine with every extra, every checkout and all weights."""
    real = importlib.util.find_spec
    extra = ("transformers", "depth_anything_3", "moge", "cotracker")
    monkeypatch.setattr(table.importlib.util, "find_spec", lambda m, *a: object() if m in extra else real(m, *a))
    monkeypatch.setattr(table, "in_hub_cache", lambda model: True)
    lines = []
    for options in PROVIDERS.values():
        for p in options:
            if p.kind != "repository":
                continue
            lines.append(f"[{p.name}]")
            for key, inside in p.files:
                at = tmp_path / p.name / key
                if key == "python":
                    at = sys.executable
                elif inside:
                    (at / inside).parent.mkdir(parents=True, exist_ok=True)
                    (at / inside).touch()
                else:
                    at.parent.mkdir(parents=True, exist_ok=True)
                    at.touch()
                lines.append(f"{key} = {json.dumps(str(at))}")
    file = tmp_path / "taa.toml"
    file.write_text("\n".join(lines))
    return load_settings(file)


def test_a_bare_machine_runs_the_embedded_ones_and_says_why_not_the_others(bare):
    rows = {(r["stage"], r["name"]): r for r in states(bare)}
    assert set(rows) == {(p.stage, p.name) for options in PROVIDERS.values() for p in options}
    for (stage, name), row in rows.items():
        embedded = find(stage, name).kind == "embedded"
        assert row["runs"] == embedded, (stage, name)
        if not embedded:
            missing = (find(stage, name).modules or ("x",))[-1]
            assert missing in row["why"] or f"no section [{name}]" in row["why"]
            assert row["get"] and row["get"] != "comes with taa-envs"


def test_a_full_machine_runs_all(full):
    rows = {(r["stage"], r["name"]): r for r in states(full)}
    cannot = {key: row["why"] for key, row in rows.items() if not row["runs"]}
    # CoTracker3's weights are a file that only the user can name.
    assert set(cannot) <= set(), cannot


@pytest.mark.parametrize("text, fits", [("raise RuntimeError('operator torchvision::nms does not exist')", False),
                                        ("", True)])  # fmt: skip
def test_a_torchvision_for_another_pytorch_is_an_obstacle(full, tmp_path, monkeypatch, text, fits):
    """transformers looks for it and fails with it, for all that it does not need it."""
    (tmp_path / "site" / "torchvision").mkdir(parents=True)
    (tmp_path / "site" / "torchvision" / "__init__.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.delitem(sys.modules, "torchvision", raising=False)
    table.broken_torchvision.cache_clear()
    try:
        why = obstacle(find("segment", "sam2"), full)
        assert (why is None) == fits
        if not fits:
            assert "torchvision::nms" in why and "uninstall it" in why
        assert obstacle(find("track", "lk"), full) is None
    finally:
        table.broken_torchvision.cache_clear()
        sys.modules.pop("torchvision", None)


def test_each_obstacle_is_named_exactly(full, tmp_path, monkeypatch):
    def without(name, key):
        sections = {n: {k: v for k, v in s.items() if (n, k) != (name, key)} for n, s in full.sections.items()}
        return obstacle(next(p for o in PROVIDERS.values() for p in o if p.name == name), Settings(full.path, sections))

    assert "python of [trackcraft3r] is not set" in without("trackcraft3r", "python")
    assert "checkpoint of [segvigen] is not set" in without("segvigen", "checkpoint")
    assert "repository of [released] is not set" in without("hawor", "pipeline")
    sections = {**full.sections, "wilor": {**full.sections["wilor"], "repository": str(tmp_path / "gone")}}
    assert f"there is no {tmp_path / 'gone'}" in obstacle(find("hand", "wilor"), Settings(full.path, sections))
    plain = tmp_path / "plain"
    plain.write_text("")
    sections = {**full.sections, "wilor": {**full.sections["wilor"], "python": str(plain)}}
    if not os.access(plain, os.X_OK):
        assert "no executable file" in obstacle(find("hand", "wilor"), Settings(full.path, sections))
    monkeypatch.setattr(table, "in_hub_cache", lambda model: False)
    assert "accepted their licence" in obstacle(find("segment", "sam3"), full)
    assert obstacle(find("segment", "sam2"), full) is None
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert "HF_HUB_OFFLINE" in obstacle(find("segment", "sam2"), full)
    assert "is no file" in (obstacle(find("track", "cotracker3"), full) or "") or "there is no file" in obstacle(
        find("track", "cotracker3"), full
    )
    weights = tmp_path / "weights"
    weights.mkdir()
    sections = {**full.sections, "sam2": {"model": str(weights)}}
    assert obstacle(find("segment", "sam2"), Settings(full.path, sections)) is None, "a local folder needs no hub"


def test_no_default_is_non_commercial_or_needs_anything(bare):
    for stage, options in PROVIDERS.items():
        assert options[0].kind == "embedded" and not options[0].non_commercial, stage
        assert is_default(stage, options[0].name)
    for options in PROVIDERS.values():
        for p in options:
            words = (p.code + p.weights).upper()
            assert p.non_commercial == ("NC" in p.code.upper() or "MANO" in words), p.name
            assert ("non-commercial" in p.licence) == p.non_commercial
            assert "NC" not in (p.model or "").upper().split("-")
    for name in ("depth-anything/DA3-BASE", "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"):
        assert any(p.model == name for options in PROVIDERS.values() for p in options)


def test_every_provider_that_can_be_chosen_has_its_function():
    for stage in table.CHOSEN:
        for p in PROVIDERS[stage][1:]:
            if stage not in table.TOOLS and p.kind != "repository":
                assert callable(maker_of(stage, p.name)), (stage, p.name)
    assert set(_MODULES) == {(s, p.name) for s in table.CHOSEN if s not in table.TOOLS for p in PROVIDERS[s][1:]}


def test_choosing(bare):
    assert choose(None, bare)["track"] == "lk"
    assert choose({"track": "xfeat"}, bare)["track"] == "xfeat"
    with pytest.raises(TaaError, match="known: lk, xfeat"):
        choose({"track": "optical-flow"}, bare)
    with pytest.raises(TaaError, match="known: camera"):
        choose({"smell": "x"}, bare)
    with pytest.raises(TaaError, match=r"sam2 cannot run here: the Python module transformers.*pip install"):
        choose({"segment": "sam2"}, bare)
    with pytest.raises(TaaError, match=r"no section \[hawor\]"):
        choose({"hand": "hawor"}, bare)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[sam4]\nmodel = 'x'", "sections are sam3"),
        ("model = 'x'", "no use for 'model'"),
        ("[sam3]\nmodle = 'x'", "no key 'modle'; known: model"),
        ("[sam3]\nbatch = 'four'", "batch of \\[sam3\\] must be a int"),
        ("[sam3]\nbatch = true", "must be a int"),
        ("[sam3", "must be TOML"),
    ],
)
def test_wrong_settings_are_one_clear_line(tmp_path, text, words):
    file = tmp_path / "taa.toml"
    file.write_text(text)
    with pytest.raises(TaaError, match=words) as error:
        load_settings(file)
    assert "\n" not in str(error.value)


def test_where_settings_are_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("TAA_CONFIG", raising=False)
    assert load_settings().path is None
    (tmp_path / "config" / "taa-envs").mkdir(parents=True)
    (tmp_path / "config" / "taa-envs" / "taa.toml").write_text("[sam2]\nmodel = 'user'")
    assert load_settings().section("sam2")["model"] == "user"
    (tmp_path / "taa.toml").write_text("[sam2]\nmodel = 'here'")
    assert load_settings().section("sam2")["model"] == "here"
    (tmp_path / "named.toml").write_text("[sam2]\nmodel = 'named'")
    monkeypatch.setenv("TAA_CONFIG", str(tmp_path / "named.toml"))
    assert load_settings().section("sam2")["model"] == "named"
    monkeypatch.setenv("TAA_CONFIG", str(tmp_path / "gone.toml"))
    with pytest.raises(TaaError, match="gone.toml, which is no file"):
        load_settings()
    assert set(SECTIONS) >= {p.name for o in PROVIDERS.values() for p in o if p.kind != "embedded"}
