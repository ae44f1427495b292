"""Joint logs: one measured episode of one joint, read with suspicion."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from taa_envs.errors import TaaEnvsError

MIN_SAMPLES = 20
MAX_BYTES = 256 << 20
FORCE_COLUMNS = ("force_x", "force_y", "force_z", "point_x", "point_y", "point_z")


class LogError(TaaEnvsError):
    """A joint log cannot be used; the message says what is wrong and what to do."""


@dataclass(frozen=True)
class JointLog:
    """One episode.

    Attributes:
        name: what to call it, usually the file's name.
        time: (N,) s, increasing, unevenly spaced or not.
        q: (N,) measured joint position, rad or m.
        torque: (N,) generalized force of whatever drives the joint, N m or N; None if not logged.
        force, point: (N, 3) a hand's force on the moving link and where it acts, world frame; None if not logged.
        markers: (N, K, 3) m, points fixed to the moving part, world frame, NaN where not seen; None if not logged.
    """

    name: str
    time: np.ndarray
    q: np.ndarray
    torque: np.ndarray | None = None
    force: np.ndarray | None = None
    point: np.ndarray | None = None
    markers: np.ndarray | None = None

    def __post_init__(self) -> None:
        for key in ("time", "q", "torque", "force", "point", "markers"):
            value = getattr(self, key)
            if value is not None:
                object.__setattr__(self, key, np.array(value, dtype=float))
        n = len(self.time)
        if n < MIN_SAMPLES:
            raise LogError(f"{self.name} holds {n} samples; a log needs at least {MIN_SAMPLES}, record longer")
        for key, shape in (("q", (n,)), ("torque", (n,)), ("force", (n, 3)), ("point", (n, 3))):
            value = getattr(self, key)
            if value is None:
                continue
            if value.shape != shape:
                raise LogError(f"{self.name}: {key} has shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                row = int(np.argmin(np.isfinite(value.reshape(n, -1)).all(axis=1)))
                raise LogError(f"{self.name}, sample {row}: {key} is not finite; drop that row or mend it")
        if not np.isfinite(self.time).all():
            raise LogError(f"{self.name}: time is not finite in some row; drop that row or mend it")
        step = np.diff(self.time)
        if not (step > 0).all():
            row = int(np.argmin(step > 0)) + 1
            raise LogError(f"{self.name}, sample {row}: time does not increase; sort the rows and drop doubles")
        if self.markers is not None:
            if self.markers.ndim != 3 or self.markers.shape[::2] != (n, 3):
                raise LogError(f"{self.name}: markers has shape {self.markers.shape}, expected ({n}, K, 3)")
            seen = np.isfinite(self.markers).all(axis=2).mean(axis=0)
            if np.isinf(self.markers).any() or (seen < 0.5).any():
                raise LogError(f"{self.name}: marker {int(np.argmin(seen)) + 1} is seen in {seen.min():.0%} of the "
                               "rows; leave out the columns of points that are seen in less than half")  # fmt: skip
        if (self.force is None) != (self.point is None):
            raise LogError(f"{self.name} has a force without its point (or the other way); log all of "
                           f"{', '.join(FORCE_COLUMNS)}")  # fmt: skip

    @property
    def dt(self) -> float:
        """Median sampling interval, s."""
        return float(np.median(np.diff(self.time)))


def load_log(path: Path | str) -> JointLog:
    """Read one CSV of the contract; extra columns are ignored.

    Raises:
        LogError: a column is missing, a cell is no number, times do not increase, too few samples.
    """
    path = Path(path)
    if not path.is_file():
        raise LogError(f"no such log: {path}; check the path")
    if path.stat().st_size > MAX_BYTES:
        raise LogError(f"{path} is larger than {MAX_BYTES >> 20} MiB; give one episode a file, thinned if need be")
    try:
        with path.open(newline="", encoding="utf-8-sig") as f:
            rows = csv.DictReader(f)
            names = rows.fieldnames or ()
            if not names:
                raise LogError(f"{path} is empty; a joint log is a CSV with the columns time and q")
            missing = {"time", "q"} - set(names)
            if missing:
                raise LogError(f"{path} has no column {' and '.join(sorted(missing))}; name the columns time and q")
            partial = [c for c in FORCE_COLUMNS if c in names]
            if partial and len(partial) < len(FORCE_COLUMNS):
                raise LogError(f"{path} has {', '.join(partial)} only; a hand's force needs {', '.join(FORCE_COLUMNS)}")
            marks = marker_columns(path, names)
            wanted = ["time", "q", *(["torque"] if "torque" in names else []), *partial, *marks]
            table = []
            for row in rows:
                try:  # a point that was not seen is an empty cell
                    table.append([float("nan") if c in marks and row[c] == "" else float(row[c]) for c in wanted])
                except (TypeError, ValueError):
                    raise LogError(f"{path}, line {rows.line_num}: {', '.join(wanted)} must be numbers; mend that row"
                                   ) from None  # fmt: skip
    except (UnicodeDecodeError, csv.Error):
        raise LogError(f"{path} is no text file; a joint log is a CSV with the columns time and q") from None
    values = np.array(table, dtype=float).reshape(-1, len(wanted))
    column = {c: values[:, i] for i, c in enumerate(wanted)}
    force = point = None
    if partial:
        force = np.stack([column[c] for c in FORCE_COLUMNS[:3]], axis=1)
        point = np.stack([column[c] for c in FORCE_COLUMNS[3:]], axis=1)
    markers = np.stack([column[c] for c in marks], axis=1).reshape(len(values), -1, 3) if marks else None
    return JointLog(str(path), column["time"], column["q"], column.get("torque"), force, point, markers)


def marker_columns(path: Path, names: Sequence[str]) -> list[str]:
    """The columns ``marker<NAME>_x``, ``_y``, ``_z`` of points fixed to the moving part, point by point.

    Raises:
        LogError: a point has not all three.
    """
    points = dict.fromkeys(n[:-2] for n in names if n.startswith("marker") and n[-2:] in ("_x", "_y", "_z"))
    columns = [f"{p}_{c}" for p in points for c in "xyz"]
    missing = [c for c in columns if c not in names]
    if missing:
        raise LogError(f"{path} has no column {missing[0]}; a point on the part needs _x, _y and _z (world frame, m)")
    return columns


def check_units(log: JointLog, hinge: bool, model_range: tuple[float, float] | None) -> None:
    """Refuse positions that cannot be radians (or metres).

    Raises:
        LogError: the span is that of degrees (or millimetres).
    """
    span = float(np.ptp(log.q))
    if span == 0.0:
        raise LogError(f"{log.name}: q never changes; check the sensor")
    wide = 4 * np.pi if hinge else 5.0
    if model_range is not None:
        wide = min(wide, 5.0 * (model_range[1] - model_range[0]))
    if span > wide:
        unit, other, factor = ("rad", "degrees", "pi/180") if hinge else ("m", "millimetres", "1/1000")
        raise LogError(f"{log.name}: q spans {span:.3g} {unit}, which looks like {other}; multiply q by {factor}")


def drop_stale(log: JointLog) -> tuple[JointLog, int]:
    """Leave out rows whose position is that of the row before although the part moves on.

    A reader that is asked faster than its sensor answers, or that missed an answer, repeats itself to the last digit.
    Where positions are rounded coarsely, equal neighbours are ordinary: nothing is left out if readings of one in
    five moving rows repeat anyway or if the position takes few values.

    Returns:
        the log and how many rows were left out.
    """
    from diagnose.simulate import smooth

    same = np.concatenate([[False], np.diff(log.q) == 0])
    values = np.unique(log.q)
    if not same.any() or len(values) < 0.5 * len(log.q):
        return log, 0
    grain = float(np.median(np.diff(values)[np.diff(values) > 0]))
    speed = np.abs(smooth(log.time, log.q)[1])
    moving = speed * np.concatenate([[log.dt], np.diff(log.time)]) > 4 * grain
    stale = same & moving
    if stale.sum() > 0.2 * max(moving.sum(), 1):
        return log, 0
    # At rest a repeat is as stale, but cannot be told from an unmoving reading that has no noise.
    if stale.any():
        stale |= same & (np.diff(np.concatenate([log.q[:1], log.q])) == 0) & (len(values) > 0.8 * len(log.q))
    keep = ~stale
    return replace(log, **{k: getattr(log, k)[keep] for k in ("time", "q", "torque", "force", "point", "markers")
                           if getattr(log, k) is not None}), int(stale.sum())  # fmt: skip
