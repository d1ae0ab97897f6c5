"""What the project's environment must hold and must not: read from the installed distributions."""

from __future__ import annotations

from collections import Counter
from importlib.metadata import distributions, requires
from pathlib import PurePosixPath


def installed() -> Counter[str]:
    return Counter((dist.metadata["Name"] or "").lower().replace("_", "-") for dist in distributions())


def test_one_opencv_build_owns_cv2() -> None:
    """Every OpenCV wheel writes the same cv2 folder; with two, pip check is silent and uninstalling one breaks both."""
    builds = {name for name in installed() if name.startswith("opencv-") and "python" in name}
    assert builds == {"opencv-contrib-python-headless"}


def test_no_other_distribution_writes_into_our_packages() -> None:
    """mosaic, calib and pipelines are common words: a second distribution of that name would shadow ours."""
    owners = {
        (dist.metadata["Name"] or "").lower()
        for dist in distributions()
        for file in dist.files or ()
        if PurePosixPath(str(file)).parts[0] in {"mosaic", "calib"}
    }
    assert owners <= {"broadcast-mosaic"}


def test_heavy_or_rare_packages_are_extras() -> None:
    """formats.md C: pyarrow is 170 MB; ray, pyvips, torchvision are for few. They never come unasked."""
    core = [line for line in requires("broadcast-mosaic") or [] if "extra ==" not in line]
    assert core, "no dependencies recorded: the project is not installed"
    unasked = ("pyarrow", "pyvips", "ray", "torchvision", "opencv-python", "polars", "pandas",
               "usd-core", "pycolmap", "jsonschema")  # fmt: skip
    assert [line for line in core if line.startswith(unasked)] == []
