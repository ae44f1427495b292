"""The compiled sums of the regression: integrals over time, and windows freed of their own lines."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def once(x, t):
    """Integral of x (N,) over t (N,), trapezoids."""
    out = np.empty(len(x))
    out[0] = 0.0
    for i in range(1, len(x)):
        out[i] = out[i - 1] + 0.5 * (x[i] + x[i - 1]) * (t[i] - t[i - 1])
    return out


@njit(cache=True)
def twice(x, t):
    """Double integral of x (N,) over t (N,)."""
    return once(once(x, t), t)


@njit(cache=True)
def freed(x, rest, starts, widths, basis):
    """x (N, K) without what each window's basis explains; 0 where the (N,) mask ``rest`` says so.

    starts: (W + 1,) first entry of each window in the list of rows with a window, ``widths[w]`` columns of
    ``basis`` (rows, most) belong to window w; the list is the rows off ``rest``, in order.
    """
    n, columns = x.shape
    out = np.zeros((n, columns))
    rows = np.flatnonzero(~rest)
    for c in range(columns):
        for w in range(len(widths)):
            a, b = starts[w], starts[w + 1]
            for i in range(a, b):
                out[rows[i], c] = x[rows[i], c]
            for k in range(widths[w]):
                dot = 0.0
                for i in range(a, b):
                    dot += basis[i, k] * x[rows[i], c]
                for i in range(a, b):
                    out[rows[i], c] -= basis[i, k] * dot
    return out
