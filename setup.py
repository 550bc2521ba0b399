"""Installs the package with colcon or pip. Name, version, licence and people stand in package.xml, once."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

manifest = ElementTree.parse("package.xml").getroot()
name = manifest.findtext("name", "")


def data(folder: str) -> tuple[str, list[str]]:
    """The files of a folder, hidden ones left out, and where they go: share/<package>/<folder>."""
    return f"share/{name}/{folder}", [
        str(file) for file in sorted(Path(folder).glob("[!.]*")) if file.is_file()
    ]


setup(
    name=name,
    version=manifest.findtext("version"),
    description=manifest.findtext("description"),
    license=manifest.findtext("license"),
    maintainer=manifest.findtext("maintainer"),
    packages=find_packages(include=[name, f"{name}.*"]),
    package_data={name: ["py.typed", "ros/console/page/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
        *map(data, ["config", "launch", "weights"]),
    ],
    python_requires=">=3.10",
    # rclpy and the messages come with ROS. OpenCV is needed, yet an extra: on a ROS machine it comes from
    # apt, unseen by pip, which would install a second one in front of it.
    install_requires=[
        "annotated-types",
        "numpy>=1.26",
        "pydantic>=2",
        "pydantic-core",
        "pyyaml>=5.4",
        "safetensors",
        "torch>=2.10",
    ],
    extras_require={
        "bag": ["rosbags>=0.11"],
        "console": [
            "h11>=0.14",
            "prometheus-client>=0.20",
            "starlette>=0.45",
            "uvicorn>=0.35",
            "websockets>=13",
        ],
        "evaluation": ["matplotlib>=3.8", "pycocotools>=2.0.7"],
        "onnxruntime": ["onnx>=1.16", "onnxruntime>=1.19"],
        "opencv": ["opencv-python-headless>=4.6"],
        "openvino": ["onnx>=1.16", "openvino>=2024.4"],
        "ray": ["ray>=2.40"],
        "summary": ["pyarrow>=15"],
        "tracking": ["scipy>=1.11"],
    },
    zip_safe=True,
    entry_points={
        "console_scripts": [
            f"calibrate = {name}.commands.entry_points:calibrate",
            f"camera = {name}.ros.entry_points:camera",
            f"console = {name}.ros.entry_points:console",
            f"convert = {name}.commands.entry_points:convert",
            f"demo = {name}.commands.entry_points:demo",
            f"detect_bag = {name}.commands.entry_points:detect_bag",
            f"detector = {name}.ros.entry_points:detector",
            f"evaluate = {name}.commands.entry_points:evaluate",
            f"fetch_weights = {name}.commands.entry_points:fetch_weights",
        ]
    },
)
