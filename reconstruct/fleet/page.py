"""``index.html`` of a build: what became of every video, with pictures and links to the reports."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from reconstruct.fleet.manifest import STATES, Manifest
from taa_envs.files import written_whole


def write_page(manifest: Manifest, videos: Path) -> Path:
    """Write the gallery beside the manifest; pictures and reports are linked by relative paths.

    Returns:
        The page.
    """
    from jinja2 import Environment, StrictUndefined

    entries = []
    for row in manifest.rows.values():
        asset, scene = f"assets/{row.id}", f"scenes/{row.id}"
        picture, report = f"{asset}/preview.png", f"{asset}/report.html"
        if row.state == "refused":
            report = f"{scene}/report.html"
        entries.append(
            {
                "id": row.id,
                "video": row.video,
                "state": row.state,
                "words": row.result or row.error,
                "seconds": round(row.seconds),
                "attempts": row.attempts,
                "picture": quote(picture) if (manifest.folder / picture).is_file() else None,
                "report": quote(report) if (manifest.folder / report).is_file() else None,
            }
        )
    order = {state: i for i, state in enumerate(("done", "refused", "failed", "running", "waiting"))}
    entries.sort(key=lambda e: (order[e["state"]], e["id"]))
    counts = {state: n for state, n in manifest.counts().items() if n}
    template = (Path(__file__).parent / "gallery.html").read_text(encoding="utf-8")
    page = (
        Environment(autoescape=True, undefined=StrictUndefined)
        .from_string(template)
        .render(
            entries=entries,
            counts=counts,
            states=STATES,
            folder=videos.name,
            total=len(entries),
            hours=sum(r.seconds for r in manifest.rows.values()) / 3600,
        )
    )
    file = manifest.folder / "index.html"
    with written_whole(file) as partial:
        partial.write_text(page, encoding="utf-8")
    return file
