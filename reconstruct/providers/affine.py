"""Affine registration of a point's neighbourhood against a frame in which it was well seen.

A corner's picture shears and shrinks as its surface turns. A shift alone then settles where the sheared corner looks
most like the old one, and slides off by pixels over a swing of 20 degrees; six numbers follow it. Inverse compositional
Lucas-Kanade (Baker and Matthews, IJCV 2004), with gain and offset of the brightness
projected out and robust weights.
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
from numba import njit

HALF = 9
"""Half the window's side, px of the anchor frame."""
SPREAD = 5.0
"""Standard deviation of the window's weight, px."""
ITERATIONS = 12
DONE_PX = 0.01
STIFF = (3.0 / 0.3) ** 2
"""What holds the shear: grey values' noise over how far one step may go where the neighbourhood says nothing."""
REWEIGHTED = (0, 3)
"""Iterations at which it is asked which pixels of the window belong together."""
GREY, SHARE = 8.0, 0.35
"""Grey values by which pixels that do may differ at least; how much of the window, weighted, has to."""
LARGEST_STEP_PX, LARGEST_SHEAR = 2.0, 0.3
SAMPLED = 4 / 9
"""Variance that bilinear sampling leaves of a pixel's noise, in the mean over places between pixels."""
LEAST_RELIABLE = 0.3
"""Share of a window's variance that is taken for more than noise, at least."""


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _sample(image: np.ndarray, x: float, y: float) -> float:
    """Bilinear; (x, y) lies inside."""
    i, j = int(y), int(x)
    a, b = y - i, x - j
    top = (1 - b) * image[i, j] + b * image[i, j + 1]
    bottom = (1 - b) * image[i + 1, j] + b * image[i + 1, j + 1]
    return (1 - a) * top + a * bottom


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _residuals(wide: np.ndarray, target: np.ndarray, weight: np.ndarray, p: np.ndarray, S: np.ndarray,
               out: np.ndarray) -> None:  # fmt: skip
    """Absolute differences of grey values after gain and offset."""
    side = len(weight)
    half = side // 2
    total, mean, level, along, power = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(side):
        for b in range(side):
            x, y = b - half, a - half
            out[a, b] = _sample(target, p[0] + S[0, 0] * x + S[0, 1] * y, p[1] + S[1, 0] * x + S[1, 1] * y)
            w, g = weight[a, b], wide[a + 1, b + 1]
            total += w
            mean += w * g
            level += w * out[a, b]
            along += w * g * out[a, b]
            power += w * g * g
    mean, level = mean / total, level / total
    gain = max((along / total - mean * level) / max(power / total - mean * mean, 1e-9), 0.2)
    for a in range(side):
        for b in range(side):
            out[a, b] = abs((out[a, b] - level) / gain - (wide[a + 1, b + 1] - mean))


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def register(frames: np.ndarray, anchor: np.ndarray, at: np.ndarray, now: int, place: np.ndarray, shape: np.ndarray,
             noise: float = 0.0, half: int = HALF) -> np.ndarray:  # fmt: skip
    """Register neighbourhoods of anchor frames in another frame, in place.

    Args:
        frames: (T, h, w) uint8.  anchor: (N,) frame of each neighbourhood.  at: (N, 2) its middle there, px.
        now: the frame to register in.
        place: (N, 2) px, starts; becomes where the middles are.
        shape: (N, 2, 2) starts; becomes the derivative of the place in `now` by that in the anchor frame.
        noise: standard deviation of the frames' pixels, grey values.
        half: half the window's side, px; the spread of its weight goes with it.

    Returns:
        (N,) normalised correlation of what belongs together in the neighbourhoods, as it would be without the noise
        (Spearman's correction for attenuation, 1904; a faint texture's is taken for half noise at most), in [-1, 1]; -2
        where one leaves the picture, has no structure, or less than SHARE of it belongs together.
    """
    n, side = len(at), 2 * half + 1
    height, width = frames.shape[1], frames.shape[2]
    out = np.full(n, -2.0)
    wide = np.empty((side + 2, side + 2))
    bell = np.empty((side, side))
    spread = SPREAD * half / HALF
    for a in range(side):
        for b in range(side):
            bell[a, b] = exp(-((a - half) ** 2 + (b - half) ** 2) / (2 * spread**2))
    bell /= bell.sum()
    weight, gap = np.empty((side, side)), np.empty((side, side))
    steep = np.empty((side, side, 6))
    target = frames[now]
    row, push, step = np.empty(6), np.empty(6), np.empty(6)
    level_of, along_of = np.empty(6), np.empty(6)
    for k in range(n):
        x0, y0 = at[k, 0], at[k, 1]
        if x0 < half + 1 or y0 < half + 1 or x0 >= width - half - 2 or y0 >= height - half - 2:
            continue
        template = frames[anchor[k]]
        mean, power = 0.0, 0.0
        for a in range(side + 2):
            for b in range(side + 2):
                wide[a, b] = _sample(template, x0 + b - half - 1, y0 + a - half - 1)
        for a in range(side):
            for b in range(side):
                gx = 0.5 * (wide[a + 1, b + 2] - wide[a + 1, b])
                gy = 0.5 * (wide[a + 2, b + 1] - wide[a, b + 1])
                x, y = b - half, a - half
                steep[a, b, 0], steep[a, b, 1] = gx * x, gx * y
                steep[a, b, 2], steep[a, b, 3] = gy * x, gy * y
                steep[a, b, 4], steep[a, b, 5] = gx, gy
        p, S = place[k].copy(), shape[k].copy()
        correlation, share = -2.0, 1.0
        inverse = np.zeros((6, 6))
        for turn in range(ITERATIONS + 1):
            # The window's corners bound it.
            reach_x, reach_y = half * (abs(S[0, 0]) + abs(S[0, 1])), half * (abs(S[1, 0]) + abs(S[1, 1]))
            if p[0] - reach_x < 0 or p[1] - reach_y < 0 or p[0] + reach_x >= width - 1 or p[1] + reach_y >= height - 1:
                correlation = -2.0
                break
            if turn in REWEIGHTED:
                # Beside a thin part or an edge, much of the window is what lies behind and goes its own way.
                _residuals(wide, target, bell if turn == 0 else weight, p, S, gap)
                scale = max(GREY, 3.0 * np.median(gap))
                total, mean, power = 0.0, 0.0, 0.0
                for a in range(side):
                    for b in range(side):
                        w = bell[a, b] / (1 + (gap[a, b] / scale) ** 2) ** 2
                        weight[a, b] = w
                        total += w
                        mean += w * wide[a + 1, b + 1]
                        power += w * wide[a + 1, b + 1] ** 2
                share = total
                weight /= total
                mean, power = mean / total, power / total
                power -= mean * mean
                if power < 1.0:
                    correlation = -2.0
                    break
                # What gain and offset explain is taken out of the derivatives.
                H = np.zeros((6, 6))
                level_of[:], along_of[:] = 0.0, 0.0
                for a in range(side):
                    for b in range(side):
                        w, g = weight[a, b], wide[a + 1, b + 1] - mean
                        for c in range(6):
                            row[c] = w * steep[a, b, c]
                            level_of[c] += row[c]
                            along_of[c] += row[c] * g
                        for c in range(6):
                            for d in range(c, 6):
                                H[c, d] += row[c] * steep[a, b, d]
                for c in range(6):
                    for d in range(c, 6):
                        H[c, d] -= level_of[c] * level_of[d] + along_of[c] * along_of[d] / power
                        H[d, c] = H[c, d]
                # A window of so many observations; the prior counts as one.
                small = 1e-6 * (H[4, 4] + H[5, 5]) + 1e-9
                for c in range(6):
                    H[c, c] += STIFF / (2 * np.pi * spread**2 * share) if c < 4 else small
                inverse = np.linalg.inv(H)
            push[:] = 0.0
            level, along, square = 0.0, 0.0, 0.0
            for a in range(side):
                for b in range(side):
                    x, y = b - half, a - half
                    value = _sample(target, p[0] + S[0, 0] * x + S[0, 1] * y, p[1] + S[1, 0] * x + S[1, 1] * y)
                    w = weight[a, b] * value
                    level += w
                    square += w * value
                    along += w * (wide[a + 1, b + 1] - mean)
                    for c in range(6):
                        push[c] += w * steep[a, b, c]
            correlation = along / sqrt(max(square - level * level, 1e-9) * power)
            if turn == ITERATIONS or correlation < 0.2:
                break
            for c in range(6):
                push[c] -= level_of[c] * level + along_of[c] * along / power
            gain = max(along / power, 0.2)
            for c in range(6):
                step[c] = 0.0
                for d in range(6):
                    step[c] += inverse[c, d] * push[d] / gain
            move = sqrt(step[4] ** 2 + step[5] ** 2)
            shear = sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2 + step[3] ** 2)
            step *= min(1.0, LARGEST_STEP_PX / max(move, 1e-9), LARGEST_SHEAR / max(shear, 1e-9))
            # What was there before, after the inverse of the step.
            a00, a01, a10, a11 = 1 + step[0], step[1], step[2], 1 + step[3]
            det = a00 * a11 - a01 * a10
            s00, s01 = (S[0, 0] * a11 - S[0, 1] * a10) / det, (S[0, 1] * a00 - S[0, 0] * a01) / det
            s10, s11 = (S[1, 0] * a11 - S[1, 1] * a10) / det, (S[1, 1] * a00 - S[1, 0] * a01) / det
            S[0, 0], S[0, 1], S[1, 0], S[1, 1] = s00, s01, s10, s11
            p[0] -= s00 * step[4] + s01 * step[5]
            p[1] -= s10 * step[4] + s11 * step[5]
            if move < DONE_PX and shear * half < 2 * DONE_PX and turn > REWEIGHTED[-1]:
                break
        if correlation > -2.0 and share > SHARE:
            reliable = max(1.0 - SAMPLED * noise * noise / power, LEAST_RELIABLE)
            out[k] = min(correlation / reliable, 1.0)
            place[k], shape[k] = p, S
    return out
