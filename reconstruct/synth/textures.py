"""Seeded picture makers: wood, paint, cloth, stickers. Every one returns (h, w, 3) uint8 RGB."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Painter = Callable[[int, int, float, np.random.Generator], np.ndarray]
"""(height px, width px, px per metre, generator) -> (height, width, 3) uint8 RGB."""


def _smooth(h: int, w: int, cell_y: float, cell_x: float, rng: np.random.Generator) -> np.ndarray:
    """(h, w) noise in about [-1, 1] with features of the given size, px."""
    import cv2

    small = rng.uniform(-1, 1, (max(2, round(h / cell_y) + 2), max(2, round(w / cell_x) + 2))).astype(np.float32)
    return cv2.resize(small, (w, h), interpolation=cv2.INTER_CUBIC)


def _to_bytes(image: np.ndarray) -> np.ndarray:
    return (np.clip(image, 0, 1) * 255).round().astype(np.uint8)


def paint(colour: tuple[float, float, float], grain: float = 0.012) -> Painter:
    """Nearly even paint: few gradients to track, as on kitchen fronts."""

    def draw(h: int, w: int, density: float, rng: np.random.Generator) -> np.ndarray:
        soft = 0.5 * _smooth(h, w, 0.12 * density, 0.12 * density, rng) + 0.3 * _smooth(
            h, w, 0.01 * density, 0.01 * density, rng
        )
        fine = rng.normal(0, 1, (h, w)).astype(np.float32)
        return _to_bytes(np.array(colour, np.float32) * (1 + grain * (soft + 0.5 * fine))[..., None])

    return draw


def wood(colour: tuple[float, float, float], contrast: float = 0.16, upright: bool = False) -> Painter:
    """Grain along the picture's rows (columns if upright), rings, pores and a few knots."""

    def draw(h: int, w: int, density: float, rng: np.random.Generator) -> np.ndarray:
        hh, ww = (w, h) if upright else (h, w)
        bend = _smooth(hh, ww, 0.08 * density, 0.30 * density, rng)
        y = np.arange(hh, dtype=np.float32)[:, None] / density
        x = np.arange(ww, dtype=np.float32)[None] / density
        for _ in range(1 + int(hh * ww / density**2 / 0.05)):
            ky, kx, r = rng.uniform(0, hh / density), rng.uniform(0, ww / density), rng.uniform(0.008, 0.018)
            bend = bend + 1.3 * np.exp(-(((y - ky) / r) ** 2 + ((x - kx) / (3 * r)) ** 2))
        rings = np.sin(2 * np.pi * (y / 0.022 + 1.1 * bend))
        streak = _smooth(hh, ww, 0.0022 * density, 0.07 * density, rng)
        pores = _smooth(hh, ww, max(1.0, 0.0011 * density), 0.012 * density, rng)
        shade = 1 + contrast * (0.45 * rings + 0.55 * streak - 0.55 * np.clip(pores - 0.45, 0, 1) * 2)
        image = np.array(colour, np.float32) ** (1 / np.clip(shade, 0.4, 1.6))[..., None]
        return _to_bytes(image.transpose(1, 0, 2) if upright else image)

    return draw


def plaster(colour: tuple[float, float, float]) -> Painter:
    """A wall: faint blotches and specks."""

    def draw(h: int, w: int, density: float, rng: np.random.Generator) -> np.ndarray:
        blotch = _smooth(h, w, 0.15 * density, 0.15 * density, rng) + 0.7 * _smooth(
            h, w, 0.02 * density, 0.02 * density, rng
        )
        return _to_bytes(np.array(colour, np.float32) * (1 + 0.025 * blotch)[..., None])

    return draw


