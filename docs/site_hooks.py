"""What mkdocs calls while it builds the site: the order of the pages, and a page an environment from its docstring."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

NAV = {
    "Start": ["index.md", "start.md", "how.md", "limits.md", "install.md", "examples.md"],
    "Use": ["cli.md", "environment.md", "hands.md", "train.md", "datasets.md", "diagnose.md", "fleet.md"],
    "Make": ["providers.md", "assets.md", "synth.md", "zoo.md"],
    "Measured": ["robustness.md"],
    "About": ["cite.md", "changelog.md", "contributing.md"],
}
COPIED = {"changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md", "examples.md": "examples/README.md"}
"""Pages that are files of the repository."""


def on_files(files: Files, config) -> Files:
    """Add the pages that are made: the environments', and files that live elsewhere in the repository."""
    for name, source in COPIED.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    for name, text, pictures in environments():
        files.append(File.generated(config, f"environments/{name}.md", content=text))
        for picture, path in pictures.items():
            files.append(File.generated(config, f"environments/{picture}", abs_src_path=str(path)))
    return files


def on_config(config):
    """Every page has a place: the ones of NAV in their order, the rest by their folder."""
    docs = Path(config["docs_dir"])
    there = {p.relative_to(docs).as_posix() for p in docs.rglob("*.md")} | set(COPIED)
    sections = {title: [p for p in pages if p in there] for title, pages in NAV.items()}
    placed = {p for pages in sections.values() for p in pages}
    sections["Measured"] += sorted(p for p in there if p.startswith("benchmarks/"))
    notes = sorted(p for p in there if p.startswith("notes/"))
    sections["Use"] += sorted(p for p in there - placed if "/" not in p)
    made = [f"environments/{name}.md" for name, _, _ in environments()]
    config["nav"] = [{t: pages} for t, pages in {**sections, "Environments": made, "Notes": notes}.items() if pages]
    return config


def environments() -> list[tuple[str, str, dict[str, Path]]]:
    """(name, Markdown, pictures) of the page of all environments and of each shipped asset's."""
    from taa_envs.asset import load_asset
    from taa_envs.env import ArticulationEnv
    from taa_envs.registry import shipped_folder
    from taa_envs.vector import BatchedArticulationEnv

    single, many = (inspect.getdoc(kind) or "" for kind in (ArticulationEnv, BatchedArticulationEnv))
    pages = [("all", f"# TAA/&lt;id&gt;\n\n{plain(single)}\n\n## Many at once\n\n{plain(many)}\n", {})]
    folders = sorted(p for p in shipped_folder().glob("[a-z0-9]*") if (p / "asset.json").is_file())
    for folder in folders:
        asset = load_asset(folder, check_model=False)
        rows = "\n".join(
            f"| {name} | {cell(p['value'])} | {cell(p.get('std'))} | {p.get('unit', '')} | {p['origin']} |"
            for name, p in sorted(asset.provenance.items())
        )
        notes = "".join(f"- {plain(note)}\n" for note in asset.metadata.get("notes") or [])
        picture = folder / "preview.png"
        image = f"![The video and the asset made from it]({asset.id}.png)\n\n" if picture.is_file() else ""
        source = (asset.metadata.get("source") or {}).get("file", "made by hand")
        span = abs(asset.demo["q_max"] - asset.demo["q_min"])
        parts = [
            f"# TAA/{asset.id}",
            image + f'```python\nenv = gymnasium.make("TAA/{asset.id}")\n```',
            f"A {asset.joint_type} joint, demonstrated over {span:.3g} {asset.unit} in {asset.demo['duration']:.1f} s; "
            f"source: {plain(source)}. Actions, observations, rewards and info are those of every environment here: "
            "[TAA/&lt;id&gt;](all.md).",
            notes,
            "## Every number and where it comes from",
            f"| name | value | std | unit | origin |\n| --- | --- | --- | --- | --- |\n{rows}\n",
        ]
        text = "\n\n".join(parts)
        pages.append((asset.id, text, {f"{asset.id}.png": picture} if picture.is_file() else {}))
    return pages


def plain(text: str) -> str:
    """Docstring to Markdown: its code marks, and nothing that HTML would take for a tag."""
    import re

    text = re.sub(r":\w+:`~?\.?([^`]*)`", r"`\1`", text).replace("``", "`")
    return "`".join(part if k % 2 else part.replace("<", "&lt;") for k, part in enumerate(text.split("`")))


def cell(value: object) -> str:
    """A value of ``asset.json`` in a table."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return f"{len(value)} numbers" if len(str(value)) > 60 else ", ".join(cell(v) for v in value)
    return plain(str(value)).replace("|", "\\|")
