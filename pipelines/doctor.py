"""What this installation can do: versions, codecs, GPU, threads, optional packages and programs. It changes nothing.

Each finding has a state: 'ok', 'missing' (optional: something cannot be done without it) or 'problem' (to be mended).
"""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from typing import Any

# Package, and the module that proves it can be loaded.
NEEDED = (
    ("numpy", "numpy"),
    ("scipy", "scipy"),
    ("torch", "torch"),
    ("kornia", "kornia"),
    ("numba", "numba"),
    ("av", "av"),
    ("opencv-contrib-python-headless", "cv2"),
    ("pillow", "PIL"),
    ("tifffile", "tifffile"),
    ("jinja2", "jinja2"),
    ("pydantic", "pydantic"),
    ("rich", "rich"),
    ("typer", "typer"),
)
OPTIONAL = (
    ("pyarrow", "camera.parquet", "pip install 'broadcast-mosaic[parquet]'"),
    ("onnxruntime", "people.model", "pip install 'broadcast-mosaic[people]'"),
)
# Decoders by what they are met as; the first of each that PyAV has is used.
DECODERS = (
    ("h264", "most broadcast and web clips"),
    ("hevc", "newer cameras"),
    ("mpeg2video", "DVB, XDCAM, IMX"),
    ("prores", "editing"),
    ("dnxhd", "editing"),
    ("dvvideo", "DV tapes"),
    ("jpeg2000", "archives"),
    ("ffv1", "archives"),
    ("av1", "web clips"),
    ("vp9", "web clips"),
)
PROGRAMS = (
    ("nona", "renders panorama.pto (Hugin)", "the package hugin-tools"),
    ("exiftool", "shows the panorama's GPano data", "the package libimage-exiftool-perl"),
)
# Encoders by what `render --codec` calls them.
ENCODERS = (("libx264", "h264"), ("libx265", "hevc10"), ("prores_ks", "prores"))
SIGNS = "±°×"  # in tables and messages; a terminal that lacks one shows a question mark
SCRATCH_GIB = 2.0  # a long shot's scratch files: keyframes and frame store


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One line: group and name, what was found, 'ok' / 'missing' / 'problem', and the cure where it is not ok."""

    group: str
    name: str
    found: str
    state: str = "ok"
    cure: str = ""


def examine() -> list[Finding]:
    """Everything that is looked at. Never raises: what cannot be asked is itself a finding."""
    groups: tuple[tuple[str, Callable[[], Iterator[Finding]]], ...] = (
        ("versions", versions),
        ("codecs", codecs),
        ("codecs", encoders),
        ("gpu", gpu),
        ("threads", threads),
        ("optional", optional),
        ("fonts", fonts),
        ("folders", folders),
    )
    findings: list[Finding] = []
    for group, look in groups:
        try:
            findings += look()
        except Exception as error:  # a broken library must not hide what the other groups say
            cause = f"{type(error).__name__}: {error}".splitlines()[0]
            findings.append(
                Finding(
                    group=group, name="examination", found=cause, state="problem", cure="install it again"
                )
            )
    return findings


def versions() -> Iterator[Finding]:
    """Python, the program, and every package that it needs, loaded."""
    python = platform.python_version()
    fits = (3, 11) <= tuple(int(part) for part in python.split(".")[:2]) < (3, 14)
    yield Finding(
        group="versions",
        name="python",
        found=f"{python} on {platform.system()} {platform.machine()}",
        state="ok" if fits else "problem",
        cure="" if fits else "use Python 3.11 to 3.13",
    )
    yield _version("broadcast-mosaic", "pipelines")
    for package, module in NEEDED:
        yield _version(package, module)
    builds = sorted(
        name
        for dist in metadata.distributions()
        if (name := (dist.metadata["Name"] or "").lower().replace("_", "-")).startswith("opencv-")
    )
    if len(builds) > 1:
        # They write the same cv2 folder: pip says nothing, and one of them is half overwritten.
        cure = "pip uninstall all of them, then pip install opencv-contrib-python-headless"
        yield Finding(group="versions", name="cv2", found=" and ".join(builds), state="problem", cure=cure)


def _version(package: str, module: str) -> Finding:
    try:
        importlib.import_module(module)
        return Finding(group="versions", name=package, found=metadata.version(package))
    except metadata.PackageNotFoundError:
        found, cure = "used from a checkout, not installed", ""
        return Finding(group="versions", name=package, found=found, cure=cure)
    except Exception as error:  # a damaged wheel raises whatever it likes
        cause = str(error).splitlines()[0] if str(error) else type(error).__name__
        return Finding(
            group="versions", name=package, found=cause, state="problem", cure=f"pip install {package}"
        )


def codecs() -> Iterator[Finding]:
    """FFmpeg's version inside PyAV and the decoders that broadcast clips ask for."""
    import av
    from av.codec import codecs_available

    library = getattr(av, "library_versions", {}).get("libavcodec")
    yield Finding(
        group="codecs", name="libavcodec", found=".".join(str(n) for n in library) if library else "unknown"
    )
    for name, use in DECODERS:
        there = any(candidate in codecs_available for candidate in _names_of(name))
        yield Finding(
            group="codecs",
            name=name,
            found=f"decoder, {use}" if there else f"no decoder, {use}",
            state="ok" if there else "missing",
            cure="" if there else "pip install --upgrade av",
        )


