"""Pictures inside the page: panoramas and thumbnails as data: URIs, frame outlines in the page's pixels.

Bounded: all panoramas together stay under PANORAMA_BYTES and all thumbnails under THUMBNAIL_BYTES, whatever the
number of shots. A picture that cannot be had is a sentence in the page, not a failure of the run.
"""

from __future__ import annotations

import base64
import io
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

from pipelines.records import ShotRecord

MAX_SIDE_PX = 4096
NO_PANORAMA = "no panorama: "  # what such a warning begins with
PANORAMA_BYTES = 5_000_000  # of JPEG, 6.7 MB as base64: the page stays under 15 MB
THUMBNAIL_BYTES = 1_000_000
MAX_OUTLINES = 3000  # frames over all shots; the nearest one to the cursor is drawn
SIDES_PX = (4096, 2896, 2048, 1448, 1024, 724, 512, 362, 256)


def panoramas(out: Path, shots: Sequence[ShotRecord]) -> dict[int, dict[str, Any]]:
    """Shot -> its panorama for the page: {uri, size_px, full_px, href, outlines} or {why: sentence}.

    The largest side of SIDES_PX at which all pictures fit into PANORAMA_BYTES is used for all.
    """
    files = {shot.index: panorama_file(out, shot) for shot in shots}
    # A guess from typical JPEG sizes saves encoding everything at 4096 px first when there are many shots.
    n = max(1, sum(path.is_file() for path in files.values()))
    guess = MAX_SIDE_PX * math.sqrt(min(1.0, 6 / n))
    encoded: dict[int, dict[str, Any]] = {}
    for side in [side for side in SIDES_PX if side <= guess] or SIDES_PX[-1:]:
        encoded = {index: encode_panorama(path, side) for index, path in files.items()}
        if sum(len(entry.get("jpeg", b"")) for entry in encoded.values()) <= PANORAMA_BYTES:
            break
    every = max(1, math.ceil(sum(len(outlines_of(shot)) for shot in shots) / MAX_OUTLINES))
    for shot in shots:
        entry = encoded[shot.index]
        if "jpeg" not in entry:
            entry["why"] = str((shot.panorama or {}).get("reason") or stated_reason(shot) or entry["why"])
            continue
        entry["uri"] = data_uri(entry.pop("jpeg"))
        entry["href"] = files[shot.index].relative_to(out).as_posix()
        entry["outlines"] = scaled_outlines(shot, entry, every)
    return encoded


def stated_reason(shot: ShotRecord) -> str:
    """Why the run made no panorama, from its warning; '' where it has none."""
    said = (warning for warning in shot.warnings if warning.startswith(NO_PANORAMA))
    return next(said, "").removeprefix(NO_PANORAMA)


def panorama_file(out: Path, shot: ShotRecord) -> Path:
    """Where a shot's panorama.jpg is: named among its files, else where a run writes it."""
    named = [name for name in shot.files if Path(name).name == "panorama.jpg"]
    return out / (named[0] if named else f"shot-{shot.index:03d}/panorama.jpg")


def encode_panorama(path: Path, side_px: int) -> dict[str, Any]:
    """{jpeg, size_px, file_px}, at most side_px on the longer side; or {why}."""
    if not path.is_file():
        return {"why": "no panorama was written for this shot"}
    try:
        with warnings.catch_warnings():
            # Our own file, at most 16384 px wide: large, but no decompression bomb.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as opened:
                file_px = opened.size
                opened.draft("RGB", (side_px, side_px))  # decodes a big JPEG at 1/2, 1/4 or 1/8 at once
                picture = opened.convert("RGB")
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        return {"why": f"{path.name} cannot be read: {error}"}
    scale = min(1.0, side_px / max(file_px))
    size_px = (max(1, round(file_px[0] * scale)), max(1, round(file_px[1] * scale)))
    if picture.size != size_px:
        picture = picture.resize(size_px, Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=82, optimize=True, progressive=True)
    return {"jpeg": buffer.getvalue(), "size_px": list(size_px), "file_px": list(file_px)}


def outlines_of(shot: ShotRecord) -> Mapping[Any, Any]:
    return (shot.panorama or {}).get("outlines") or {}


def scaled_outlines(shot: ShotRecord, entry: Mapping[str, Any], every: int) -> dict[str, list[list[float]]]:
    """Frame -> outline in the page's picture pixels: every `every`-th frame, whole outlines only.

    Outlines come in pixels of the full panorama (panorama.tif), whose size shot.panorama states as 'size_px' or
    'size' [w, h]; where it states none, of panorama.jpg. Pixel centres at whole numbers, as everywhere.
    """
    stated = (shot.panorama or {}).get("size_px") or (shot.panorama or {}).get("size") or entry["file_px"]
    sx, sy = (page / full for page, full in zip(entry["size_px"], stated, strict=True))
    kept = {}
    for frame, outline in list(sorted(outlines_of(shot).items(), key=lambda item: int(item[0])))[::every]:
        known = [p for p in outline or () if p and None not in p and all(math.isfinite(c) for c in p)]
        if len(known) >= 3 and len(known) == len(outline):
            kept[str(frame)] = [[round((x + 0.5) * sx, 1), round((y + 0.5) * sy, 1)] for x, y in known]
    return kept


def thumbnail_uris(thumbnails: Mapping[int, bytes]) -> dict[int, str]:
    """Frame -> data: URI, thinned evenly until all are within THUMBNAIL_BYTES."""
    frames = sorted(thumbnails)
    total = sum(len(thumbnails[frame]) for frame in frames)
    step = max(1, math.ceil(total / THUMBNAIL_BYTES))
    return {frame: data_uri(thumbnails[frame]) for frame in frames[::step]}


def data_uri(picture: bytes) -> str:
    """data: URI of a JPEG, PNG or WebP. Raises ValueError: neither of them."""
    if picture[:3] == b"\xff\xd8\xff":
        kind = "jpeg"
    elif picture[:8] == b"\x89PNG\r\n\x1a\n":
        kind = "png"
    elif picture[:4] == b"RIFF" and picture[8:12] == b"WEBP":
        kind = "webp"
    else:
        raise ValueError(f"picture is neither JPEG, PNG nor WebP: begins with {picture[:8]!r}")
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"
