"""The focal length, estimated with the joint where neither the file nor the user gives it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.joint.bundle import Observations, State, refine

DEFAULT_FOCAL = 0.8
"""Prior mean over the image's long side: phones and webcams lie between 0.65 and 0.95."""
PRIOR_STD = 0.12
"""Prior standard deviation of its logarithm."""
FACTORS = np.exp(np.linspace(-2.0, 2.0, 7) * PRIOR_STD)


def estimate_focal(s: State, link: Observations) -> tuple[float, float]:
    """Posterior of the focal length: the joint refitted to the link's tracks at several lengths.

    A single joint seen in perspective holds the focal length weakly (a shorter one with a smaller angle draws
    nearly the same paths), so that the prior matters; tracks count once each, as in the choice of the type.

    Args:
        s: fitted joint whose depths belong to `link`.
        link: observations of the link's tracks, normalised with the assumed focal length.

    Returns:
        Factor on the assumed focal length, and the standard deviation of its logarithm.
    """
    weight = float(link.weight.sum())
    per = float((link.weight[:, None] * link.seen).sum())
    log = np.zeros(len(FACTORS))
    for i, k in enumerate(FACTORS):
        other = replace(link, xy=link.xy / k, px=link.px / k)
        cost = refine(s, other, scales=(4.0, 2.0), iterations=20).cost / per
        log[i] = -weight * np.log(max(cost, 1e-6)) - 0.5 * (np.log(k) / PRIOR_STD) ** 2
    p = np.exp(log - log.max())
    p /= p.sum()
    mean = float(p @ np.log(FACTORS))
    return float(np.exp(mean)), float(np.sqrt(p @ (np.log(FACTORS) - mean) ** 2 + (0.25 * PRIOR_STD) ** 2))