def tiles(colour: tuple[float, float, float], pitch: float = 0.11) -> Painter:
    """Glazed wall tiles with grout."""

    def draw(h: int, w: int, density: float, rng: np.random.Generator) -> np.ndarray:
        p = pitch * density
        y, x = np.arange(h)[:, None], np.arange(w)[None]
        tone = rng.uniform(-1, 1, (int(h / p) + 2, int(w / p) + 2))[(y // p).astype(int), (x // p).astype(int)]
        edge = np.minimum(np.minimum(y % p, p - y % p), np.minimum(x % p, p - x % p)) / density
        glaze = 1 + 0.05 * tone + 0.02 * _smooth(h, w, 0.03 * density, 0.03 * density, rng)
        image = np.array(colour, np.float32) * glaze[..., None]
        image = np.where((edge < 0.002)[..., None], np.array([0.55, 0.53, 0.50], np.float32), image)
        return _to_bytes(image)

    return draw


def checked_cloth(a: tuple[float, float, float], b: tuple[float, float, float], pitch: float = 0.035) -> Painter:
    """A woven check."""

    def draw(h: int, w: int, density: float, rng: np.random.Generator) -> np.ndarray:
        p = pitch * density
        y, x = np.arange(h)[:, None] / p, np.arange(w)[None] / p
        mix = 0.5 * ((y % 2) < 1) + 0.5 * ((x % 2) < 1)
        weave = 1 + 0.05 * rng.normal(0, 1, (h, w)) + 0.05 * _smooth(h, w, 0.05 * density, 0.05 * density, rng)
        image = np.array(a, np.float32) + mix[..., None] * (np.array(b, np.float32) - np.array(a, np.float32))
        return _to_bytes(image * weave[..., None])

    return draw


def _sticker(w: int, h: int, rng: np.random.Generator) -> np.ndarray:
    """One printed label: frame, heading, lines of text, a figure of simple shapes."""
    import cv2

    paper = rng.choice([[244, 240, 228], [230, 196, 92], [196, 216, 226], [206, 86, 70], [92, 150, 112]])
    image = np.full((h, w, 3), paper, np.uint8)
    ink = (28, 30, 40) if sum(paper) > 400 else (246, 244, 236)
    cv2.rectangle(image, (2, 2), (w - 3, h - 3), ink, max(1, h // 50))
    words = ["FRAGILE", "KITCHEN", "No. 37", "TEA", "SPICE", "LOT 2208", "OPEN", "CARE", "MADE 1998", "BOX"]
    size = h / 115
    thick = max(1, round(size * 2))
    cv2.putText(
        image,
        str(rng.choice(words)),
        (w // 12, round(h * 0.30)),
        cv2.FONT_HERSHEY_DUPLEX,
        size,
        ink,
        thick,
        cv2.LINE_AA,
    )
    for k in range(3):
        y = round(h * (0.44 + 0.09 * k))
        text = "".join(rng.choice(list("abcdefghiklmnoprstuw  "), 26))
        cv2.putText(image, text, (w // 12, y), cv2.FONT_HERSHEY_PLAIN, size * 0.75, ink, 1, cv2.LINE_AA)
    for _ in range(4):
        centre = (int(rng.uniform(0.1, 0.9) * w), int(rng.uniform(0.76, 0.9) * h))
        colour = tuple(int(c) for c in rng.integers(30, 230, 3))
        if rng.random() < 0.5:
            cv2.circle(image, centre, int(h * rng.uniform(0.04, 0.09)), colour, -1, cv2.LINE_AA)
        else:
            r = int(h * rng.uniform(0.04, 0.08))
            cv2.rectangle(image, (centre[0] - r, centre[1] - r), (centre[0] + r, centre[1] + r), colour, -1)
    return image


def with_stickers(base: Painter, count: int, size: float = 0.07) -> Painter:
    """Labels of about the given size, m, scattered over another picture, each a little turned."""

    def draw(h: int, w: int, density: float, rng: np.random.Generator) -> np.ndarray:
        import cv2

        image = base(h, w, density, rng)
        # One label a cell of a grid: scattered, yet not on top of each other.
        across = max(1, round(np.sqrt(count * w / h)))
        down = max(1, -(-count // across))
        cells = rng.permutation(across * down)[:count]
        for cell in cells:
            sw = max(24, int(size * density * rng.uniform(0.8, 1.25)))
            sh = int(sw * rng.uniform(0.6, 0.85))
            if sw > 0.95 * w or sh > 0.95 * h:
                continue
            label = _sticker(sw, sh, rng)
            cx = (cell % across + rng.uniform(0.35, 0.65)) / across * w
            cy = (cell // across + rng.uniform(0.35, 0.65)) / down * h
            turn = cv2.getRotationMatrix2D((sw / 2, sh / 2), float(rng.uniform(-14, 14)), 1.0)
            turn[:, 2] += (cx - sw / 2, cy - sh / 2)
            put = cv2.warpAffine(label, turn, (w, h), flags=cv2.INTER_AREA)
            mask = cv2.warpAffine(np.full((sh, sw), 255, np.uint8), turn, (w, h)).astype(np.float32)[..., None] / 255
            image = (image * (1 - mask) + put * mask).astype(np.uint8)
        return image

    return draw
