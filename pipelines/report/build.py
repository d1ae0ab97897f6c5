"""report.html: the records of a run, told in one page that opens offline and asks nobody for anything.

Text and tables are HTML and read without scripts; curves, strip and outlines are drawn by template/page.js from one
block of JSON. Everything from outside (clip names, reasons, configuration) passes jinja2's autoescape or the JSON
block, never a script.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from pipelines.film import NAME as FILM
from pipelines.film import read_film
from pipelines.records import CameraTable, RunRecord, ShotRecord
from pipelines.report import words
from pipelines.report.graph import registration_graph
from pipelines.report.pictures import NO_PANORAMA, data_uri, panoramas, thumbnail_uris
from pipelines.report.series import series_json
from pipelines.report.verdict import verdict_rows

# What a number of the calibration's verdict says, where its name alone does not (calibration.md 7, in readers' words).
CALIBRATION_NOTES = {
    "s10_px": "by how much the clearest pair of pictures would change if the focal length were 10 % off: "
    "too little, and no focal length is claimed",
    "chi2_dof": "misfit against the expected noise: 1 is ideal, 2 to 4 usual on broadcast clips, above 6 refused",
    "sigma_log_f_total": "one-sigma error of the focal length, everything included",
    "n_keyframes": "pictures that the camera was solved from",
    "n_edges": "pairs of pictures that were aligned against each other",
    "over_height": "how far the lens's pupil lies in front of the pan axis, over the axis' height above the pitch",
    "over_stand": "the same over the distance of the stand",
    "focal_change": "what taking the pupil's parallax out did to the focal length",
    "share_of_frame": "rolling shutter: time from reading the first row to the last, over the time between pictures",
    "first_row_px": "rolling shutter: how far it moves the first row of the fastest picture",
    "support_rows": "rows of the picture that carry the evidence",
}
# What the sentence above the verdict's table says already.
ALREADY_SAID = ("claims_focal", "reason", "sentence")
UNITS = {"_px": " px", "_deg": "°", "_s": " s"}  # by the end of a name


def write_report(
    out: Path, run: RunRecord, table: CameraTable, thumbnails: Mapping[int, bytes] | None = None
) -> Path:
    """Write OUT/report.html by write-then-rename and return its path.

    out: the run's folder; the panorama.jpg and the film of its shots are read from it. thumbnails: frame number to a
    small JPEG, PNG or WebP, for shots without a film. Raises OSError: not writable; ValueError: a thumbnail is none
    of these, a record is not JSON-ready.
    """
    page = render(out, run, table, with_film(out, run.shots, thumbnails or {}))
    path = out / "report.html"
    part = out / f".report.html.{os.getpid()}.part"
    try:
        # A file name on disk may be no text at all: what is none is shown as ?.
        part.write_text(page, encoding="utf-8", errors="replace")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path


def render(out: Path, run: RunRecord, table: CameraTable, thumbnails: Mapping[int, bytes]) -> str:
    """The page as text."""
    environment = Environment(
        loader=PackageLoader("pipelines.report", "template"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = breakable
    pictures = panoramas(out, run.shots)
    uris = thumbnail_uris(thumbnails)
    data = series_json(table) | {
        "signs": {word: sign for word, (sign, _) in words.STATUS_SIGNS.items()},
        "reason_words": {code: words.reason_words(code)[0] for code in sorted(set(table.reason)) if code},
        "thumbnails": {str(frame): uri for frame, uri in uris.items()},
        "outlines": {
            str(index): entry["outlines"] for index, entry in pictures.items() if "outlines" in entry
        },
    }
    resources = files("pipelines.report")
    return environment.get_template("page.html.j2").render(
        clip=run.clip,
        name=clip_name(run.clip),
        run=run,
        clip_line=clip_line(run.clip),
        seen=words.seen(run, table),
        troubles=words.troubles(run.shots, table),
        merging=words.merging(run.extra.get("merging") or {}),
        merged_pictures=[
            name
            for group in (run.extra.get("merging") or {}).get("groups", ())
            for name in group["files"]
            if name.endswith("panorama.jpg")
        ],
        shots=[
            shot_view(
                out, shot, table, thumbnails, pictures[shot.index], (run.clip.get("size_px") or [None])[0]
            )
            for shot in run.shots
        ],
        failed=[shot.index for shot in run.shots if shot.status == "failed"],
        statuses=status_counts(table),
        signs=words.STATUS_SIGNS,
        timings=timing_rows(run, len(table)),
        clip_rows=list(flat(run.clip)),
        config_rows=list(flat(run.config)),
        version_rows=list(flat(run.versions)),
        extra_rows=list(flat({k: v for k, v in run.extra.items() if k != "merging"})),
        n_drawn=len(data["row"]),
        n_frames=len(table),
        data=script_json(data),
        page_css=Markup(resources.joinpath("template/page.css").read_text(encoding="utf-8")),
        page_js=Markup(resources.joinpath("template/page.js").read_text(encoding="utf-8")),
        chart_css=Markup(resources.joinpath("vendor/uPlot.min.css").read_text(encoding="utf-8")),
        chart_js=Markup(resources.joinpath("vendor/uPlot.iife.min.js").read_text(encoding="utf-8")),
    )


def with_film(out: Path, shots: Sequence[ShotRecord], thumbnails: Mapping[int, bytes]) -> Mapping[int, bytes]:
    """The thumbnails, with those of a shot that has a film of its own in colour replaced by it."""
    shown = dict(thumbnails)
    for shot in shots:
        if film := read_film(out / f"shot-{shot.index:03d}" / FILM):
            inside = range(shot.first_frame, shot.last_frame + 1)
            shown = {frame: jpeg for frame, jpeg in shown.items() if frame not in inside} | film
    return shown


def script_json(data: Any) -> Markup:
    """JSON that stands inside <script>: no NaN, and no '<', so that no text can close or open a tag."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    return Markup(text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029"))


