"""Video -> asset: the stages in order, each one function, each resumable from the scene folder."""

from __future__ import annotations

import contextlib
import functools
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from reconstruct import cues_io
from reconstruct.cues import HandReference, Hands, LinkMasks, ProviderInfo, Tracks
from reconstruct.errors import Refused, TaaError
from reconstruct.export import further_objects, joint_object, plain, refused_joint, write_asset
from reconstruct.geometry import Geometry
from reconstruct.joint.models import JointFit
from reconstruct.store import load_stage, save_stage, stage_key
from reconstruct.video import Video, load_video
from taa_envs.files import written_whole

if TYPE_CHECKING:
    from reconstruct.providers.edge_tracks import Segments
    from taa_envs.asset import Asset


ARM_SHARE = 0.2
"""Where no joint is found and this share of what moves stays on a forearm, it is sought without the arms' tracks."""
TRACKING = tuple(f"providers/{n}.py" for n in ("lk_tracks", "affine", "seeds", "shade"))
"""Source files that follow points."""
JOINT = ("joint", "depth.py", "hand/carried.py", "hand/forearm.py", "providers/edge_tracks.py", "providers/shade.py")
"""Source files that find the joint."""


class Progress(Protocol):
    """What is told about a run, one stage after another."""

    def start(self, stage: str) -> None: ...
    def update(self, share: float) -> None: ...
    def finish(self, seconds: float, note: str = "") -> None: ...


class Silent:
    """No progress."""

    def start(self, stage: str) -> None: ...
    def update(self, share: float) -> None: ...
    def finish(self, seconds: float, note: str = "") -> None: ...


@dataclass(frozen=True)
class ReconstructResult:
    """What came of a video.

    Attributes:
        id: the asset's id.  asset: None where the answer is a refusal.
        joint: the contract's joint object.  replay: the contract's replay object, or None.
        further: ``joint_2``, ``joint_3`` ... of an object with several joints.
        seconds: per stage.  notes: what a user should know.
        error: "what is wrong; what to do" of a refusal.
    """

    id: str
    asset: Asset | None
    joint: dict
    replay: dict | None
    seconds: dict[str, float]
    notes: tuple[str, ...] = ()
    error: str | None = None
    further: Mapping[str, dict] = field(default_factory=dict)

    def as_dict(self) -> dict:
        """The contract's object, plain types only."""
        path = str(self.asset.path) if self.asset else None
        return plain({"id": self.id, "asset": path, "joint": self.joint, **self.further, "replay": self.replay,
                      "seconds": self.seconds, "notes": list(self.notes)})  # fmt: skip


class Stopped(Exception):
    """The stage after which a run was to end is done."""


