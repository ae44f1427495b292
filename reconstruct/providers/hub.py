"""Loading networks: from a hub id or a folder, onto a device, in a precision; one clear line when it fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.providers.table import find
from reconstruct.video import Video


def model_of(name: str, stage: str, section: Mapping[str, Any]) -> str:
    """Hub id or local folder of a provider's weights."""
    model = str(section.get("model") or find(stage, name).model)
    local = Path(model).expanduser()
    return str(local) if local.exists() else model


def device_of(section: Mapping[str, Any]) -> Any:
    """``torch.device`` named in the settings, else the accelerator that is there.

    Raises:
        TaaError: the named device is not there.
    """
    import torch

    from reconstruct.providers.table import device_here

    name = section.get("device", "auto")
    if name == "auto":
        return torch.device(device_here())
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        words = _first_line(error)
        raise TaaError(f"the device {name!r} of taa.toml cannot be used ({words}); set another one") from None
    return device


def dtype_of(section: Mapping[str, Any], device: Any) -> Any:
    """``torch.dtype``: as the settings say, else bfloat16 on a GPU that has it, float32 elsewhere."""
    import torch

    name = section.get("dtype", "auto")
    known = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
    if name == "auto":
        fast = device.type == "cuda" and torch.cuda.is_bf16_supported()
        return torch.bfloat16 if fast else torch.float32
    if name not in known:
        raise TaaError(f"dtype {name!r} of taa.toml is unknown; known: auto, {', '.join(known)}")
    return known[name]


def load_pretrained(cls: Any, model: str, device: Any, dtype: Any = None, **options: Any) -> Any:
    """``cls.from_pretrained(model)`` in evaluation mode on a device.

    Raises:
        TaaError: there are no such weights, they cannot be fetched, or they are of another architecture.
    """
    try:
        kind = {"dtype": dtype} if dtype is not None else {}
        loaded, report = cls.from_pretrained(model, output_loading_info=True, **kind, **options)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise TaaError(f"cannot load {model} as {cls.__name__} ({_first_line(error)}); set model in taa.toml to a "
                       "folder with the weights, or connect to the internet once") from error  # fmt: skip
    # A checkpoint of another network loads without an error, and leaves random numbers where its weights do not fit.
    missing, all_of_it = len(report["missing_keys"]), len(loaded.state_dict())
    if missing > 0.1 * all_of_it:
        raise TaaError(f"{model} holds no weights for {missing} of {all_of_it} parts of {cls.__name__}; "
                       "set model in taa.toml to weights of that network")  # fmt: skip
    return loaded.to(device).eval()


def weights_name(model: str) -> str:
    """A hub id as it is, a folder by its last name: provenance must not tell where somebody's home is."""
    return Path(model).name if Path(model).exists() else model


def version_of(package: str, model: str) -> str:
    """"package version, weights" for provenance."""
    import importlib.metadata

    try:
        version = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        version = "unknown version"
    return f"{package} {version}, {weights_name(model)}"


def run_batches(run: Any, count: int, size: int, tell: Any = lambda share: None) -> list[Any]:
    """``run(range)`` over all frames; a batch for which memory does not suffice is halved.

    Args:
        run: takes a range of frames, returns a list with one result a frame.
        count: of frames.  size: of the first batch; 0 chooses 8.

    Raises:
        TaaError: not even one frame fits into memory.
    """
    import torch

    size, done, out = size or 8, 0, []
    while done < count:
        part = range(done, min(done + size, count))
        try:
            out.extend(run(part))
        except torch.cuda.OutOfMemoryError:
            if size == 1:
                raise TaaError("one frame does not fit into the GPU's memory; set a smaller model in taa.toml, "
                               'or device = "cpu"') from None  # fmt: skip
            torch.cuda.empty_cache()
            size = max(1, size // 2)
            continue
        done = part.stop
        tell(done / count)
    return out


def rgb(video: Video, frames: Sequence[int] | range) -> np.ndarray:
    """(n, h, w, 3) uint8 RGB working frames."""
    return np.ascontiguousarray(np.stack([video.frames[t] for t in frames])[..., ::-1])


def work_to_full_K(K: np.ndarray, video: Video, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics of a picture of another size -> full px of the video.

    Both count pixels from the centre of the top-left one. The principal point moves with the pixels' corners:
    ``(c + 1/2) s - 1/2``.

    Args:
        K: (..., 3, 3).  size: (width, height) of the picture that K belongs to.
    """
    K = np.array(K, float)
    for axis in (0, 1):
        s = video.size[axis] / size[axis]
        K[..., axis, axis] *= s
        K[..., axis, 1 - axis] *= s
        K[..., axis, 2] = (K[..., axis, 2] + 0.5) * s - 0.5
    return K


def _first_line(error: BaseException) -> str:
    words = " ".join(str(error).split())
    return words[:160] if words else type(error).__name__
