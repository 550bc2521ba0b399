"""Installs the package with colcon or pip. Name, version, licence and people stand in package.xml, once."""

import gzip
import os
import re
import tarfile
import time
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup
from setuptools.command.sdist import sdist

manifest = ElementTree.parse("package.xml").getroot()
name = manifest.findtext("name", "")
version = manifest.findtext("version", "")
addresses = {url.get("type", "website"): (url.text or "").strip().rstrip("/") for url in manifest.iter("url")}
LABELS = {"website": "Homepage", "repository": "Source", "bugtracker": "Issues"}
RELATIVE_LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^]]*)\]\((?!\w+:|#)(?P<path>[^)]+)\)")


def data(folder: str) -> tuple[str, list[str]]:
    """The files of a folder, hidden ones left out, and where they go: share/<package>/<folder>."""
    return f"share/{name}/{folder}", [
        str(file) for file in sorted(Path(folder).glob("[!.]*")) if file.is_file()
    ]


def absolute_link(link: re.Match[str]) -> str:
    """A link of README.md to a file beside it: one to the release's tag, or without an address its text."""
    repository = addresses.get("repository")
    if not repository:
        return "" if link["image"] else link["text"]
    page = "raw" if link["image"] else "blob"
    return f"{link['image']}[{link['text']}]({repository}/{page}/v{version}/{link['path']})"


def long_description() -> str:
    """README.md as PyPI shows it; "" where .dockerignore has left it out."""
    readme = Path("README.md")
    return RELATIVE_LINK.sub(absolute_link, readme.read_text(encoding="utf-8")) if readme.exists() else ""


class ReproducibleSdist(sdist):
    """Packs the same files into the same bytes, dated SOURCE_DATE_EPOCH, as setuptools does for wheels."""

    def make_archive(self, base_name: str, archive_format: str, base_dir: str, **_: object) -> str:
        """Write `base_name`.tar.gz with the files below `base_dir`, and return its path."""
        epoch = int(os.environ.get("SOURCE_DATE_EPOCH", time.time()))

        def dated(member: tarfile.TarInfo) -> tarfile.TarInfo:
            member.mtime = epoch
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            member.uid = member.gid = 0
            member.uname = member.gname = "root"
            return member

        path = f"{base_name}.tar.gz"
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with (
            gzip.GzipFile(path, "wb", mtime=epoch) as packed,
            tarfile.open(fileobj=packed, mode="w") as archive,
        ):
            archive.add(base_dir, filter=dated)  # sorted by name
        return path


setup(
    name=name,
    version=version,
    description=manifest.findtext("description"),
    long_description=long_description(),
    long_description_content_type="text/markdown",
    license=manifest.findtext("license"),
    license_files=["LICENSE"],
    maintainer=manifest.findtext("maintainer"),
    maintainer_email=manifest.find("maintainer").get("email"),
    project_urls={LABELS[kind]: address for kind, address in addresses.items()},
    keywords=["ROS 2", "YOLOv5", "object detection", "instance segmentation", "lifecycle node"],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Developers",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3 :: Only",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 14)),
        "Topic :: Scientific/Engineering :: Image Recognition",
        "Typing :: Typed",
    ],
    packages=find_packages(include=[name, f"{name}.*"]),
    package_data={name: ["py.typed", "ros/console/page/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
        *map(data, ["config", "launch", "weights"]),
    ],
    python_requires=">=3.10",
    # rclpy and the messages come with ROS, or from the extra "ros", which has all that the nodes need. OpenCV
    # is needed, yet an extra: on a ROS machine it comes from apt, unseen by pip, which would install a second
    # one in front of it.
    install_requires=[
        "annotated-types",
        "numpy>=1.26",
        "pydantic>=2.6",
        "pydantic-core",
        "pyyaml>=5.4",
        "safetensors",
        "torch>=2.10",
    ],
    extras_require={
        "bag": ["apsw", "backports.zstd", "lz4", "rosbags>=0.11"],
        "console": [
            "h11>=0.14",
            "prometheus-client>=0.20",
            "starlette>=0.45",
            "uvicorn>=0.35",
            "websockets>=13",
        ],
        "evaluation": ["pycocotools>=2.0.7"],
        "onnxruntime": ["onnx>=1.16", "onnxruntime>=1.19"],
        "opencv": ["opencv-python-headless>=4.6"],
        "openvino": ["onnx>=1.16", "openvino>=2024.4"],
        # The first has vision_msgs and bond, which no other package has; the versions are those of Jazzy.
        "ros": [
            f"{name}_interfaces=={version}",
            "opencv-python-headless>=4.6",
            "ros-common-interfaces~=5.3",
            "ros-lifecycle-msgs~=2.0",
            "ros-rclpy[fastrtps]~=7.1",
        ],
        "tracking": ["scipy>=1.11"],
    },
    cmdclass={"sdist": ReproducibleSdist},
    zip_safe=True,
    entry_points={
        "console_scripts": [
            f"calibrate = {name}.commands.entry_points:calibrate",
            f"camera = {name}.ros.entry_points:camera",
            f"console = {name}.ros.entry_points:console",
            f"collected = {name}.commands.entry_points:collected",
            f"convert = {name}.commands.entry_points:convert",
            f"demo = {name}.commands.entry_points:demo",
            f"detect_bag = {name}.commands.entry_points:detect_bag",
            f"detector = {name}.ros.entry_points:detector",
            f"doctor = {name}.commands.entry_points:doctor",
            f"evaluate = {name}.commands.entry_points:evaluate",
            f"fetch_weights = {name}.commands.entry_points:fetch_weights",
        ]
    },
)
