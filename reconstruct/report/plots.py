"""The report's figure: the joint's state over time, as SVG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from reconstruct.joint.models import JointFit

if TYPE_CHECKING:
    from taa_envs.replay import ReplayResult

BOX = (0.075, 0.17, 0.905, 0.72)
"""The axes' left, bottom, width and height as shares of the figure; the page places its time cursor by them."""


def state_plot(time: np.ndarray, fit: JointFit, contact: np.ndarray | None, result: ReplayResult | None) -> str:
    """q over time: fitted with its standard deviation, replayed, and when the hand drives.

    Args:
        time: (T,) s.  fit: with q (T,).
        contact: (T,) bool, frames in which the reference's hand drives the part.
        result: the replay, if there is one.

    Returns:
        An ``<svg>`` element without fixed colours for text, so that it follows the page's theme.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    slide = fit.type == "prismatic"
    factor = (1000.0 if fit.metric else 1.0) if slide else float(np.degrees(1.0))
    unit = ("mm" if fit.metric else "units") if slide else "degrees"
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "taa", "font.family": "sans-serif", "font.size": 10}):
        figure = Figure(figsize=(9.0, 3.3))
        axes = figure.add_axes(BOX)
        figure.patch.set_alpha(0)
        axes.patch.set_alpha(0)
        q = factor * np.asarray(fit.q, float)
        if contact is not None and contact.any():
            edges = np.flatnonzero(np.diff(np.r_[0, contact.astype(int), 0]))
            for k, (a, b) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
                axes.axvspan(time[a], time[min(b, len(time) - 1)], color="#ffaa33", alpha=0.18, lw=0,
                             label="hand drives (video)" if k == 0 else None)  # fmt: skip
        std = fit.std.get("q") if fit.std else None
        if std is not None and np.size(std) in (1, len(q)):
            half = 2 * factor * np.nan_to_num(np.broadcast_to(np.asarray(std, float), q.shape))
            axes.fill_between(time, q - half, q + half, color="#17bebb", alpha=0.22, lw=0, label="± 2 std")
        axes.plot(time, q, color="#17bebb", lw=2.2, label="video")
        if result is not None:
            run = result.trajectory
            axes.plot(run.time, factor * run.q, color="#ff3b48", lw=1.6, ls=(0, (5, 2)), label="replay")
        axes.set_xlabel("time, s")
        axes.set_ylabel(unit)
        axes.set_xlim(float(time[0]), float(time[-1]))
        axes.grid(color="#8a93a6", alpha=0.25, lw=0.6)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False, fontsize=9)
        for text in [axes.xaxis.label, axes.yaxis.label, *axes.get_xticklabels(), *axes.get_yticklabels(),
                     *axes.get_legend().get_texts()]:  # fmt: skip
            text.set_color("#6f7889")
        for spine in axes.spines.values():
            spine.set_color("#8a93a6")
        axes.tick_params(colors="#6f7889")
        text = io.StringIO()
        FigureCanvasSVG(figure).print_svg(text, metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
