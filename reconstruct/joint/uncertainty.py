"""Standard deviations of axis, pivot and states from the robust fit's curvature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.joint.bundle import (
    Observations,
    State,
    normal_equations,
    refine,
    reprojection,
    robust_cost,
    transport,
)

TEMPORAL_CORRELATION = 10.0
"""Frames over which a track's error stays the same (drift): that many observations count as one."""


def joint_std(s: State, obs: Observations, focal_std: float, scale: float = 2.0) -> dict:
    """Spread of the estimate: curvature of the robust cost plus what a wrong focal length would do.

    Returns:
        {"axis_deg", "point" (distance across the axis, in the state's units), "q": (T,)}.
    """
    X, D = transport(s, obs)
    r = reprojection(X, obs)
    _, w = robust_cost(r, obs, scale)
    H, _, Hll, Hgl, _ = normal_equations(s, obs, X, D, r, w)
    S = H - (Hgl / (Hll + 1e-12)) @ Hgl.T
    K = len(s.q)
    G = len(S) - K
    noise2 = float(np.sum(w * np.sum(r**2, axis=-1)) / (2 * w.sum() + 1e-12)) * TEMPORAL_CORRELATION
    # q[0] is the gauge; the smoothness prior keeps states that nothing observes finite.
    S[G, G] += 1e6 * np.trace(S) / len(S)
    if not (w > 0).any():
        return {"axis_deg": 90.0, "point": 1.0, "q": np.full(K, np.ptp(s.q))}
    damped = S + 1e-9 * np.trace(S) / len(S) * np.eye(len(S))
    cov = np.linalg.pinv(damped, hermitian=True) * noise2 * np.median(w[w > 0])
    axis_var = float(np.trace(cov[:2, :2]))
    point_var = float(cov[2, 2]) if G > 2 else 0.0
    q_var = np.clip(np.diag(cov)[G:], 0, np.ptp(s.q) ** 2)
    if focal_std > 0:
        axes, points, ranges = [], [], []
        for f in (1 - focal_std, 1 + focal_std):
            other = replace(obs, xy=obs.xy / f, px=obs.px / f)
            o = refine(s, other, scales=(scale,), iterations=4)
            axes.append(o.axis)
            points.append(o.point)
            ranges.append(np.ptp(o.q))
        axis_var += float(np.mean([2 * (1 - min(1.0, abs(a @ s.axis))) for a in axes]))
        if s.kind != "prismatic":
            point_var += float(np.mean([np.sum((p - s.point) ** 2) for p in points]))
        share = np.mean([(g / max(np.ptp(s.q), 1e-9) - 1) ** 2 for g in ranges])
        q_var = q_var + share * (s.q - s.q[0]) ** 2
    return {"axis_deg": float(np.degrees(np.sqrt(axis_var))), "point": float(np.sqrt(point_var)), "q": np.sqrt(q_var)}
