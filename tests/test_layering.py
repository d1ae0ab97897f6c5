"""Which package may import which: read from the source with `ast`, then seen in fresh interpreters.

mosaic and calib know neither each other nor pipelines; calib is numpy, scipy and the standard library; no package
imports the tests; the command line's help loads nothing heavy.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("mosaic", "calib", "pipelines")
FORBIDDEN: dict[str, set[str]] = {
    "mosaic": {"calib", "pipelines", "av"},  # knows no video
    "calib": {"mosaic", "pipelines"},
    "pipelines": set(),
}


def imported_modules(source: str, package: str) -> Iterator[str]:
    """Absolute dotted names of every import in `source`, a module of `package` ('pipelines.report'), at any depth."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level == 0:
                yield node.module or ""
                continue
            base = package.split(".")[: len(package.split(".")) - node.level + 1]
            yield ".".join([*base, *([node.module] if node.module else [])])
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
            called = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
            first = node.args[0] if node.args else None
            if called in {"import_module", "__import__"} and isinstance(first, ast.Constant):
                yield str(first.value)


def imports_of(package: str) -> dict[str, set[str]]:
    """Top-level module -> the files of `package` that import it."""
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        dotted = ".".join(path.relative_to(ROOT).parent.parts)
        for name in imported_modules(path.read_text(encoding="utf-8"), dotted):
            found.setdefault(name.split(".")[0], set()).add(str(path.relative_to(ROOT)))
    return found


def modules_after(statement: str) -> set[str]:
    """Top-level names in sys.modules of a fresh interpreter after `statement`."""
    code = (
        f"import sys, json\n{statement}\nprint(json.dumps(sorted({{m.split('.')[0] for m in sys.modules}})))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert run.returncode == 0, run.stderr
    return set(json.loads(run.stdout.splitlines()[-1]))


def test_the_reader_of_imports_sees_every_form() -> None:
    source = (
        "import a.b, c as d\nfrom e.f import g\nfrom . import h\nfrom .i import j\nfrom ..k import l\n"
        "def f():\n    import m\n    importlib.import_module('n.o')\n    __import__('p')\n"
    )
    assert set(imported_modules(source, "pipelines.report")) == {
        "a.b", "c", "e.f", "pipelines.report", "pipelines.report.i", "pipelines.k", "m", "n.o", "p",
    }  # fmt: skip


@pytest.mark.parametrize("package", PACKAGES)
def test_package_imports_only_downwards(package: str) -> None:
    found = imports_of(package)
    assert found, f"no import read in {package}"
    forbidden = FORBIDDEN[package] | {"tests", "benchmarks"}
    assert {name: sorted(files) for name, files in found.items() if name in forbidden} == {}


def test_calib_imports_only_numpy_and_scipy() -> None:
    allowed = {"calib", "numpy", "scipy"} | set(sys.stdlib_module_names)
    assert {name: files for name, files in imports_of("calib").items() if name not in allowed} == {}


def test_calib_in_a_fresh_interpreter_loads_no_picture_library() -> None:
    loaded = modules_after(
        "import pkgutil, importlib, calib\n"
        "for module in pkgutil.walk_packages(calib.__path__, 'calib.'):\n"
        "    importlib.import_module(module.name)"
    )
    assert loaded & {"torch", "cv2", "av", "kornia", "PIL", "mosaic", "pipelines"} == set()


def test_mosaic_alone_loads_neither_torch_nor_calibration() -> None:
    """Its __init__ re-exports lazily: naming the package costs nothing."""
    loaded = modules_after("import mosaic")
    assert loaded & {"torch", "kornia", "cv2", "numba", "calib", "pipelines", "av"} == set()


def test_help_loads_nothing_heavy() -> None:
    loaded = modules_after(
        "from pipelines.cli import main\n"
        "sys.argv = ['broadcast-mosaic', '--help']\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert stop.code in (0, None), stop.code"
    )
    assert "pipelines" in loaded
    assert loaded & {"torch", "cv2", "kornia", "scipy", "numba", "av"} == set()
