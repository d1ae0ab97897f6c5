"""Made-up records of a run, for tests of what reads them: report, archive, exports. No measurement in them is real."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from pipelines.records import CameraTable, RunRecord, ShotRecord

WIDTH, HEIGHT = 1280, 720


def fake_table(n: int = 400, seed: int = 3) -> CameraTable:
    """n frames: shot 0 (55 %) a pan with zoom, a short graphic, then shot 1 a pure zoom without a focal claim."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, n)
    cut, back = int(0.55 * n), int(0.58 * n)
    shot = np.where(np.arange(n) < cut, 0, np.where(np.arange(n) < back, -1, 1))
    status = np.where(shot == 0, "ok", np.where(shot == 1, "relative", "graphic")).astype(object)
    reason = np.where(shot == 0, "", np.where(shot == 1, "zoom_only", "")).astype(object)
    for first, last, word, code in (
        (0.10, 0.14, "weak", "perspective_signal_below_systematics"),
        (0.30, 0.33, "lost", "low_overlap"),
        (0.33, 0.34, "interpolated", "diverged"),
    ):
        status[int(first * n) : int(last * n)] = word
        reason[int(first * n) : int(last * n)] = code

    zoom = 1.0 + 0.35 * (1 - np.cos(2 * np.pi * t)) + 1e-3 * rng.standard_normal(n)
    lost = np.isin(status, ["lost", "graphic"])
    no_focal = lost | (shot != 0)

    def column(values: Any, empty: np.ndarray) -> np.ndarray:
        return np.where(empty, np.nan, values).astype(np.float64)

    focal = 2755.0 * zoom
    std = focal * np.where(status == "weak", 0.07, 0.019)
    homography = np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
    homography[lost] = np.nan
    return CameraTable(
        frame=np.arange(n),
        pts_s=np.arange(n) / 25.0,
        timecode=tuple(f"10:{i // 1500 % 60:02d}:{i // 25 % 60:02d}:{i % 25:02d}" for i in range(n)),
        source_frame=np.arange(n),
        field=np.full(n, -1),
        shot=shot,
        status=tuple(status),
        reason=tuple(reason),
        f_px=column(focal, no_focal),
        f_std_px=column(std, no_focal),
        f_stat_px=column(std / 6, no_focal),
        zoom_ratio=column(zoom, lost),
        zoom_ratio_std=column(0.001, lost),
        hfov_deg=column(np.degrees(2 * np.arctan(WIDTH / 2 / focal)), no_focal),
        pan_deg=column(30 * t - 8 + 0.02 * rng.standard_normal(n), no_focal),
        tilt_deg=column(2 * np.sin(5 * t) - 1, no_focal),
        roll_deg=column(0.1 * np.sin(9 * t), no_focal),
        cx_px=column((WIDTH - 1) / 2, lost),
        cy_px=column((HEIGHT - 1) / 2, lost),
        aspect=column(1.0, lost),
        k1=column(0.2, no_focal),
        residual_px=column(0.2 + 0.08 * np.abs(rng.standard_normal(n)), lost),
        overlap=column(0.9 - 0.2 * t, lost),
        homography=homography,
    )


def fake_run(
    table: CameraTable, *, clip_path: str = "final-main-camera.mp4", outlines: bool = True
) -> RunRecord:
    """A manifest that fits `fake_table`: one ok shot with a panorama, one relative shot without."""
    counts = [
        {word: sum(s == word for s, k in zip(table.status, table.shot, strict=True) if k == shot)
         for word in set(table.status)} for shot in (0, 1)
    ]  # fmt: skip
    first = [int(np.flatnonzero(table.shot == shot)[0]) for shot in (0, 1)]
    last = [int(np.flatnonzero(table.shot == shot)[-1]) for shot in (0, 1)]
    corners = np.array([[0.0, 0.0], [1279.0, 0.0], [1279.0, 719.0], [0.0, 719.0]])
    drawn = {
        i: (corners * (0.9 - 0.2 * i / len(table)) + [200 + 2400 * i / (last[0] + 1), 60]).tolist()
        for i in range(0, last[0] + 1, max(1, last[0] // 100))
    }
    ok = ShotRecord(
        index=0, first_frame=first[0], last_frame=last[0], reference_frame=last[0] // 2, status="ok", reason="",
        sentence="", focal={"min_f_px": 2755.0, "max_f_px": 4650.0},
        calibration={
            "sigma_log_f_total": 0.0192,
            "sigma_parts": {"statistical": 0.003, "principal_point": 0.011, "distortion": 0.0153,
                            "systematic_px": 0.21},
            "s10_px": 0.87, "chi2_dof": 2.61, "n_keyframes": 14, "n_edges": 61,
            "lens": {"k1_half": 0.021, "pp_px": [642.1, 351.8]}, "level": None, "flags": ["inflated"],
        },
        panorama={"surface": "equirectangular", "size": [4000, 900], "outlines": drawn if outlines else None},
        files=("shot-000/panorama.tif", "shot-000/panorama.jpg", "shot-000/panorama.json", "shot-000/pairs.npz"),
        status_counts=counts[0], timings_s={"composite": 4.2, "refine": 0.7},
        warnings=("Seam moved around 2 players.",),
    )  # fmt: skip
    relative = ShotRecord(
        index=1, first_frame=first[1], last_frame=last[1], reference_frame=first[1], status="relative",
        reason="zoom_only", sentence="the camera zooms without turning, which no focal length can be read from",
        focal=None, calibration={"s10_px": 1e-9, "chi2_dof": None}, panorama=None, files=(), status_counts=counts[1],
        timings_s={},
    )  # fmt: skip
    return RunRecord(
        versions={"broadcast-mosaic": "0.1.0", "python": "3.11.7", "torch": "2.13.0"},
        config={
            "decode": {"start_frame": 0, "threads": 4},
            "gates": {"chi2_dof_max": 6.0, "known_focal": None},
        },
        clip={
            "path": clip_path,
            "size_px": [WIDTH, HEIGHT],
            "fps": 25.0,
            "duration_s": len(table) / 25,
            "codec": "h264",
        },
        shots=(ok, relative),
        timings_s={"decode": 3.1, "register": 11.7, "refine": 1.9, "composite": 6.4, "report": 0.3},
        warnings=("3 frames could not be decoded.",),
    )


def write_fake_panorama(out: Path, size_px: tuple[int, int] = (4000, 900)) -> Path:
    """A striped panorama.jpg of shot 0 in OUT."""
    path = out / "shot-000" / "panorama.jpg"
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.new("RGB", size_px, (52, 110, 60))
    draw = ImageDraw.Draw(picture)
    for x in range(0, size_px[0], 160):
        draw.rectangle([x, size_px[1] // 3, x + 80, size_px[1]], fill=(64, 130, 70))
    draw.rectangle([0, 0, size_px[0], size_px[1] // 3], fill=(90, 80, 95))
    picture.save(path, "JPEG", quality=85)
    return path


def fake_thumbnails(table: CameraTable, every: int = 50) -> dict[int, bytes]:
    """Small JPEGs, one every `every` frames."""
    thumbnails = {}
    for frame in range(0, len(table), every):
        buffer = io.BytesIO()
        Image.new("RGB", (160, 90), (40, 90 + frame % 120, 60)).save(buffer, "JPEG")
        thumbnails[frame] = buffer.getvalue()
    return thumbnails
