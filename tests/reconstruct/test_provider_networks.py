"""Networks of transformers: tiny random ones from a folder, through the real loading path, to a valid cue."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruct import cues_io
from reconstruct.errors import TaaError
from reconstruct.providers.features import describe, sample
from reconstruct.providers.make import provide
from reconstruct.providers.prompts import point_prompts, spread
from reconstruct.providers.settings import Settings
from tests.reconstruct import tiny_models
from tests.reconstruct.provider_scenes import H, T, W, small_hands, small_request, small_tracks, small_video

pytest.importorskip("transformers")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Folder of a tiny model by the name of its builder; made once."""
    made = {}

    def folder(kind: str, *args: str):
        key = (kind, *args)
        if key not in made:
            made[key] = getattr(tiny_models, f"save_{kind}")(tmp_path_factory.mktemp(kind), *args)
        return str(made[key])

    return folder


def test_metric_depth_arrives_at_working_size_in_metres(tmp_path, weights):
    settings = {"depth-anything-v2": {"model": weights("depth_anything"), "device": "cpu", "batch": 4}}
    request = small_request(tmp_path, settings, {"depth": "depth-anything-v2"})
    provide("depth", "depth", request)
    cue = request.folder.read("depth", "depth", "metric")
    assert cue["depth"].shape == (T, H, W) and cue["depth"].dtype == np.float32 and bool(cue["metric"])
    seen = cue["depth"][np.isfinite(cue["depth"])]
    assert len(seen) and (seen > 0).all() and (seen <= 20).all(), "the model's maximum depth is 20 m"
    maker = request.folder.maker("depth")
    assert maker.name == "depth-anything-v2" and "transformers" in maker.version and maker.stage == "depth"
    assert "/" not in maker.version, "provenance names the weights, not somebody's folder"


def test_relative_depth_is_no_depth(tmp_path, weights):
    settings = {"depth-anything-v2": {"model": weights("depth_anything", "relative"), "device": "cpu"}}
    with pytest.raises(TaaError, match="up to scale and shift.*Metric"):
        provide("depth", "depth", small_request(tmp_path, settings, {"depth": "depth-anything-v2"}))


def test_a_cue_is_made_again_only_if_something_changed(tmp_path, weights):
    settings = {"depth-anything-v2": {"model": weights("depth_anything"), "device": "cpu"}}
    chosen = {"depth": "depth-anything-v2"}
    provide("depth", "depth", small_request(tmp_path, settings, chosen))
    file = tmp_path / "cues" / "depth.npz"
    made = file.stat().st_mtime_ns
    provide("depth", "depth", small_request(tmp_path, settings, chosen))
    assert file.stat().st_mtime_ns == made
    provide("depth", "depth", small_request(tmp_path, settings, chosen, seed=1))
    assert file.stat().st_mtime_ns != made
    assert cues_io.CueFolder(tmp_path, {"depth": "none"}).given() == {}, "another provider was chosen"
    np.savez(file, depth=np.ones((T, 4, 6), np.float32), metric=True)
    notes = provide("depth", "depth", small_request(tmp_path, settings, chosen))
    assert "yours" in notes[0] and cues_io.CueFolder(tmp_path).read("depth")["depth"].shape == (T, 4, 6)


@pytest.mark.parametrize("name", ["sam2", "sam3"])
def test_masks_from_points_arrive_at_working_size(tmp_path, weights, name):
    video = small_video()
    request = small_request(tmp_path, {name: {"model": weights(name), "device": "cpu"}}, {"segment": name}, video,
                            tracks=small_tracks(video), hands=small_hands(video))  # fmt: skip
    provide("segment", "masks", request)
    cue = request.folder.read("masks", "static", "moving", "hand")
    for part in ("static", "moving", "hand"):
        assert cue[part].shape == (T, H, W) and cue[part].dtype == bool
    assert cue["moving"].any() and not (cue["moving"] & cue["hand"]).any() and not (cue["moving"] & cue["static"]).any()
    masks = cues_io.masks_from_cue(cue, video)
    assert masks.moving.shape == (T, H, W)
    assert request.folder.maker("masks").licence == (
        "Apache-2.0" if name == "sam2" else "code Apache-2.0; weights SAM License"
    )


