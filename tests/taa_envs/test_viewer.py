"""`taa view` in a real browser: sliders for time and joint, and a play button that moves both."""

import signal
import subprocess
import sys
import time

import pytest

from tests.browser import Page, browser_or_skip

pytestmark = pytest.mark.slow


def test_the_viewer_plays_the_demonstration_and_ends_cleanly():
    pytest.importorskip("viser")
    browser_or_skip()
    from taa_envs.registry import get_asset

    demo = get_asset("synth-oven").demo
    command = [sys.executable, "-m", "taa_envs.cli", "view", "synth-oven", "--port", "18230"]
    viewer = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        line = next(line for line in viewer.stderr if line.startswith("synth-oven at "))
        url = line.split()[2].rstrip(";")
        with Page(1000, 700) as page:
            page.call("Page.navigate", url=url)
            page.wait("document.body?.innerText.includes('joint, rad') && document.body.innerText.includes('play')")
            # The values of both sliders, in the order in which they are shown.
            hidden = "[...document.querySelectorAll('input[type=hidden]')]"
            values = f"{hidden}.map(e => parseFloat(e.value)).filter(isFinite)"
            assert page.run(values) == pytest.approx([0.0, 0.0], abs=1e-3)
            click = "[...document.querySelectorAll('button')].find(b => b.innerText.trim() == '{}').click()"
            page.run(click.format("play"))
            page.wait(f"{values}[1] > {0.5 * demo['q_max']}", 60)
            page.run(click.format("pause"))
            page.wait("document.body.innerText.includes('play')")
            stopped = page.run(values)
            time.sleep(0.5)
            assert page.run(values) == stopped
            page.run(click.format("play"))  # it is to end while it plays
            assert not page.errors, page.errors
            assert all(r.startswith((url, url.replace("localhost", "127.0.0.1"))) for r in page.requests), page.requests
    finally:
        viewer.send_signal(signal.SIGTERM)
        code = viewer.wait(30)
    assert code == 0, viewer.stderr.read()