@dataclass
class Stages:
    """Runs stages: times them, tells their progress, and takes results that are still valid from the scene folder.

    Attributes:
        folder: ``scene/stages``, or None to keep nothing.
        inputs: what every stage depends on (the video's digest).
        until: name of the last stage to run; :class:`Stopped` is raised after it.
        keys: the key of each stage that has run; a stage depends on all before it.
        chosen: stage -> provider.  notes: what providers had to say.
    """

    folder: Path | None
    progress: Progress
    inputs: dict[str, Any] = field(default_factory=dict)
    until: str | None = None
    keys: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    chosen: Mapping[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def provide(self, stage: str, cue: str, video: Video, scene: Path | None, seed: int, **inputs: Any) -> None:
        """Let the chosen provider of a stage make its cue; the embedded ones run inside the pipeline's own stages."""
        from reconstruct.providers.make import provide, request_for
        from reconstruct.providers.table import is_default

        name = self.chosen.get(stage)
        if scene is None or name is None or is_default(stage, name):
            return
        request = replace(request_for(video, scene, self.chosen, seed, self.progress.update), **inputs)
        label = f"{stage}: {name}"
        self.notes += self.run(label, lambda: provide(stage, cue, request), keep=False)
        self.keys.pop(label)  # the cue's digest stands for it

    def run(self, name: str, make: Callable[[], Any], code: tuple[str, ...] = (), keep: bool = True,
            options: Mapping[str, Any] | None = None, given: str | None = None) -> Any:  # fmt: skip
        """Result of one stage.

        Args:
            name: of the stage.  make: computes it.
            code: source files and packages of ``reconstruct`` that compute it.
            keep: save it in the scene folder.
            options: what else it depends on, JSON-ready.
            given: digest of the user's cue that makes it; not saved again, named in the progress.
        """
        begin = time.monotonic()
        self.progress.start(name)
        key = stage_key(name, code, {**self.inputs, "before": dict(self.keys), "options": dict(options or {}),
                                     "given": given})  # fmt: skip
        file = self.folder / f"{name}.npz" if self.folder and keep and not given else None
        value = load_stage(file, key) if file else None
        note = "from the scene folder" if value is not None else "your cue" if given else ""
        if value is None:
            value = make()
            if file:
                save_stage(file, key, value)
        self.keys[name] = key
        self.seconds[name] = time.monotonic() - begin
        self.progress.finish(self.seconds[name], note)
        if name == self.until:
            raise Stopped(name)
        return value


@dataclass(frozen=True)
class Seen:
    """All that was found in one video up to the joint."""

    video: Video
    hands: Hands
    tracks: Tracks
    fit: JointFit
    providers: tuple[ProviderInfo, ...]
    notes: tuple[str, ...]
    focal_given: bool
    unit: float = 1.0


def reconstruct(video_path: str | Path, id: str, scene: str | Path | None = None, out: str | Path | None = None,
                focal: float | None = None, providers: Mapping[str, str] | None = None, overwrite: bool = False,
                seed: int = 0, progress: Progress | None = None, until: str | None = None
                ) -> ReconstructResult:  # fmt: skip
    """One video of a hand moving an articulated object, as an asset folder.

    Args:
        video_path: the video.
        id: of the asset, ``[a-z0-9][a-z0-9_-]{0,63}``.
        scene: folder that keeps cues and results; a second run takes from it what is still valid.
        out: folder of assets, default the user's data folder.
        focal: focal length of the upright full-size frame, px.
        providers: stage ("hand", "track", ...) -> name of a provider, see ``taa doctor``.
        overwrite: replace an asset of that id.
        seed: of everything that draws.
        progress: told about every stage.
        until: end after the stage of that name, whose result stays in the scene folder; the result has then neither
            asset nor error. For cues on one machine and the rest on another.

    Returns:
        The asset with its joint and replay, or a refusal with its reason.

    Raises:
        TaaError, taa_envs.TaaEnvsError: the request cannot be met (no such file, id taken, ...).
    """
    from reconstruct.providers.table import choose, is_default
    from taa_envs.asset import AssetExists, check_id
    from taa_envs.registry import user_folder

    check_id(id)
    chosen = choose(providers)
    if focal is not None and not 1.0 <= focal <= 1e6:
        raise TaaError(f"a focal length of {focal:g} px is not possible; give it in pixels of the full-size frame")
    root = Path(out) if out is not None else user_folder()
    final = root / id
    if final.exists() and not overwrite:
        raise AssetExists(f"{final} exists; choose another id or replace it with --overwrite")
    scene = Path(scene) if scene is not None else None
    stages = Stages(scene / "stages" if scene else None, progress or Silent(), {"seed": seed}, until, chosen=chosen)
    with tempfile.TemporaryDirectory(prefix="taa-") as scratch, contextlib.suppress(Stopped):
        if scene is None and not all(is_default(stage, name) for stage, name in chosen.items()):
            scene = Path(scratch) / "scene"  # the cues of chosen providers need a place
        return _reconstruct(Path(video_path), id, scene, final, focal, overwrite, seed, stages, Path(scratch))
    return ReconstructResult(id, None, refused_joint(f"ended after the stage {until}"), None, stages.seconds)


def _reconstruct(path: Path, id: str, scene: Path | None, final: Path, focal: float | None, overwrite: bool, seed: int,
                 stages: Stages, scratch: Path) -> ReconstructResult:  # fmt: skip
    from taa_envs.errors import GateFailed

    video, seen = None, None
    try:
        video = stages.run("video", lambda: load_video(path, scratch, progress=stages.progress.update), keep=False)
        seen = look(video, scene, focal, seed, stages, scratch)
        if seen.fit.verdict == "refused":
            raise Refused(with_advice(seen.fit.reason))
    except Refused as refusal:
        return _refusal(path, id, scene, video, seen, str(refusal), stages)
    try:
        return _build(id, scene, final, overwrite, seed, seen, stages)
    except GateFailed as failed:
        if seen.fit.verdict == "ok":
            raise
        # A joint that was in doubt and makes a body that does not behave is none to build on. What the gate advises is
        # for those who make a body.
        reason = f"{seen.fit.reason}; {str(failed).split(';')[0]}"
        fit = replace(seen.fit, verdict="refused", reason=reason)
        return _refusal(path, id, scene, video, replace(seen, fit=fit), reason, stages)


def _refusal(path: Path, id: str, scene: Path | None, video: Video | None, seen: Seen | None, reason: str,
             stages: Stages) -> ReconstructResult:  # fmt: skip
    """The result without an asset, and its page in the scene folder."""
    from reconstruct.report import refusal_report

    fit = seen.fit if seen is not None else None
    joint = joint_object(fit, video.index) if fit is not None and video is not None else refused_joint(reason)
    notes = seen.notes if seen is not None else video.notes if video is not None else ()
    if scene is not None:
        scene.mkdir(parents=True, exist_ok=True)
        page = refusal_report(
            id, path, video, seen and seen.hands, seen and seen.tracks, fit, reason, notes, stages.seconds
        )
        with written_whole(scene / "report.html") as partial:
            partial.write_text(page, encoding="utf-8")
    return ReconstructResult(id, None, joint, None, stages.seconds, notes, reason)


def with_advice(reason: str) -> str:
    """A refusal's reason as "what is wrong; what to do"."""
    if ";" in reason:
        return reason
    return f"{reason.rstrip('.')}; film one part that moves on a fixed joint, slowly and over a large range"


def look(video: Video, scene: Path | None, focal: float | None, seed: int, stages: Stages, scratch: Path) -> Seen:
    """The stages from pixels to the joint: camera, hands, tracks, joint, scale."""
    from reconstruct.motion import stabilise
    from reconstruct.providers.lk_tracks import track_points
    from reconstruct.providers.mediapipe_hand import detect_hands

    stages.inputs.update(video=video.sha256, frames=[len(video), *video.frames.shape[1:3]])
    if scene is not None:
        cues_io.CueFolder(scene, stages.chosen).write("frames", {"time": video.time})
        cues_io.save_facts(scene, video)

    stable, _ = stages.run("camera", lambda: stabilise(video, scratch, seed), ("motion.py",), keep=False)
    # Every cue refers to the same pixels: providers look at the stabilised video, as all else does.
    for stage in ("camera", "depth"):
        stages.provide(stage, stage, stable, scene, seed)
    stages.provide("hand", "hand", stable, scene, seed)
    folder = cues_io.CueFolder(scene, stages.chosen) if scene is not None else None
    given = folder.given() if folder else {}
    camera = folder.read("camera", "K") if folder and "camera" in given else None
    stages.inputs.update(camera=given.get("camera"))
    notes = list(dict.fromkeys([*video.notes, *stable.notes]))

    def find_hands() -> Hands:
        if folder is None or "hand" not in given:
            return detect_hands(stable, stages.progress.update)
        mask = None
        if folder.users("masks"):
            mask = cues_io.mask_at_work_size(folder.read("masks", "hand")["hand"], stable, "hand")
        cue = folder.read("hand", *cues_io.HAND_ARRAYS)
        return cues_io.hands_from_cue(cue, camera, stable, mask, folder.maker("hand"))

    hands = stages.run(
        "hands",
        find_hands,
        ("providers/mediapipe_hand.py", "providers/skin.py"),
        given=given.get("hand") and given["hand"] + (given["masks"] if folder and folder.users("masks") else ""),
    )
    if not hands.tracks:
        notes.append("no hand was seen; lengths are not metric and the replay has no hand to drive the part")

    def follow() -> Tracks:
        if folder is None or "tracks" not in given:
            return track_points(stable, hands, progress=stages.progress.update)
        return cues_io.tracks_from_cue(folder.read("tracks", "uv", "visible"), len(stable), folder.maker("tracks"))

    stages.provide("track", "tracks", stable, scene, seed, hands=hands)
    if folder and scene is not None:
        folder = cues_io.CueFolder(scene, stages.chosen)
        given = folder.given()
    tracks = stages.run("tracks", follow, TRACKING, given=given.get("tracks"))
    if folder:
        folder.write("tracks", cues_io.track_arrays(tracks))
    first = tracks
    tracks, fit, words, unit = _joint(stable, hands, first, focal, camera, folder, given, seed, stages,
                                      pixels="tracks" not in given)  # fmt: skip
    if folder and tracks is not first:
        folder.write("tracks", cues_io.track_arrays(tracks))
    if folder and fit.verdict != "refused":
        folder.write("camera", cues_io.camera_arrays(fit, len(stable)))
    makers = dict.fromkeys([hands.provider, tracks.provider])
    if folder:
        makers |= dict.fromkeys(folder.maker(name) for name in ("camera", "depth") if name in given)
    known = focal is not None or camera is not None
    return Seen(stable, hands, tracks, fit, tuple(makers), (*notes, *words), known, unit)


def joint_off_the_arm(video: Video, tracks: Tracks, hands: Hands, focal: float | None, seed: int,
                      progress: Callable[[float], None], margin_px: int | None = None) -> JointFit:  # fmt: skip
    """The joint without depth, from the tracks that go somewhere and are on no forearm and on no shadow's edge.

    Sleeves often have more tracks than the part, and go nearly as it goes. Where nothing is found without them and
    they were many, the wedge of an arm may have held the part: then all tracks are asked, and a joint that is not
    mostly an arm's counts. Shadows go nearly as the part goes too. What may be the edge of one is left out where enough
    else moves, and asked where nothing is found without it. What one straight edge alone follows is no sure joint.
    Where a body refutes it that is carried freely, what the hands carry is left out. Where nothing is found at all,
    or the joint stays in doubt, the part's straight edges are followed and asked too. States that its points do not
    show are looked for by these.

    Args:
        margin_px: how far off hands pictures are looked at, as of :func:`lk_tracks.pictures_of`; as usual when None.
    """
    from reconstruct.hand.forearm import on_forearm
    from reconstruct.joint.answers import open_states_told, type_no_surer
    from reconstruct.joint.edges import unless_one_edge
    from reconstruct.joint.fit import fit_joint, moving_tracks
    from reconstruct.joint.flat_fit import FlatFit, fit_flat
    from reconstruct.joint.handling import unless_carried
    from reconstruct.joint.rims import unless_rims_tell
    from reconstruct.joint.shadows import off_shadows, unless_a_shadow, without
    from reconstruct.joint.unseen import with_unseen_states
    from reconstruct.joint.wander import wandering
    from reconstruct.providers.edge_tracks import all_segments, edge_tracks
    from reconstruct.providers.lk_tracks import MARGIN_PX, pictures_of

    pictures = pictures_of(video, hands, MARGIN_PX if margin_px is None else margin_px)
    tracks = without(tracks, wandering(video, tracks))
    arm = on_forearm(tracks, hands)
    share = float(np.mean(arm[moving])) if len(moving := moving_tracks(video, tracks)) else 0.0
    rest = without(tracks, arm) if share > 0 else tracks
    lit = off_shadows(video, rest)

    def ask(some: Tracks) -> JointFit:
        return fit_joint(video, some, focal, seed, progress, camera_moving=False, pictures=pictures)

    @functools.cache
    def lines() -> list[Segments]:
        return all_segments(video, pictures)

    @functools.cache
    def rims() -> Tracks:
        edges = edge_tracks(video, pictures, lines())
        return edges.of(~on_forearm(edges, hands))

    def flat(points: Tracks, edges: Tracks) -> FlatFit | None:
        return fit_flat(video, points, edges, focal)

    def off_shadows_too(some: Tracks) -> JointFit:
        return unless_a_shadow(ask(some), video, some, ask)

    fit, asked = ask(lit), lit
    if fit.verdict == "refused" and lit is not rest:
        fit, asked = ask(rest), rest
    fit = unless_one_edge(unless_a_shadow(fit, video, asked, ask), video, asked, off_shadows_too)
    if fit.verdict == "refused" and share >= ARM_SHARE:
        again = unless_one_edge(off_shadows_too(tracks), video, tracks, off_shadows_too)
        if again.verdict != "refused" and np.mean(arm[again.point_track]) < 0.5:
            return type_no_surer(open_states_told(again))
    fit = unless_carried(fit, video, rest, hands, off_shadows_too)
    fit = unless_rims_tell(fit, video, rest, rims, ask, flat)
    fit = type_no_surer(open_states_told(with_unseen_states(fit, video, pictures, rest, rims, lines)))
    # No semicolon: what follows one is advice.
    return replace(fit, reason=f"without what is on an arm, {fit.reason}") if share >= ARM_SHARE else fit


def _joint(video: Video, hands: Hands, tracks: Tracks, focal: float | None, camera: cues_io.Arrays | None,
           folder: cues_io.CueFolder | None, given: Mapping[str, str], seed: int, stages: Stages,
           pixels: bool) -> tuple[Tracks, JointFit, list[str], float]:  # fmt: skip
    """The tracks that it is a joint of: those given, or some up to the hands' rims; the joint, metric where a scale is
    known, in the world of the user's camera where there is one; notes; and the length of that world's unit in the
    joint's.

    Args:
        pixels: whether the video's pixels may be followed once more.
    """
    from reconstruct.depth import depth_scale
    from reconstruct.hand.scale import hand_scale
    from reconstruct.joint.rigid.cues import fit_from_cues
    from reconstruct.others import second_part, words_of
    from reconstruct.several import alongside, joint_beside

    notes: list[str] = []
    if focal is None and camera is not None:
        focal = cues_io.focal_of(camera)
    if focal is None:
        focal = video.focal_px

    tracks_cue = folder.read("tracks", "uv", "visible") if folder is not None and "tracks" in given else {}
    ranged = camera is not None and folder is not None and ("depth" in given or "xyz_world" in tracks_cue)

    def find() -> JointFit:
        if not ranged:
            return joint_off_the_arm(video, tracks, hands, focal, seed, stages.progress.update)
        depth, metric = None, bool(camera.get("metric", np.array(True)))
        if "xyz_world" not in tracks_cue:
            cue = folder.read("depth", "depth")
            depth = cues_io.expect_shape(np.asarray(cue["depth"]), (len(video), None, None), "depth of cues/depth.npz")
            metric = bool(cue.get("metric", np.array(True)))
        moving = folder.read("masks", "moving")["moving"] if folder.users("masks") else None
        return fit_from_cues(tracks, camera, depth, tracks_cue.get("xyz_world"), moving, video.size, metric, seed)

    with_depth = {key: given.get(key) for key in ("depth", "camera", "masks")} if ranged else None
    fit: JointFit = stages.run("joint", find, JOINT, options={"focal": focal, "with_depth": with_depth})
    if ranged and fit.verdict == "refused":
        notes.append(f"the tracks with depth hold no joint ({fit.reason}); fitted again without depth")
        ranged = False
        fit = stages.run("joint", find, JOINT, options={"focal": focal, "with_depth": None})
    if pixels and not ranged:
        tracks, fit = _up_to_hands(fit, video, tracks, hands, focal, seed, stages)
    if fit.verdict == "refused":
        return tracks, fit, notes, 1.0
    plain = fit

    def scaled() -> JointFit:
        if folder is not None and "depth" in given and not ranged:
            depth = cues_io.metric_depth_from_cue(folder.read("depth", "depth"), len(video))
            if depth is not None:
                return depth_scale(fit, tracks, depth, video.size)
        return fit

    fit = stages.run("scale", lambda: hand_scale(scaled(), hands, video.time), ("hand", "depth.py"),
                     options={"depth": given.get("depth")})  # fmt: skip
    if "depth" in given and fit.scale_source != "depth" and not ranged:
        notes.append("cues/depth.npz gives no scale: it is not metric or hardly meets the part's points")
    if camera is not None and "T_world_camera" in camera and not ranged:
        fit = cues_io.in_world_of(fit, camera)
    if not ranged and (other := second_part(video, tracks, plain)):
        beside: JointFit = stages.run("joint-2", lambda: joint_beside(video, tracks, plain, other, seed),
                                      ("joint", "others.py", "several.py"))  # fmt: skip
        if beside.verdict == "refused":
            notes.append(f"{words_of(video, other)} (fitted by itself: {beside.reason})")
        else:
            plain = replace(plain, further=(beside,))
    fit = alongside(fit, plain)
    # A scene without metres whose joint the hand has scaled: what else it holds, meshes, is scaled alike.
    lengths = [np.median(np.linalg.norm(f.points, axis=1)) for f in (plain, fit)]
    return tracks, fit, notes, float(lengths[1] / lengths[0]) if ranged else 1.0


def _up_to_hands(fit: JointFit, video: Video, tracks: Tracks, hands: Hands, focal: float | None, seed: int,
                 stages: Stages) -> tuple[Tracks, JointFit]:  # fmt: skip
    """The tracks and their joint, or those up to the hands' rims and theirs."""
    from reconstruct.joint.closer import unless_hands_hide_it
    from reconstruct.providers.lk_tracks import CLOSE_PX, track_points

    def follow() -> Tracks:
        made: Tracks = stages.run(
            "tracks-closer",
            lambda: track_points(video, hands, progress=stages.progress.update, margin_px=CLOSE_PX),
            TRACKING,
        )
        return made

    def ask(some: Tracks) -> JointFit:
        made: JointFit = stages.run(
            "joint-closer",
            lambda: joint_off_the_arm(video, some, hands, focal, seed, stages.progress.update, CLOSE_PX),
            JOINT,
            options={"focal": focal},
        )
        return made

    return unless_hands_hide_it(fit, video, tracks, hands, follow, ask)


def _build(id: str, scene: Path | None, final: Path, overwrite: bool, seed: int, seen: Seen,
           stages: Stages) -> ReconstructResult:  # fmt: skip
    """The stages from the joint to the asset: masks, geometry, hand, asset, replay, report."""
    from reconstruct.geometry.collision import keep_clear
    from reconstruct.geometry.links import build_geometry
    from reconstruct.geometry.masks import segment_links
    from reconstruct.hand.align import align_hand
    from reconstruct.hand.holds import holding
    from reconstruct.report import add_report
    from reconstruct.several import further_geometry
    from taa_envs.asset import load_asset
    from taa_envs.errors import AssetError
    from taa_envs.files import folder_written_whole
    from taa_envs.replay import replay

    video, hands, tracks, fit = seen.video, seen.hands, seen.tracks, seen.fit
    stages.provide("segment", "masks", video, scene, seed, hands=hands, tracks=tracks, fit=fit)
    folder = cues_io.CueFolder(scene, stages.chosen) if scene is not None else None
    given = folder.given() if folder else {}

    def segment() -> LinkMasks:
        if folder is None or "masks" not in given:
            return segment_links(video, hands, tracks, fit)
        return cues_io.masks_from_cue(folder.read("masks", "static", "moving", "hand"), video)

    masks = stages.run("masks", segment, ("geometry",), given=given.get("masks"))
    stages.provide("mesh", cues_io.MESHES[1], video, scene, seed, hands=hands, tracks=tracks, fit=fit, masks=masks)
    if scene is not None:
        folder = cues_io.CueFolder(scene, stages.chosen)
        given = folder.given()
    makers = dict.fromkeys(seen.providers)
    if folder:
        makers |= dict.fromkeys(folder.maker(name) for name in ("masks", *cues_io.MESHES) if name in given)
    meshes = {name: given[name] for name in cues_io.MESHES if name in given}

    def shape() -> Geometry:
        links = cues_io.meshes_from_cue(folder.folder, meshes) if folder and meshes else {}
        if folder and "moving" in links:
            links["moving"] = cues_io.moving_at_rest(links["moving"], folder, fit, seen.unit)
        if folder and "static" in links and folder.users(cues_io.MESHES[0]):
            links["static"] = cues_io.scaled_link(links["static"], seen.unit)
        if len(links) == len(cues_io.MESHES):
            built = Geometry(links["static"], links["moving"])
        else:
            built = replace(build_geometry(video, hands, tracks, fit, masks), **links)
        if links:
            origin = {f"{name}_mesh": {"value": "cues/meshes", "origin": "given"} for name in links}
            whose = "your" if folder and folder.maker(next(iter(meshes))).name == "given" else "the given"
            words = f"{whose} mesh of the {' and the '.join(links)} link is taken as it is"
            built = replace(built, provenance={**built.provenance, **origin}, notes=(*built.notes, words))
        return built

    geometry: Geometry = stages.run("geometry", shape, ("geometry",), options={"meshes": meshes})
    if "masks" in given and len(meshes) == len(cues_io.MESHES):
        fit, geometry, words, maker = _refine(video, tracks, fit, geometry, masks, stages)
        seen = replace(seen, fit=fit, notes=(*seen.notes, words))
        makers |= {maker: None} if maker else {}
    elif stages.chosen.get("features", "none") != "none":
        stages.notes.append(f"the descriptors of {stages.chosen['features']} were not used: only masks and meshes from "
                            "outside are refined with them")  # fmt: skip
    geometry = keep_clear(geometry, fit)
    if fit.further:
        fit, geometry = stages.run("links", lambda: further_geometry(video, hands, tracks, fit, geometry),
                                   ("geometry", "several.py"))  # fmt: skip
    reference: HandReference = stages.run("hand", lambda: align_hand(video, hands, fit, geometry, masks), ("hand",))
    if reference.holds:
        geometry = keep_clear(holding(geometry, reference.holds), fit)
    if folder:
        folder.write("masks", cues_io.mask_arrays(masks))
        folder.write("hand", cues_io.hand_arrays(reference, hands))
        folder.write_meshes(geometry)
    notes = list(dict.fromkeys([*seen.notes, *stages.notes, *geometry.notes, *reference.notes]))
    for k, other in enumerate(fit.further, 2):
        turn = other.type != "prismatic"
        notes.append(f"joint_{k}: {other.type}, {np.degrees(np.ptp(other.q)) if turn else np.ptp(other.q):.3g} "
                     f"{'deg' if turn else 'm'}, {other.reason}; it is passive, the task is the first joint's")
    if not fit.metric:
        notes.append("no metric source; one unit of length is the moving part's median depth, taken as one metre")
    if fit.verdict == "ambiguous":
        notes.append(f"the joint is not certain: {fit.reason}")

    # The folder is made under a hidden name; it takes its own only when the report is in it too.
    with folder_written_whole(final, overwrite) as work:

        def save() -> Asset:
            work.rmdir()
            return write_asset(
                work.parent, id, video, fit, geometry, reference, tuple(makers), notes, seen.focal_given
            )

        def save_dominant(why: AssetError) -> Asset:
            """Without the further links, where the body does not pass the gate with them."""
            nonlocal fit, geometry
            notes.append(f"the further links are not in the asset: {why}")
            fit, geometry = replace(fit, further=()), replace(geometry, further=())
            work.mkdir(exist_ok=True)
            return stages.run("asset", save, keep=False)

        try:
            asset = stages.run("asset", save, keep=False)
        except AssetError as error:
            if not fit.further:
                raise
            asset = save_dominant(error)
        result = stages.run("replay", lambda: replay(asset), keep=False)
        notes += [n for n in result.notes if n not in notes]
        if result.joint_progress < 0.5 and result.contact_fraction < 0.5:
            notes.append("contact does not drive the part in the replay: see the table of the replay")
        if result.joint_progress < 0.5 and reference.contact.any():
            notes.append("the grip slips off or misses: `taa replay --refine` looks for one that holds, within what "
                         "the hand's placement leaves open")  # fmt: skip
        stages.run("report", lambda: add_report(asset, video, hands, tracks, fit, masks, geometry, reference, result,
                                                notes, stages.seconds), keep=False)  # fmt: skip
    asset = load_asset(final, check_model=False)
    if scene is not None:
        with written_whole(scene / "report.html") as partial:
            partial.write_bytes((final / "report.html").read_bytes())
    return ReconstructResult(id, asset, joint_object(fit, video.index), result.as_dict(), stages.seconds, tuple(notes),
                             further=further_objects(fit, video.index))  # fmt: skip


def _refine(video: Video, tracks: Tracks, fit: JointFit, geometry: Geometry, masks: LinkMasks,
            stages: Stages) -> tuple[JointFit, Geometry, str, ProviderInfo | None]:  # fmt: skip
    """The joint and the meshes' place by the masks: for masks and meshes that were not cut by the joint itself.

    Also says in words what came of it, and who made the descriptors, if any were asked for.
    """
    from reconstruct.providers.features import describe
    from reconstruct.refine import Mesh, Refinement, moved, refine_joint

    links = {"static": geometry.static, "moving": geometry.moving}
    meshes = {name: Mesh(link.vertices, link.faces) for name, link in links.items()}
    name = stages.chosen.get("features", "none")
    makers: list[ProviderInfo] = []

    def features(frames: Sequence[int]) -> np.ndarray:
        grid, maker = describe(video, frames, name)
        makers.append(maker)
        return grid

    described = features if name != "none" else None
    got: Refinement = stages.run("refine", lambda: refine_joint(fit, tracks, meshes, masks, video.size, described),
                                 ("refine",), keep=False)  # fmt: skip
    maker = makers[0] if makers else None
    words = f"outline {got.before['mask_px']:.2f} -> {got.after['mask_px']:.2f} px at 240 px width"
    if not got.after["mask_px"] < got.before["mask_px"]:
        return fit, geometry, f"image-space refinement did not bring the outline closer ({words}); not used", maker
    return got.fit, moved(geometry, got), f"joint and meshes refined against the masks: {words}", maker


def fit_scene(scene: str | Path, focal: float | None = None, seed: int = 0, progress: Progress | None = None) -> dict:
    """The articulation alone, from the cues of a scene folder; no pixel is read.

    Args:
        scene: a folder with ``cues/tracks.npz``. The picture's size and the times come from an earlier run's
            ``scene.json`` or from the cues; the scale from ``cues/depth.npz`` or the hand, where there is one.
        focal: focal length of the upright full-size frame, px.

    Returns:
        The contract's joint object.

    Raises:
        TaaError: there is no such folder, or a cue that is needed is missing.
    """
    scene = Path(scene)
    if not scene.is_dir():
        raise TaaError(f"no such folder: {scene}; give the scene folder of `taa reconstruct --scene`")
    folder = cues_io.CueFolder(scene)
    if not (folder.folder / "tracks.npz").is_file():
        raise TaaError(f"{scene} has no cues/tracks.npz; run `taa reconstruct --scene` first or put tracks there")
    video = cues_io.video_of_cues(scene)
    given = folder.given()
    tracks = cues_io.tracks_from_cue(folder.read("tracks", "uv", "visible"), len(video))
    camera = folder.read("camera", "K") if "camera" in given else None
    if "hand" in given:
        nothing = np.zeros(video.frames.shape[:3], bool)
        hands = cues_io.hands_from_cue(folder.read("hand", *cues_io.HAND_ARRAYS), camera, video, nothing)
    else:
        found = load_stage(scene / "stages" / "hands.npz", None)
        nobody = Hands((), np.zeros((len(video), 1, 1), bool), cues_io.GIVEN)
        hands = found if isinstance(found, Hands) and found.mask.shape[0] == len(video) else nobody
    stages = Stages(None, progress or Silent())
    _, fit, _, _ = _joint(video, hands, tracks, focal, camera, folder, given, seed, stages, pixels=False)
    return {**joint_object(fit, video.index), **further_objects(fit, video.index)}
