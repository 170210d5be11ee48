"""Writers of map files, one Gaussian after another, independent of the readers in gsfeatloc_ros/maps.

And what damaged files must come to, of whatever format.
"""

from __future__ import annotations

import gzip
import json
import math
import struct
import tracemalloc
import zipfile
from pathlib import Path

import cv2
import numpy as np
from backports import zstd

from gsfeatloc_ros.maps import GaussianMap, MapError, load_map

ARRAYS = ("means", "scales", "rotations", "opacities", "sh")
SH_C0 = 0.28209479177387814
# Signs of the harmonics 0 to 15 turned by half a turn about x: minus for an odd power of y and z together.
FLIPPED = [0, 1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 1, 0] + 9 * [0]  # those of degree 4 are not read


def sample_map(count: int, sh_degree: int, seed: int) -> GaussianMap:
    """Gaussians within what all formats can hold: log scales in [-9, 1], opacities of at least 2/255."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    sh = rng.uniform(-0.9, 0.9, (count, (sh_degree + 1) ** 2, 3))
    return GaussianMap(
        means=rng.uniform(-20, 20, (count, 3)).astype(np.float32),
        scales=np.exp(rng.uniform(-9, 1, (count, 3))).astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(2 / 255, 1, count).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def _unorm(fraction: float, bits: int) -> int:
    highest = (1 << bits) - 1
    return min(max(math.floor(fraction * highest + 0.5), 0), highest)


def _largest_and_others(quaternion: list[float]) -> tuple[int, list[float]]:
    """Index of the largest component and the other three, of the sign with which the largest is positive."""
    largest = max(range(4), key=lambda k: abs(quaternion[k]))
    sign = -1.0 if quaternion[largest] < 0 else 1.0
    return largest, [sign * quaternion[k] for k in range(4) if k != largest]


def write_compressed_ply(path: Path, m: GaussianMap, color_bounds: bool = True, comment: str = "") -> Path:
    """PlayCanvas compressed .ply."""
    names = [f"{b}_{a}" for b in ("min", "max") for a in "xyz"]
    names += [f"{b}_scale_{a}" for b in ("min", "max") for a in "xyz"]
    if color_bounds:
        names += [f"{b}_{c}" for b in ("min", "max") for c in "rgb"]
    colors = m.sh[:, 0] * SH_C0 + 0.5
    chunks, vertices, harmonics = b"", b"", b""
    for start in range(0, len(m), 256):
        members = range(start, min(start + 256, len(m)))
        part = slice(start, start + 256)
        bounds = [(m.means[part].min(0), m.means[part].max(0))]
        bounds += [(np.log(m.scales[part]).min(0), np.log(m.scales[part]).max(0))]
        bounds += [(colors[part].min(0), colors[part].max(0))] if color_bounds else [(np.zeros(3), np.ones(3))]
        for low, high in bounds[: 3 if color_bounds else 2]:
            chunks += struct.pack("<6f", *low, *high)

        def fractions(values, bound):
            return [(v - a) / (b - a) if b > a else 0.0 for v, a, b in zip(values, *bound, strict=True)]

        for i in members:
            x, y, z = fractions(m.means[i], bounds[0])
            u, v, w = fractions(np.log(m.scales[i]), bounds[1])
            r, g, b = fractions(colors[i], bounds[2])
            largest, others = _largest_and_others(m.rotations[i].tolist())
            rotation = largest
            for value in others:
                rotation = rotation << 10 | _unorm(value * math.sqrt(0.5) + 0.5, 10)
            vertices += struct.pack(
                "<4I",
                _unorm(x, 11) << 21 | _unorm(y, 10) << 11 | _unorm(z, 11),
                rotation,
                _unorm(u, 11) << 21 | _unorm(v, 10) << 11 | _unorm(w, 11),
                _unorm(r, 8) << 24 | _unorm(g, 8) << 16 | _unorm(b, 8) << 8 | _unorm(float(m.opacities[i]), 8),
            )
            for channel in range(3):
                for k in range(1, m.sh.shape[1]):
                    harmonics += bytes([min(max(int((m.sh[i, k, channel] / 8 + 0.5) * 256), 0), 255)])
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines += [f"element chunk {-(-len(m) // 256)}", *(f"property float {name}" for name in names)]
    lines += [f"element vertex {len(m)}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if m.sh.shape[1] > 1:
        lines += [f"element sh {len(m)}", *(f"property uchar f_rest_{k}" for k in range(3 * m.sh.shape[1] - 3))]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + chunks + vertices + harmonics)
    return path


def write_splat(path: Path, m: GaussianMap) -> Path:
    """.splat; the harmonics beyond the first are lost."""
    content = b""
    for i in range(len(m)):
        rgba = [*(m.sh[i, 0] * SH_C0 + 0.5), m.opacities[i]]
        content += struct.pack("<6f", *m.means[i], *m.scales[i])
        content += bytes(min(max(round(255 * float(v)), 0), 255) for v in rgba)
        content += bytes(min(max(int(128 * float(v) + 128), 0), 255) for v in m.rotations[i])
    path.write_bytes(content)
    return path


def spz_streams(m: GaussianMap, version: int) -> list[bytes]:
    """Positions, opacities, colours, scales, rotations and harmonics of an .spz; positions with 12 fractional bits."""
    streams = [b""] * 6
    for i in range(len(m)):
        x, y, z = m.means[i].tolist()
        for value in (x, -y, -z):
            if version == 1:
                streams[0] += struct.pack("<e", value)
            else:
                streams[0] += (round(value * 4096) & 0xFFFFFF).to_bytes(3, "little")
        streams[1] += bytes([round(255 * float(m.opacities[i]))])
        streams[2] += bytes(min(max(round(255 * (0.15 * float(v) + 0.5)), 0), 255) for v in m.sh[i, 0])
        streams[3] += bytes(min(max(round(16 * (math.log(v) + 10)), 0), 255) for v in m.scales[i])
        w, x, y, z = m.rotations[i].tolist()
        xyzw = [x, -y, -z, w]
        if version < 3:
            sign = -1 if w < 0 else 1
            streams[4] += bytes(round(127.5 * sign * v + 127.5) for v in xyzw[:3])
        else:
            largest, others = _largest_and_others(xyzw)
            word = largest
            for value in others:
                word = word << 10 | (value < 0) << 9 | round(511 * abs(value) / math.sqrt(0.5))
            streams[4] += struct.pack("<I", word)
        for k in range(1, m.sh.shape[1]):
            sign = -1 if FLIPPED[k] else 1
            streams[5] += bytes(min(max(round(128 * sign * float(v)) + 128, 0), 255) for v in m.sh[i, k])
    return streams


def write_spz(path: Path, m: GaussianMap, version: int, extensions: bytes = b"", **header: int) -> Path:
    """.spz of version 1 to 4; `header` overwrites count, sh_degree, fractional_bits or flags."""
    fields = {"count": len(m), "sh_degree": math.isqrt(m.sh.shape[1]) - 1, "fractional_bits": 12, "flags": 0} | header
    head = b"NGSP" + struct.pack("<IIBBB", version, *fields.values())
    streams = spz_streams(m, version)
    if version < 4:
        path.write_bytes(gzip.compress(head + b"\0" + b"".join(streams) + extensions, mtime=0))
        return path
    packed = [(zstd.compress(stream), len(stream)) for stream in streams if stream]
    head += bytes([len(packed)]) + struct.pack("<I12x", 32 + len(extensions))
    table = b"".join(struct.pack("<QQ", len(data), size) for data, size in packed)
    path.write_bytes(head + extensions + table + b"".join(data for data, _ in packed))
    return path


def webp(pixels: np.ndarray) -> bytes:
    """Lossless WebP of RGB or RGBA pixels (H, W, C)."""
    order = [2, 1, 0, 3][: pixels.shape[2]]
    return cv2.imencode(".webp", np.ascontiguousarray(pixels[..., order]), [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()


def write_sog(folder: Path, m: GaussianMap, version: int, palette: int = 64, **extra: object) -> Path:
    """Unbundled .sog of version 1 or 2 whose Gaussian i has the harmonics of Gaussian i % palette; `extra` in meta."""
    folder.mkdir(exist_ok=True)
    width = math.ceil(math.sqrt(len(m)))
    pixels = {
        name: np.zeros((width * width, 4), np.uint8) for name in ("low", "high", "scales", "quats", "sh0", "labels")
    }
    for name in ("low", "high", "scales", "labels"):
        pixels[name][:, 3] = 255
    pixels["quats"][:, 3] = 255
    pixels["sh0"][:, 3] = 255

    logs = np.sign(m.means) * np.log1p(np.abs(m.means))
    lows, highs = logs.min(0).astype(float), logs.max(0).astype(float)
    log_scales = np.log(m.scales.astype(float))
    opacities = m.opacities.astype(float).clip(max=0.999)
    logits = np.log(opacities / (1 - opacities))
    scale_book = np.linspace(log_scales.min(), log_scales.max(), 256)
    color_book = np.linspace(-1, 1, 256)
    channel_low = np.array([*[-1.0] * 3, logits.min()]), np.array([*[1.0] * 3, logits.max()])
    for i in range(len(m)):
        for k in range(3):
            span = highs[k] - lows[k]
            word = round(65535 * (float(logs[i, k]) - lows[k]) / span) if span > 0 else 0
            pixels["low"][i, k], pixels["high"][i, k] = word & 255, word >> 8
            pixels["scales"][i, k] = np.argmin(np.abs(scale_book - log_scales[i, k]))
            pixels["sh0"][i, k] = np.argmin(np.abs(color_book - m.sh[i, 0, k]))
        if version == 2:
            pixels["sh0"][i, 3] = round(255 * float(m.opacities[i]))
        else:
            span = channel_low[1][3] - channel_low[0][3]
            pixels["sh0"][i, 3] = max(1, round(255 * (logits[i] - channel_low[0][3]) / span)) if span > 0 else 1
        largest, others = _largest_and_others(m.rotations[i].tolist())
        pixels["quats"][i] = [*(round(255 * (v / math.sqrt(0.5) + 1) / 2) for v in others), 252 + largest]
        pixels["labels"][i, :2] = i % palette & 255, i % palette >> 8

    names = {"low": "means_l.webp", "high": "means_u.webp", "scales": "scales.webp", "quats": "quats.webp"}
    names |= {"sh0": "sh0.webp", "labels": "shN_labels.webp"}
    coefficients = m.sh.shape[1] - 1
    for key, name in names.items():
        if key != "labels" or coefficients:
            (folder / name).write_bytes(webp(pixels[key].reshape(width, width, 4)))
    means = {"mins": lows.tolist(), "maxs": highs.tolist(), "files": [names["low"], names["high"]]}
    meta: dict = {"means": means, "quats": {"files": [names["quats"]]}}
    meta["scales"], meta["sh0"] = {"files": [names["scales"]]}, {"files": [names["sh0"]]}
    if version == 2:
        meta |= {"version": 2, "count": len(m)}
        meta["scales"]["codebook"], meta["sh0"]["codebook"] = scale_book.tolist(), color_book.tolist()
    else:
        means["shape"] = [len(m), 3]
        meta["scales"] |= {"mins": [scale_book[0]] * 3, "maxs": [scale_book[-1]] * 3}
        meta["sh0"] |= {"mins": channel_low[0].tolist(), "maxs": channel_low[1].tolist()}
    if coefficients:
        image = np.zeros((-(-palette // 64), 64 * coefficients, 3), np.uint8)
        for entry in range(min(palette, len(m))):
            for k in range(coefficients):
                image[entry // 64, entry % 64 * coefficients + k] = [
                    np.argmin(np.abs(color_book - value)) for value in m.sh[entry, k + 1]
                ]
        (folder / "shN_centroids.webp").write_bytes(webp(image))
        meta["shN"] = {"files": ["shN_centroids.webp", names["labels"]]}
        if version == 2:
            bands = math.isqrt(coefficients + 1) - 1
            meta["shN"] |= {"count": palette, "bands": bands, "codebook": color_book.tolist()}
        else:
            meta["shN"] |= {"mins": -1.0, "maxs": 1.0}
    (folder / "meta.json").write_text(json.dumps(meta | extra))
    return folder


def bundle(path: Path, folder: Path) -> Path:
    """Zip an unbundled .sog."""
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)
    return path


def write_streamed_sog(folder: Path, levels: list[list[GaussianMap]], environment: GaussianMap | None = None) -> Path:
    """Streamed .sog of parts at several levels of detail; all parts of a level are in one tree of depth 1."""
    filenames, children = [], []
    for level, parts in enumerate(levels):
        for index, part in enumerate(parts):
            name = f"{level}_{index}"
            write_sog_in(folder / name, part)
            filenames.append(f"{name}/meta.json")
            place = {"file": len(filenames) - 1, "offset": 0, "count": len(part)}
            children.append({"bound": {}, "lods": {str(level): place}})
    meta: dict = {"version": 1, "lodLevels": len(levels), "filenames": filenames}
    meta["counts"] = [sum(map(len, parts)) for parts in levels]
    meta["count"], meta["tree"] = sum(meta["counts"]), {"bound": {}, "children": children}
    if environment is not None:
        write_sog_in(folder / "env", environment)
        meta["environment"] = "env/meta.json"
    (folder / "lod-meta.json").write_text(json.dumps(meta))
    return folder


def write_sog_in(folder: Path, m: GaussianMap) -> None:
    """Unbundled .sog of version 2 in a folder that need not be there."""
    folder.mkdir(parents=True)
    write_sog(folder, m, 2)


def write_gsplat_png(folder: Path, m: GaussianMap) -> Path:
    """PNG images of gsplat's PngCompression, of a square number of Gaussians, each with a centroid of its own."""
    folder.mkdir()
    side, meta = math.isqrt(len(m)), {}
    opacities = m.opacities.astype(float).clip(max=0.9999)
    values = {
        "means": np.sign(m.means) * np.log1p(np.abs(m.means.astype(float))),
        "scales": np.log(m.scales.astype(float)),
        "quats": m.rotations.astype(float),
        "opacities": np.log(opacities / (1 - opacities))[:, None],
        "sh0": m.sh[:, 0].astype(float),
    }
    for name, array in values.items():
        low, high = array.min(0), array.max(0)
        numbers = np.round((array - low) / (high - low) * (65535 if name == "means" else 255)).astype(int)
        shape = list(array.shape) if name != "sh0" else [len(m), 1, 3]
        meta[name] = {"shape": shape if name != "opacities" else [len(m)], "dtype": "float32"}
        meta[name] |= {"mins": low.tolist(), "maxs": high.tolist()}
        images = {f"{name}_l": numbers & 255, f"{name}_u": numbers >> 8} if name == "means" else {name: numbers}
        for file, pixels in images.items():
            image = pixels.astype(np.uint8).reshape(side, side, -1)
            order = [2, 1, 0, 3][: image.shape[2]] if image.shape[2] > 1 else [0]
            cv2.imwrite(str(folder / f"{file}.png"), image[..., order])
    rest = m.sh[:, 1:].astype(float)
    if rest.shape[1]:
        low, high = rest.min(), rest.max()
        centroids = np.round((rest.reshape(len(m), -1) - low) / (high - low) * 63).astype(np.uint8)
        np.savez_compressed(folder / "shN.npz", centroids=centroids, labels=np.arange(len(m), dtype=np.uint16))
        meta["shN"] = {"shape": list(rest.shape), "dtype": "float32", "mins": low, "maxs": high, "quantization": 6}
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


def check_damaged(path: Path, peak_limit: float) -> None:
    """A damaged file is refused with a MapError, or read as a valid map, without taking memory beyond its size.

    At most `peak_limit` bytes are taken.
    """
    tracemalloc.start()
    try:
        gaussian_map = load_map(path)
    except MapError:
        gaussian_map = None
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < peak_limit
    if gaussian_map is not None:
        assert len(gaussian_map) > 0
        for name in ARRAYS:
            assert np.isfinite(getattr(gaussian_map, name)).all()
        assert (gaussian_map.scales > 0).all()
        np.testing.assert_allclose(np.linalg.norm(gaussian_map.rotations, axis=1), 1.0, atol=1e-5)
