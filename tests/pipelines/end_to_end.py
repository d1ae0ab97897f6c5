"""Clips for the end-to-end tests, the command line called in this process, and what a folder of results holds."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines import cli
from pipelines.archive import read_camera_csv
from pipelines.records import CameraTable
from tests.synth.camera import SynthCamera
from tests.synth.clip import ClipSpec, read_truth, truth_path
from tests.synth.paths import PathSpec

SIZE = (640, 360)


def small_spec(seed: int, n_frames: int, path: PathSpec, **values: Any) -> ClipSpec:
    """A shot of 640x360 with six players; paints and encodes in about two seconds."""
    defaults: dict[str, Any] = {
        "n_players": 6,
        "player_share": 0.03,
        "noise_grey": 1.5,
        "max_px_per_rad": 1400.0,
    }
    return ClipSpec(
        seed=seed, width=SIZE[0], height=SIZE[1], n_frames=n_frames, path=path, **{**defaults, **values}
    )


def pan_spec(seed: int = 4, n_frames: int = 50, pan_deg: float = 18.0, **values: Any) -> ClipSpec:
    """A pan that zooms in by 1.3."""
    return small_spec(seed, n_frames, PathSpec(pan_deg=pan_deg, zoom=1.3, zoom_style="in"), **values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """What a call of the command line gave: clip, OUT, exit code, and what went to stdout and stderr."""

    clip: Path
    out: Path
    code: int
    stdout: str
    stderr: str

    @property
    def record(self) -> dict[str, Any]:
        """run.json."""
        data: dict[str, Any] = json.loads((self.out / "run.json").read_text(encoding="utf-8"))
        return data

    @property
    def table(self) -> CameraTable:
        """camera.csv."""
        return read_camera_csv(self.out / "camera.csv")

    @property
    def camera_bytes(self) -> bytes:
        """camera.csv as it lies there."""
        return (self.out / "camera.csv").read_bytes()

    @property
    def truth(self) -> dict[str, NDArray[Any]]:
        """The truth beside the clip."""
        return read_truth(truth_path(self.clip))


def run(clip: Path, out: Path, *options: str) -> Finished:
    """`broadcast-mosaic run CLIP -o OUT` with options, in this process: a warning of any library is an error here."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        code = cli.main(["run", str(clip), "-o", str(out), *options])
    return Finished(clip=clip, out=out, code=code, stdout=stdout.getvalue(), stderr=stderr.getvalue())


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file under a folder, hidden ones too."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def true_homographies(truth: dict[str, NDArray[Any]], reference: int) -> NDArray[np.float64]:
    """(n, 3, 3) undistorted pixels of each frame to those of the reference frame, by the generator's camera model."""
    K, R = [], []
    for row in range(len(truth["frame"])):
        camera = SynthCamera(
            width=SIZE[0], height=SIZE[1], f_px=truth["f_px"][row],
            pan_rad=np.deg2rad(truth["pan_deg"][row]), tilt_rad=np.deg2rad(truth["tilt_deg"][row]),
            roll_rad=np.deg2rad(truth["roll_deg"][row]), cx_px=truth["cx_px"][row], cy_px=truth["cy_px"][row],
        )  # fmt: skip
        K.append(camera.K)
        R.append(camera.R_cam_world)
    K_all, R_all = np.array(K), np.array(R)
    H: NDArray[np.float64] = (
        K_all[reference] @ R_all[reference] @ np.swapaxes(R_all, 1, 2) @ np.linalg.inv(K_all)
    )
    return H


def corner_errors_px(H: NDArray[np.float64], H_true: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) rms over the picture's corners of where H and the true H send them, px of the reference frame."""
    w, h = SIZE
    corners = np.array([[0.0, 0.0, 1.0], [w - 1.0, 0.0, 1.0], [w - 1.0, h - 1.0, 1.0], [0.0, h - 1.0, 1.0]])
    sent, wanted = (np.einsum("nij,cj->nci", M, corners) for M in (H, H_true))
    away = sent[..., :2] / sent[..., 2:] - wanted[..., :2] / wanted[..., 2:]
    errors: NDArray[np.float64] = np.sqrt(np.mean(np.sum(away**2, axis=-1), axis=-1))
    return errors


def one_line(text: str) -> str:
    """The only line of a text; fails when there are more, or a traceback."""
    lines: Sequence[str] = text.splitlines()
    assert len(lines) == 1, text
    assert "Traceback" not in lines[0]
    return lines[0]