def breakable(name: str) -> Markup:
    """A dotted name that may be broken behind its dots and underscores, and nowhere within a word."""
    return Markup(str(escape(name)).replace("_", "_<wbr>").replace(".", ".<wbr>"))


def clip_name(clip: Mapping[str, Any]) -> str:
    return Path(str(clip.get("path") or clip.get("name") or "clip")).name


def clip_line(clip: Mapping[str, Any]) -> str:
    """'1280 × 720, 25 frames/s, 32.6 s, h264' of what is known."""
    parts = []
    if size := clip.get("size_px"):
        parts.append(f"{size[0]} × {size[1]} pixels")
    if fps := clip.get("fps"):
        parts.append(f"{float(fps):g} frames/s")
    if duration := clip.get("duration_s"):
        parts.append(f"{float(duration):.1f} s")
    if codec := clip.get("codec"):
        parts.append(str(codec))
    if clip.get("interlaced"):
        parts.append("interlaced")
    return ", ".join(parts)


def shot_view(
    out: Path,
    shot: ShotRecord,
    table: CameraTable,
    thumbnails: Mapping[int, bytes],
    picture: Mapping[str, Any],
    width_px: float | None,
) -> dict[str, Any]:
    """A shot as the template shows it: words, table cells, verdict rows, panorama."""
    facts = words.shot_facts(table, shot.index)
    rows = np.flatnonzero(table.shot == shot.index)
    times = table.pts_s[rows]
    times = times[np.isfinite(times)]
    middle = (shot.first_frame + shot.last_frame) / 2
    inside = [frame for frame in thumbnails if shot.first_frame <= frame <= shot.last_frame]
    nearest = min(inside, key=lambda frame: abs(frame - middle), default=None)
    sign, meaning = words.SHOT_SIGNS.get(shot.status, ("?", ""))
    return {
        "record": shot,
        "facts": facts,
        "sign": sign,
        "meaning": meaning,
        "found": words.found(shot, facts),
        "why": words.why(shot) if shot.status != "ok" else "",
        "cure": words.reason_words(shot.reason)[1] if shot.reason else "",
        "time": f"{times[0]:.2f} to {times[-1]:.2f} s" if len(times) else "",
        "focal": words.focal_words(facts),
        "zoom": words.zoom_words(facts),
        "pan": words.range_words(facts.pan_range_deg, "°"),
        "tilt": words.range_words(facts.tilt_range_deg, "°"),
        "thumbnail": Markup(data_uri(thumbnails[nearest])) if nearest is not None else "",
        "thumbnail_frame": nearest,
        "verdict": verdict_rows(
            shot.calibration, facts.f_range and (facts.f_range[0][0], facts.f_range[1][0]), width_px
        ),
        "calibration": [
            (key, text, CALIBRATION_NOTES.get(key.rpartition(".")[2], ""))
            for key, text in flat(
                {key: value for key, value in shot.calibration.items() if key not in ALREADY_SAID},
                percent=("focal_change", "sigma_log_f", "sigma_parts", "sigma_mean_log_f", "sigma_relative"),
            )
        ],
        "graph": registration_graph(
            out / f"shot-{shot.index:03d}" / "pairs.npz", shot.calibration.get("keyframes") or ()
        ),
        "panorama": picture,
        "panorama_rows": list(flat({k: v for k, v in (shot.panorama or {}).items() if k != "outlines"})),
        "files": words.listed_files(shot.files),
        # Said above, in the panorama's place.
        "warnings": [w for w in shot.warnings if "uri" in picture or not w.startswith(NO_PANORAMA)],
        "timings": [(stage, f"{seconds:.2f} s") for stage, seconds in shot.timings_s.items()],
    }