def test_sam3_takes_words_too(tmp_path, weights):
    video = small_video(4)
    section = {"model": weights("sam3"), "device": "cpu", "moving": "door", "hand": "hand"}
    request = small_request(tmp_path, {"sam3": section}, {"segment": "sam3"}, video, tracks=small_tracks(video),
                            hands=small_hands(video))  # fmt: skip
    provide("segment", "masks", request)
    cue = request.folder.read("masks")
    assert cue["moving"].shape == (4, H, W) and not (cue["moving"] & cue["hand"]).any()


def test_the_instance_with_the_points_is_taken():
    from reconstruct.providers.sam import _instance_of

    video = small_video()
    prompts = point_prompts(video, small_tracks(video), None, small_hands(video))
    square = np.zeros((T, H, W), bool)
    for t in range(T):
        square[t, 20:44, 20 + 3 * t : 44 + 3 * t] = True
    elsewhere = np.zeros((T, H, W), bool)
    elsewhere[:, :10] = True
    assert _instance_of([elsewhere, square], "moving", prompts, video) is square
    assert _instance_of([np.zeros_like(square)], "moving", prompts, video) is None


def test_prompts_lie_on_their_parts():
    video = small_video()
    prompts = point_prompts(video, small_tracks(video), None, small_hands(video))
    assert 1 <= len(prompts) <= 3
    for p in prompts:
        at = video.to_work(p.moving)
        left = 20 + 3 * p.frame
        assert len(p.moving) == 8 and ((at >= (left, 20)) & (at < (left + 24, 44))).all()
        rest = video.to_work(p.static)
        inside = (rest[:, 0] >= left) & (rest[:, 0] < left + 24) & (rest[:, 1] >= 20) & (rest[:, 1] < 44)
        assert len(rest) and not inside.any() and len(p.hand)
    assert point_prompts(video, small_tracks(video).__class__(np.zeros((0, T, 2)), np.zeros((0, T), bool),
                                                              np.zeros(0, int), None)) == []  # fmt: skip


def test_spread_points_are_far_apart():
    points = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), -1).reshape(-1, 2)
    few = spread(points, 5)
    gaps = np.linalg.norm(few[:, None] - few[None], axis=-1) + np.eye(5) * 99
    assert gaps.min() > 4
    assert len(spread(points[:3], 5)) == 3


@pytest.mark.parametrize("name", ["xfeat", "dinov2"])
def test_descriptors_match_themselves_elsewhere(name, weights):
    """The square's cells look alike in the first and the last frame, wherever it is by then."""
    video = small_video()
    settings = Settings(None, {"dinov2": {"model": weights("dinov2"), "device": "cpu"}})
    grid, maker = describe(video, [0, 0, T - 1], name, settings)
    assert grid.shape[0] == 3 and np.allclose(np.linalg.norm(grid, axis=-1), 1, atol=1e-4)
    assert np.allclose(grid[0], grid[1], atol=1e-5) and not np.allclose(grid[0], grid[2], atol=1e-2)
    assert maker.stage == "features" and maker.name == name
    gh, gw = grid.shape[1:3]
    centres = np.stack(np.meshgrid((np.arange(gw) + 0.5) * W / gw - 0.5, (np.arange(gh) + 0.5) * H / gh - 0.5), -1)
    back = sample(grid[0], centres.reshape(-1, 2), (H, W))
    assert np.allclose(back, grid[0].reshape(-1, grid.shape[-1]), atol=2e-2)


def test_weights_that_cannot_be_loaded_are_one_clear_line(tmp_path, weights):
    (tmp_path / "empty").mkdir()
    settings = {"depth-anything-v2": {"model": str(tmp_path / "empty"), "device": "cpu"}}
    with pytest.raises(TaaError, match="cannot load .*taa.toml") as error:
        provide("depth", "depth", small_request(tmp_path, settings, {"depth": "depth-anything-v2"}))
    assert "\n" not in str(error.value)
    settings = {"depth-anything-v2": {"model": weights("depth_anything"), "device": "cuda:7"}}
    with pytest.raises(TaaError, match="cuda:7"):
        provide("depth", "depth", small_request(tmp_path, settings, {"depth": "depth-anything-v2"}))
