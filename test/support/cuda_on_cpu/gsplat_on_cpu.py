"""The forward kernels of gsplat 1.5.3, compiled for the CPU: what gsplat does with tensors, seen without a GPU.

Its CUDA sources are rewritten to C++ (launches, shared memory, casts; cuda_on_cpu.h is the rest) and built with g++.
What it shows of a GPU ends there: no speed, no streams, and the sort is not NVIDIA's.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import sysconfig
from pathlib import Path
from types import ModuleType

import torch
from torch.utils.cpp_extension import include_paths

HERE = Path(__file__).parent
KERNELS = {  # sources, and what is left out: from the template before this name to the end
    "ProjectionEWA3DGSPacked.cu": "projection_ewa_3dgs_packed_bwd_kernel",
    "SphericalHarmonicsCUDA.cu": "spherical_harmonics_bwd_kernel",
    "IntersectTile.cu": "",
    "RasterizeToPixels3DGSFwd.cu": "",
}
OPERATORS = {  # functions that allocate and call the kernels, and their sources
    "projection_ewa_3dgs_packed_fwd": "Projection.cpp",
    "spherical_harmonics_fwd": "SphericalHarmonics.cpp",
    "intersect_tile": "Intersect.cpp",
    "intersect_offset": "Intersect.cpp",
    "rasterize_to_pixels_3dgs_fwd": "Rasterization.cpp",
}
CHANNELS = (3, 32, 33)


def import_on_cpu(folder: Path) -> ModuleType:
    """Import gsplat, installed in `folder`, for tensors of the CPU; the kernels are built there if they are not yet."""
    library = folder / "on_cpu" / ("csrc" + sysconfig.get_config_var("EXT_SUFFIX"))
    if not library.exists():
        _build(folder / "gsplat" / "cuda", library.parent, library)
    spec = importlib.util.spec_from_file_location("gsplat.csrc", library)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    # Where gsplat looks before it builds its own.
    sys.modules["gsplat.csrc"] = module
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module("gsplat")
    finally:
        sys.path.remove(str(folder))


def _build(cuda: Path, folder: Path, library: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for header in [*cuda.glob("include/*"), *cuda.glob("csrc/*.h")]:
        (folder / header.name).write_text(_rewritten(header.read_text()))
    parts = ['#include "cuda_on_cpu.h"\n#include <torch/extension.h>\n#include "Ops.h"\n']
    for name, left_out in KERNELS.items():
        text = (cuda / "csrc" / name).read_text()
        if left_out:
            text = text[: text.rindex("template <", 0, text.index(left_out))] + "}\n"
        parts.append(_rewritten(text))
    for function, name in OPERATORS.items():
        text = (cuda / "csrc" / name).read_text()
        opening = text.index("namespace gsplat {") + len("namespace gsplat {")
        parts.append(_rewritten(text[:opening] + _function(text, function)) + "}\n")
    parts.append('PYBIND11_MODULE(csrc, m) {\npy::enum_<gsplat::CameraModelType>(m, "CameraModelType")')
    parts.append('.value("PINHOLE", gsplat::PINHOLE).export_values();\n')
    for function in OPERATORS:
        parts.append(f'm.def("{function}", &gsplat::{function});\n')
    source = folder / "gsplat.cpp"
    source.write_text("".join(parts) + "}\n")
    libraries = Path(torch.__file__).parent / "lib"
    includes = [folder, HERE, cuda / "csrc/third_party/glm", *include_paths(), sysconfig.get_paths()["include"]]
    flags = ["-std=c++20", "-O2", "-march=native", "-fPIC", "-w", "-fvisibility=hidden", "-shared"]
    links = [f"-L{libraries}", f"-Wl,-rpath,{libraries}", "-lc10", "-ltorch", "-ltorch_cpu", "-ltorch_python"]
    command = ["g++", *flags, *(f"-I{path}" for path in includes), source, "-o", library.with_suffix(".part"), *links]
    subprocess.run(command, check=True)
    library.with_suffix(".part").rename(library)


def _rewritten(text: str) -> str:
    text = re.sub(r"#include <(ATen/cuda|c10/cuda|cooperative_groups|cub)[/.].*>.*\n", "", text)
    text = text.replace("x.is_cuda()", "x.is_cpu()")
    text = text.replace("extern __shared__ int s[];", "int *s = (int *)cuda_on_cpu::dynamic_shared.data();")
    text = re.sub(r"\((u?int32_t)\)(radius_[xy]|(floor|ceil)\(tile_\w \W tile_radius_\w\))", _saturated, text)
    widths = "|".join(str(width) for width in CHANNELS)
    text = re.sub(rf"^ *__(INS|LAUNCH_KERNEL)__\((?!N\)|CDIM\)|({widths})\)).*\n", "", text, flags=re.MULTILINE)
    while "<<<" in text:
        at, end = text.index("<<<"), text.index(">>>")
        kernel = re.search(r"\w+(<[\w, ]+>)?\s*$", text[:at])
        close = _closing(text, end + 3)
        call = f"{kernel[0]}{text[end + 3 : close]}"
        launch = f"cuda_on_cpu::launch({text[at + 3 : end]}, [&] {{ {call}; }})"
        text = text[: kernel.start()] + launch + text[close:]
    return text


def _saturated(cast: re.Match) -> str:
    return f"cuda_on_cpu::saturate<{cast[1]}>({cast[2]})"


def _function(text: str, name: str) -> str:
    """A function with its return type, that begins a line."""
    at = re.search(rf"\b{name}\(", text).start()
    start = max(text.rindex(kind, 0, at) for kind in ("\nstd::tuple", "\nat::Tensor") if kind in text[:at])
    return text[start : _closing(text, text.index("{", _closing(text, text.index("(", at))))] + "\n"


def _closing(text: str, start: int) -> int:
    """Where the bracket that opens at `start` has closed."""
    depth = 0
    for k in range(start, len(text)):
        depth += (text[k] in "([{") - (text[k] in ")]}")
        if depth == 0:
            return k + 1
    raise ValueError("a bracket does not close")
