"""Many videos: every one in a process of its own, on this machine or on a Ray cluster, with a manifest that survives.

:func:`build` is what ``taa build`` calls. See ``docs/fleet.md``.
"""

from reconstruct.fleet.build import Build, build
from reconstruct.fleet.manifest import Manifest, Row

__all__ = ["Build", "Manifest", "Row", "build"]
