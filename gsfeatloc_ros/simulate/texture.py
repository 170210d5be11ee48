"""Pictures for the surfaces of the simulated room: rich at every scale, and nowhere twice the same."""

from __future__ import annotations

import cv2
import numpy as np

# Noise by the size of its cells in metres, with the standard deviation of its brightness.
_OCTAVES = ((1.0, 0.06), (0.5, 0.06), (0.25, 0.06), (0.12, 0.05), (0.06, 0.04))
# Shapes by their smallest and largest size in metres, with their number per square metre. Large ones are painted first.
_SHAPES = ((0.4, 1.0, 1.5), (0.15, 0.4, 8.0), (0.07, 0.15, 30.0), (0.04, 0.07, 40.0))


def paint(rng: np.random.Generator, rows: int, cols: int, texel: float) -> np.ndarray:
    """Paint a random picture (rows, cols, 3) uint8 whose pixels are `texel` metres wide."""
    canvas = np.empty((rows, cols, 3), np.uint8)
    canvas[:] = rng.uniform(120, 210, 3)
    palette = _palette(rng, 12)
    area = rows * cols * texel**2
    for smallest, largest, density in _SHAPES:
        for _ in range(rng.poisson(density * area)):
            size = rng.uniform(smallest, largest) / texel
            _draw_shape(rng, canvas, rng.uniform((0, 0), (cols, rows)), size, rng.choice(palette))
    picture = canvas.astype(np.float32)
    for cell, amplitude in _OCTAVES:
        grid = (int(np.ceil(rows * texel / cell)) + 1, int(np.ceil(cols * texel / cell)) + 1)
        brightness, colour = rng.normal(size=(*grid, 1)), rng.normal(size=(*grid, 3))
        noise = (255 * amplitude * (brightness + 0.5 * colour)).astype(np.float32)
        picture += cv2.resize(noise, (cols, rows), interpolation=cv2.INTER_CUBIC)
    return np.clip(picture, 0, 255).astype(np.uint8)


def _palette(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return colours (count, 3) from dark to light, none glaring."""
    brightness = rng.permutation(np.linspace(20, 235, count))[:, None]
    return np.clip(brightness + rng.normal(0, 30, (count, 3)), 0, 255)


def _draw_shape(
    rng: np.random.Generator, canvas: np.ndarray, centre: np.ndarray, size: float, colour: np.ndarray
) -> None:
    """Draw one shape about `size` pixels wide: an ellipse, a ring, a polygon, a rectangle or a stroke."""
    ink = colour.tolist()
    middle, angle = tuple(np.rint(centre).astype(int).tolist()), rng.uniform(0, 360)
    match rng.integers(5):
        case 0:
            axes = (int(size / 2), int(size / 2 * rng.uniform(0.4, 1.0)))
            cv2.ellipse(canvas, middle, axes, angle, 0, 360, ink, cv2.FILLED, cv2.LINE_AA)
        case 1:
            cv2.circle(canvas, middle, int(size / 2), ink, max(2, int(size * 0.15)), cv2.LINE_AA)
        case 2:
            angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
            polygon = centre + size / 2 * np.column_stack([np.cos(angles), np.sin(angles)])
            cv2.fillPoly(canvas, [np.rint(polygon).astype(np.int32)], ink, cv2.LINE_AA)
        case 3:
            corners = cv2.boxPoints((centre.tolist(), (size, size * rng.uniform(0.3, 0.9)), angle))
            cv2.fillPoly(canvas, [np.rint(corners).astype(np.int32)], ink, cv2.LINE_AA)
        case _:
            step = size / 2 * np.array([np.cos(angle), np.sin(angle)])
            start, end = (np.rint(point).astype(int).tolist() for point in (centre - step, centre + step))
            cv2.line(canvas, start, end, ink, max(2, int(size * 0.12)), cv2.LINE_AA)