def encoders() -> Iterator[Finding]:
    """What `render` writes with."""
    import av

    for name, codec in ENCODERS:
        use = f"for render --codec {codec}"
        try:
            av.codec.Codec(name, "w")
            yield Finding(group="codecs", name=name, found=f"encoder, {use}")
        except ValueError:  # PyAV's UnknownCodecError is one
            cure = "pip install --upgrade av"
            yield Finding(group="codecs", name=name, found=f"no encoder, {use}", state="missing", cure=cure)


def _names_of(codec: str) -> tuple[str, ...]:
    return (codec, f"lib{codec}", "libdav1d") if codec == "av1" else (codec, f"lib{codec}")


def gpu() -> Iterator[Finding]:
    """The GPU that torch would use. None is no problem: nothing here needs one."""
    import torch

    if torch.cuda.is_available():
        for index in range(torch.cuda.device_count()):
            facts = torch.cuda.get_device_properties(index)
            found = f"{facts.name}, {facts.total_memory / 2**30:.0f} GiB; for --registration.kernel torch"
            yield Finding(group="gpu", name=f"cuda:{index}", found=found)
        return
    built = torch.version.cuda
    why = (
        "torch has no CUDA in it" if built is None else f"torch is built for CUDA {built}, no device answers"
    )
    yield Finding(group="gpu", name="none", found=f"{why}; not needed, the CPU does everything")


def threads() -> Iterator[Finding]:
    """Cores of the machine and of this process, and the threads that the numeric libraries take."""
    cores = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else cores
    found = str(cores) if usable == cores else f"{usable} of {cores} for this process"
    yield Finding(group="threads", name="cores", found=found)
    import cv2
    import numba
    import torch

    for name, count in (
        ("numba", numba.get_num_threads()),
        ("torch", torch.get_num_threads()),
        ("cv2", cv2.getNumThreads()),
    ):
        yield Finding(group="threads", name=name, found=str(count))


def optional() -> Iterator[Finding]:
    """Packages of the extras and programs of others that work on our files."""
    for package, use, cure in OPTIONAL:
        try:
            found = f"{metadata.version(package)}, for {use}"
            yield Finding(group="optional", name=package, found=found)
        except metadata.PackageNotFoundError:
            yield Finding(
                group="optional", name=package, found=f"not installed, for {use}", state="missing", cure=cure
            )
    for program, use, cure in PROGRAMS:
        path = shutil.which(program)
        yield Finding(
            group="optional",
            name=program,
            found=f"{path}, {use}" if path else f"not found, {use}",
            state="ok" if path else "missing",
            cure="" if path else f"install {cure}",
        )


def fonts() -> Iterator[Finding]:
    """Nothing draws letters but the reader's own browser; what is said in signs must be sayable in a terminal."""
    yield Finding(group="fonts", name="report, viewer", found="the browser's own; none is loaded or shipped")
    encoding = getattr(sys.stdout, "encoding", None) or "ascii"
    try:
        SIGNS.encode(encoding)
        yield Finding(group="fonts", name="terminal", found=f"{encoding}, which has all signs of the tables")
    except (UnicodeEncodeError, LookupError):
        found, cure = f"{encoding}, which lacks {SIGNS}", "set PYTHONIOENCODING=utf-8, or a UTF-8 locale"
        yield Finding(group="fonts", name="terminal", found=found, state="missing", cure=cure)


def folders() -> Iterator[Finding]:
    """Room for scratch files, and whether compiled kernels can be kept between runs."""
    for name, folder, use, cure in (
        ("results", os.getcwd(), "; a run's scratch files lie where its results go", "give -o a larger disk"),
        ("temporary", tempfile.gettempdir(), "", "make room, or set TMPDIR"),
    ):
        free = shutil.disk_usage(folder).free / 2**30
        enough = free >= SCRATCH_GIB
        yield Finding(
            group="folders",
            name=name,
            found=f"{folder}, {free:.1f} GiB free{use}",
            state="ok" if enough else "problem",
            cure="" if enough else cure,
        )
    import mosaic

    place = os.environ.get("NUMBA_CACHE_DIR") or os.path.dirname(mosaic.__file__)
    kept = os.access(place, os.W_OK)
    yield Finding(
        group="folders",
        name="compiled kernels",
        found=place if kept else f"{place} is read-only: every run compiles for half a minute",
        state="ok" if kept else "missing",
        cure="" if kept else "set NUMBA_CACHE_DIR to a folder that can be written",
    )


def as_document(findings: list[Finding]) -> dict[str, Any]:
    """JSON-ready: {ok, findings: [{group, name, found, state, cure}]}."""
    rows = [{key: getattr(f, key) for key in ("group", "name", "found", "state", "cure")} for f in findings]
    return {"ok": all(f.state != "problem" for f in findings), "findings": rows}


def as_text(findings: list[Finding]) -> str:
    """A line a finding; groups as headings, what is not ok marked and with its cure."""
    width = max(len(f.name) for f in findings)
    lines: list[str] = []
    group = ""
    for f in findings:
        if f.group != group:
            group = f.group
            lines.append(("\n" if lines else "") + group)
        mark = {"ok": " ", "missing": "-", "problem": "!"}[f.state]
        cure = f"; {f.cure}" if f.cure else ""
        lines.append(f" {mark} {f.name:<{width}}  {f.found}{cure}")
    problems = sum(f.state == "problem" for f in findings)
    verdict = (
        "ready to use" if not problems else f"{problems} problem{'s' if problems > 1 else ''}, marked with !"
    )
    return "\n".join([*lines, "", verdict])