def status_counts(table: CameraTable) -> list[tuple[str, str, str, int]]:
    """(status, sign, meaning, frames) of every status of the run, good to bad."""
    counts = words.ordered_counts(table.status, tuple(words.STATUS_SIGNS))
    return [(word, *words.STATUS_SIGNS.get(word, ("?", "")), count) for word, count in counts.items()]


def timing_rows(run: RunRecord, n_frames: int) -> list[dict[str, Any]]:
    """Seconds per stage, longest first, as share of the longest, and the frames/s that a stage alone would reach."""
    longest = max(run.timings_s.values(), default=0.0)
    return [
        {
            "stage": stage.replace("_", " "),
            "seconds": f"{seconds:.2f}",
            "percent": f"{100 * seconds / longest:.1f}" if longest > 0 else "0",
            "fps": words.number(n_frames / seconds) if seconds > 0 and n_frames else "",
        }
        for stage, seconds in sorted(run.timings_s.items(), key=lambda item: -item[1])
    ]


def flat(value: Any, prefix: str = "", percent: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Nested JSON-ready mappings as ('a.b', text) rows; numbers below a key that starts with `percent` in per cent."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from flat(inner, f"{prefix}.{key}" if prefix else str(key), percent)
        return
    # A part of an error budget that is named in px (calib's systematic_px) is not a share.
    in_percent = not prefix.endswith("_px") and any(
        part.startswith(name) for part in prefix.split(".") for name in percent
    )
    unit = next((sign for end, sign in UNITS.items() if prefix.endswith(end)), "")
    text = text_of(value, in_percent=in_percent)
    yield prefix, text + unit if isinstance(value, float | int) and not isinstance(value, bool) else text


def text_of(value: Any, *, in_percent: bool = False) -> str:
    """A JSON value for a reader; a long list is cut, and says so."""
    if value is None:
        return "not known"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{words.number(100 * float(value))} %" if in_percent else f"{float(value):.6g}"
    if isinstance(value, list | tuple):
        shown = ", ".join(text_of(item, in_percent=in_percent) for item in value[:16])
        return f"{shown}, … ({len(value)} in all)" if len(value) > 16 else shown or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {text_of(inner)}" for key, inner in value.items())
    return str(value) or "none"
