"""The report in a browser: nothing is asked for, nothing fails, the object turns and moves, a phone shows it whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reconstruct.cues import HandReference, Hands, LinkMasks, ProviderInfo, Tracks
from reconstruct.fleet.manifest import Manifest, Row
from reconstruct.fleet.page import write_page
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.joint.models import JointFit
from reconstruct.report import add_report
from reconstruct.video import Video
from taa_envs.asset import save_asset
from taa_envs.replay import replay
from tests.browser import Page, browser_or_skip
from tests.taa_envs.made import door_arguments

HOSTILE = "<img src=x onerror=\"console.error('ran')\"><script>console.error('ran')</script>"
T = 87


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    browser_or_skip()
    arguments = door_arguments()
    arguments["source"]["file"] = f"{HOSTILE}.mp4"
    asset = save_asset(tmp_path_factory.mktemp("assets"), "door", notes=[HOSTILE], **arguments)
    reference = asset.reference
    rng = np.random.default_rng(0)
    frames = np.broadcast_to(rng.integers(0, 255, (120, 160, 3), np.uint8), (T, 120, 160, 3)).copy()
    video = Video(Path("v.mp4"), "0" * 64, (640, 480), reference.time, np.arange(T), T, frames, 0.25)
    camera = asset.camera
    fit = JointFit(
        "ok",
        HOSTILE,
        type="revolute",
        type_probability={"revolute": 1.0},
        axis=np.array([0, 0, 1.0]),
        point=np.array([0, -0.01, 0.3]),
        q=reference.q,
        K=np.array(camera["K"]),
        residual_px=0.5,
        T_camera_world=np.array(camera["T_camera_world"]),
        metric=True,
        scale_source="hand",
        std={"q": np.full(T, 0.01)},
        image_line=np.array([[320.0, 100], [330, 400]]),
    )

    def mesh(link) -> LinkMesh:
        return LinkMesh(link.vertices, link.faces, link.colors, np.zeros(len(link.faces), bool), link.parts)

    nobody = ProviderInfo("nobody", "1", "Apache-2.0")
    empty = np.zeros((T, 120, 160), bool)
    hand = HandReference(
        reference.time, reference.q, reference.hand_joints, reference.hand_valid, reference.contact, "right"
    )
    add_report(
        asset,
        video,
        Hands((), empty, nobody),
        Tracks(np.zeros((0, T, 2)), np.zeros((0, T), bool), np.zeros(0, int), nobody),
        fit,
        LinkMasks(empty, empty, empty, np.zeros(T)),
        Geometry(mesh(arguments["static"]), mesh(arguments["moving"])),
        hand,
        replay(asset),
        [HOSTILE],
        {"video": 1.0, HOSTILE: 2.0},
    )
    return asset.path / "report.html"


@pytest.mark.slow
def test_the_report_in_a_browser(report: Path) -> None:
    with Page() as page:
        page.open(report)
        page.wait("document.getElementById('model').dataset.ready === 'yes'")
        assert page.requests == [report.as_uri()] and page.errors == []
        assert page.run("document.querySelectorAll('video').length") == 2
        page.wait("[...document.querySelectorAll('video')].every((v) => v.readyState >= 2 && v.videoWidth > 0)")

        def corners(q: int) -> np.ndarray:
            page.run(
                f"(() => {{ const s = document.getElementById('state'); s.value = {q}; "
                "s.dispatchEvent(new Event('input')); })()"
            )
            page.wait("!document.getElementById('follow').checked")
            return np.array(
                page.run(
                    "new Promise((done) => setTimeout(() => { const m = document.getElementById('model')."
                    "data[1]; done([...'xyz'].map((d) => [...m[d]])); }, 300))"
                )
            ).T

        shut, ajar = corners(0), corners(1000)
        angle = float(page.run("parseFloat(document.getElementById('state-words').textContent)"))
        assert angle == pytest.approx(np.degrees(1.05), abs=1)
        far = np.argmax(shut[:, 0])
        measured = np.arctan2(*(ajar[far] - [0, -0.01, 0])[1::-1]) - np.arctan2(*(shut[far] - [0, -0.01, 0])[1::-1])
        assert np.degrees(measured) == pytest.approx(angle, abs=1)
        before = page.run("document.getElementById('model').layout.scene.camera.eye")
        place = page.run(
            "(() => { const b = document.getElementById('model').getBoundingClientRect(); "
            "return [b.left + b.width / 2, b.top + b.height / 2 + scrollY]; })()"
        )
        page.run(f"window.scrollTo(0, {place[1] - 300})")
        for kind, dx in (("mousePressed", 0), ("mouseMoved", 60), ("mouseMoved", 120), ("mouseReleased", 120)):
            page.call(
                "Input.dispatchMouseEvent", type=kind, x=place[0] + dx, y=300, button="left", buttons=1, clickCount=1
            )
        page.wait(f"document.getElementById('model').layout.scene.camera.eye.x !== {before['x']}", 20)

        # A click on the plot is a moment of the film.
        page.run("document.getElementById('film').pause()")
        page.run(
            "(() => { const p = document.getElementById('plot'), b = p.getBoundingClientRect(); p.dispatchEvent("
            "new MouseEvent('click', {clientX: b.left + b.width * (0.075 + 0.905 / 2), clientY: b.top + 50})); })()"
        )
        page.wait(
            "Math.abs(document.getElementById('film').currentTime / document.getElementById('film').duration - 0.5)"
            " < 0.05"
        )
        page.size(360, 780, phone=True)
        page.wait("innerWidth <= 360")
        assert page.run("document.documentElement.scrollWidth") <= 360
        small = page.run(
            "[...document.querySelectorAll('p, li, td, span, b, label')].filter((e) => "
            "parseFloat(getComputedStyle(e).fontSize) < 12).length"
        )
        assert small == 0 and page.errors == [] and page.requests == [report.as_uri()]


@pytest.mark.slow
def test_the_gallery_in_a_browser(tmp_path: Path) -> None:
    manifest = Manifest(tmp_path)
    for k, state in enumerate(("done", "refused", "failed")):
        manifest.rows[f"v{k}"] = Row(f"v{k}", f"{HOSTILE}{k}.mp4", state, 3.0, 1, HOSTILE, HOSTILE)
    page_file = write_page(manifest, Path(HOSTILE))
    with Page() as page:
        page.open(page_file)
        assert page.run("document.querySelectorAll('article').length") == 3 and page.run("document.images.length") == 0
        page.run("document.querySelector('button.failed').click()")
        assert page.run("[...document.querySelectorAll('article')].filter((a) => !a.hidden).length") == 2
        page.size(360, 780, phone=True)
        assert page.run("document.documentElement.scrollWidth") <= 360
        assert page.errors == [] and page.requests == [page_file.as_uri()]
