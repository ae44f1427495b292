"""The documentation site builds strictly, asks nobody for anything, has a page for every command and environment."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from taa_envs import cli
from taa_envs.registry import shipped_folder
from tests.browser import Page, browser_or_skip

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("material", reason="the site needs mkdocs-material")
    out = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return out


@pytest.mark.slow
def test_the_site_is_whole(site: Path) -> None:
    for name in (
        "index",
        "start",
        "how",
        "limits",
        "install",
        "examples",
        "cli",
        "environment",
        "diagnose",
        "fleet",
        "robustness",
        "cite",
        "changelog",
        "contributing",
        "environments/all",
    ):
        assert (site / f"{name}.html").is_file(), name
    for asset in shipped_folder().glob("*/asset.json"):
        assert (site / "environments" / f"{asset.parent.name}.html").is_file()
    page = (site / "environments" / "all.html").read_text()
    assert "reach" in page and "joint_progress" in page and "<table>" in page
    commands = set(re.findall(r'subcommand\("([\w-]+)"\)', Path(cli.__file__).read_text()))
    listed = (ROOT / "docs" / "cli.md").read_text()
    assert not [c for c in commands if f"taa {c}" not in listed]


@pytest.mark.slow
def test_the_site_in_a_browser(site: Path) -> None:
    browser_or_skip()
    with Page() as page:
        for name in ("index", "how", "environments/all"):
            page.open(site / f"{name}.html")
            assert page.run("[...document.images].every((i) => i.complete && i.naturalWidth > 0)")
        page.size(360, 780, phone=True)
        assert page.run("document.documentElement.scrollWidth") <= 360
        assert page.errors == [] and all(r.startswith(site.as_uri()) for r in page.requests), page.requests


def test_the_citation_is_complete() -> None:
    text = (ROOT / "CITATION.cff").read_text()
    version = re.search(r'^version = "(.*)"', (ROOT / "pyproject.toml").read_text(), re.M)[1]
    assert f"version: {version}\n" in text and all(k in text for k in ("cff-version", "title", "authors", "license"))


def test_the_clips_stand_in_the_readme_as_on_their_page() -> None:
    def rows(page: Path) -> list[str]:
        return re.findall(r"^\| [a-z_0-9.]+ \| (?:revolute|prismatic|none) \|.*$", page.read_text(), re.M)

    own = rows(ROOT / "docs" / "benchmarks" / "clips.md")
    assert len(own) > 20 and own == rows(ROOT / "README.md")
