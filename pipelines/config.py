"""Every setting of a run: default, unit, reason, range. TOML, run.json and --section.key become one frozen Config.

No stage is imported here, so that listing the settings costs nothing; each stage takes its own section.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from pipelines.errors import ConfigError
from pipelines.exports import formats

# A year at 50 pictures/s has 1.6e9. What counts pictures is bounded, because iterators take no more than 2**63.
MOST_PICTURES = 10**12


class Section(BaseModel):
    """A frozen group of settings; an unknown key is an error, and so are infinities and NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class DecodeOptions(Section):
    """How a file becomes pictures."""

    threads: int = Field(
        default=0,
        ge=0,
        le=64,
        description=(
            "decoder threads; 0 = one on up to two cores (measured fastest there: 98 against 70 "
            "frames/s), else min(4, cores)"
        ),
    )
    queue_frames: int = Field(
        default=4,
        ge=1,
        le=64,
        description=("pictures decoded ahead; 4 hide the decoder's jitter and hold 8 MB at 1080p"),
    )
    deinterlace: Literal["field", "frame", "off"] = Field(
        default="field",
        description=(
            "interlaced sources: one picture a field (the camera moves between fields), one a frame, "
            "or leave combed; film in 60i is put together again with either of the first two"
        ),
    )
    pixel_aspect: float | None = Field(
        default=None,
        gt=0.1,
        lt=10,
        description=("width over height of a pixel; none = what the file says (many SD files say nothing)"),
    )
    image_fps: float = Field(
        default=25.0,
        ge=1e-6,
        le=10000,
        description=("pictures/s given to image sequences, which carry no time; 25 is only a convention"),
    )
    max_side_px: int = Field(
        default=16384,
        ge=16,
        le=65536,
        description=(
            "px; a larger declared width or height is refused before memory is asked for: no camera makes one"
        ),
    )
    stdin_max_gb: float = Field(
        default=64.0,
        gt=0,
        le=10000,
        description=(
            "GB taken from standard input, which is stored beside the results while the run lasts; "
            "64 are two hours at 70 Mbit/s"
        ),
    )
    accept_zero_timecode: bool = Field(
        default=False,
        description=(
            "take 00:00:00:00 at the start as real; MXF and MPEG-2 write it when nobody set one, so false"
        ),
    )


class OverlayOptions(Section):
    """How graphics that are fixed on the screen (scoreboard, logo, letterbox) are found."""

    enabled: bool = Field(
        default=True, description=("look for fixed graphics and keep them out of registration")
    )
    mask_file: str | None = Field(
        default=None,
        description=(
            "picture of the clip's size, white = scene, black = covered, taken instead of what would be found; "
            "none = look for graphics"
        ),
    )
    sample_motion: float = Field(
        default=0.008,
        gt=0,
        le=1,
        description=(
            "widths of the frame that the camera moves between two samples: twelve in 5 degrees; when it rests "
            "everything looks fixed"
        ),
    )
    min_samples: int = Field(
        default=12,
        ge=3,
        description=("samples before anything is masked; with fewer, flat grass passes for fixed"),
    )
    max_std_grey: float = Field(
        default=8.0,
        gt=0,
        le=128,
        description=(
            "grey levels; temporal deviation below which a pixel is fixed (half-transparent logos let "
            "some scene through)"
        ),
    )
    min_gradient_grey: float = Field(
        default=6.0,
        gt=0,
        le=255,
        description=(
            "grey levels per reduced px; edge strength of the mean picture that seeds a graphic: "
            "moving scenes average out"
        ),
    )
    dilate_px: int = Field(
        default=2,
        ge=0,
        le=64,
        description=(
            "px of the full frame added around a graphic: coding noise and anti-aliasing spread that far"
        ),
    )


class PeopleOptions(Section):
    """Where people are, if somebody knows: masks, or a model. Without either, what moves is found by itself."""

    masks: str | None = Field(
        default=None,
        description=(
            "folder or pattern of pictures, one for each picture of the clip: white = people (or whatever else "
            "moves), black = scene; left out of registration, and of the panorama where it can be; none = no masks"
        ),
    )
    model: str | None = Field(
        default=None,
        description=(
            "ONNX file of a person detector or segmenter that finds such masks; needs the extra [people] "
            "(onnxruntime); none = no detector"
        ),
    )
    person_class: int = Field(
        default=0,
        ge=0,
        le=10000,
        description="number of the class 'person': 0 in COCO's 80, 1 in torchvision's and COCO's 91, 15 in VOC",
    )
    least_score: float = Field(default=0.3, gt=0, lt=1, description="score from which a person is one")
    input: Literal["rgb01", "bgr255", "imagenet"] = Field(
        default="rgb01",
        description=(
            "what the model takes: RGB from 0 to 1, BGR from 0 to 255 (YOLOX), or RGB less ImageNet's mean, "
            "over its deviation"
        ),
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.masks is not None and self.model is not None:
            raise ValueError("people.masks and people.model exclude each other")
        return self


class RegistrationOptions(Section):
    """Direct alignment of two frames."""

    n_fine: int = Field(
        default=6000,
        ge=200,
        description=(
            "pixels aligned at full size, best gradient per cell; 13,000 gain 1/6 of the error for 1/3 "
            "more time"
        ),
    )
    n_half: int = Field(
        default=3400, ge=100, description=("pixels aligned at half size, where the codec's noise is lower")
    )
    levels: int = Field(
        default=4,
        ge=2,
        le=8,
        description=(
            "pyramid levels; 4 hold about 21 px of motion at 1080p from a standing start, 5 hold 32"
        ),
    )
    kernel: Literal["numba", "torch"] = Field(
        default="numba",
        description=("numba is three times faster on a CPU; torch is the reference and runs on a GPU"),
    )
    keyframe_shift: float = Field(
        default=0.1,
        gt=0,
        lt=1,
        description=(
            "widths of the frame moved before a new keyframe; each adds pairs of its own noise "
            "(a third less focal error than 0.15), beyond 0.15 lens errors lose the lock"
        ),
    )
    keyframe_zoom: float = Field(
        default=1.15, gt=1, lt=4, description=("zoom ratio to the keyframe before a new one is taken")
    )
    min_overlap: float = Field(
        default=0.4, gt=0, lt=1, description=("share of the frame seen in both; below it a pair is refused")
    )


class CalibrationOptions(Section):
    """What is known of the camera beforehand, and what is estimated."""

    focal_px: float | None = Field(
        default=None,
        ge=1,
        le=1e8,
        description=(
            "px of the frame as decoded: a focal length known from elsewhere; none = self-calibrated"
        ),
    )
    focal_frame: int | None = Field(
        default=None,
        ge=0,
        le=MOST_PICTURES,
        description=("picture at which focal_px holds; none = the reference frame of each shot"),
    )
    focal_std_px: float | None = Field(
        default=None,
        ge=1e-3,
        le=1e8,
        description=(
            "px; one-sigma error of focal_px; none = 2 % of it, about what a lens scale or a pitch fit gives"
        ),
    )
    fix_pp: bool = Field(
        default=False,
        description=(
            "hold the principal point at the middle of the frame; free, it soaks up some parallax (25 "
            "px prior at 1280)"
        ),
    )
    distortion: bool = Field(
        default=True,
        description=(
            "estimate radial distortion as a function of zoom; without it real broadcast focals come "
            "out 40 % short"
        ),
    )
    sensor_width_mm: float | None = Field(
        default=None,
        gt=0,
        le=100,
        description=(
            "mm; only for exports that speak millimetres; none = those say that the scale is nominal"
        ),
    )

    @model_validator(mode="after")
    def _focal_comes_first(self) -> Self:
        if self.focal_px is None and (self.focal_frame is not None or self.focal_std_px is not None):
            raise ValueError("focal_frame and focal_std_px mean nothing without focal_px")
        return self


class ShotOptions(Section):
    """Where one view of the main camera ends."""

    bridge_frames: int = Field(
        default=10,
        ge=1,
        le=250,
        description=(
            "pictures that a failed registration may span and still be one shot (flash, dropped "
            "frame); cuts never recover"
        ),
    )
    min_frames: int = Field(
        default=10,
        ge=2,
        description=(
            "pictures; a shorter run is no shot: too little motion to calibrate and mostly the middle "
            "of a transition"
        ),
    )
    max_frames: int = Field(
        default=12000,
        ge=250,
        description=(
            "pictures; a longer shot is divided, each part calibrated by itself: memory grows by 30 KiB per "
            "picture of a shot"
        ),
    )
    merge: bool = Field(
        default=False,
        description=(
            "shots of one camera (after a replay or cutaway) share one calibration, camera frame and panorama, where "
            "verified pairs show that it is the same camera; run.json says why, or why not"
        ),
    )


class PanoramaOptions(Section):
    """The picture of the whole scene without the players."""

    enabled: bool = Field(default=True, description="make the panorama; it takes a second pass over the clip")
    projection: Literal["auto", "equirectangular", "cylindrical", "planar", "pannini"] = Field(
        default="auto",
        description=(
            "auto = planar below about 50 degrees of view, pannini (upright lines stay straight) to 100, "
            "equirectangular beyond or when it also tilts far"
        ),
    )
    max_megapixels: float = Field(
        default=60.0,
        gt=0.01,
        le=4000,
        description=("megapixels; larger scenes are scaled down; memory and time follow it"),
    )
    crop: Literal["none", "inside"] = Field(
        default="none", description="inside = cut to the largest rectangle that was seen without a gap"
    )
    moments: int = Field(
        default=0,
        ge=0,
        le=99,
        description="panorama-moments.jpg too: the players of so many moments of the shot, evenly over it; 0 = none",
    )
    moment_frames: tuple[int, ...] = Field(
        default=(),
        description="the same of chosen pictures (the nearest ones kept), numbers with commas between",
    )
    views: int = Field(
        default=17,
        ge=3,
        le=99,
        description=(
            "frames whose median makes a pixel; 15 are as good as 50, odd keeps the median a real sample"
        ),
    )

    detail: float = Field(
        default=0.2,
        ge=0,
        le=1,
        description="share of the fine detail that pixels average away and that is given back; 0 = as in the frames",
    )

    @field_validator("moment_frames", mode="before")
    @classmethod
    def _numbers(cls, value: Any) -> Any:
        if value is None:
            return ()
        if isinstance(value, int):
            return (value,)
        return tuple(part for part in value.split(",") if part.strip()) if isinstance(value, str) else value


class OutputOptions(Section):
    """What is written beside the always-written files."""

    parquet: bool = Field(
        default=False, description=("camera.parquet too; needs the extra [parquet] (pyarrow, 170 MB)")
    )
    jpeg_max_width: int = Field(
        default=16384,
        ge=64,
        le=65500,
        description=("px; widest panorama.jpg: many viewers stop at 16384, the format itself at 65500"),
    )
    png: bool = Field(default=False, description="panorama.png too: full resolution, with alpha")
    deepzoom: bool = Field(
        default=False, description="panorama.dzi and its tiles too, for OpenSeadragon and other viewers"
    )
    exports: tuple[str, ...] = Field(
        default=(),
        description=(
            f"exports beside each shot's panorama, names with commas between; of {', '.join(formats.NAMES)}"
        ),
    )

    @field_validator("exports", mode="before")
    @classmethod
    def _names(cls, value: Any) -> Any:
        if value is None:
            return ()
        return formats.parse_names(value) if isinstance(value, str | list | tuple) else value


class RunOptions(Section):
    """The run itself; nothing here changes a result except the range of pictures."""

    threads: int = Field(
        default=0, ge=0, le=256, description=("threads of the numeric kernels; 0 = as many as cores")
    )
    resume: bool = Field(
        default=False, description=("keep the shots that an interrupted run in the same folder finished")
    )
    start_frame: int = Field(
        default=0, ge=0, le=MOST_PICTURES, description="first output picture that is used; counted from 0"
    )
    max_frames: int | None = Field(
        default=None, ge=2, le=MOST_PICTURES, description="pictures used from there; none = to the end"
    )


class Config(Section):
    """The whole configuration, as run.json records it."""

    decode: DecodeOptions = DecodeOptions()
    overlays: OverlayOptions = OverlayOptions()
    people: PeopleOptions = PeopleOptions()
    registration: RegistrationOptions = RegistrationOptions()
    calibration: CalibrationOptions = CalibrationOptions()
    shots: ShotOptions = ShotOptions()
    panorama: PanoramaOptions = PanoramaOptions()
    output: OutputOptions = OutputOptions()
    run: RunOptions = RunOptions()

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """JSON-ready; `Config.model_validate(c.as_dict()) == c`."""
        return self.model_dump(mode="json")

    def as_toml(self) -> str:
        """The same as TOML, each key under its comment; TOML has no null, so keys without a value are commented out."""
        lines: list[tuple[str, str]] = []
        for section, key, field, value in _walk(self):
            if not lines or lines[-1][0] != section:
                lines.append((section, f"\n[{section}]" if lines else f"[{section}]"))
            lines.append((section, f"# {field.description}"))
            lines.append((section, f"{key} = {json.dumps(value)}" if value is not None else f"# {key} ="))
        return "\n".join(line for _, line in lines) + "\n"


def _walk(config: Config) -> Iterable[tuple[str, str, Any, Any]]:
    for section in type(config).model_fields:
        values = getattr(config, section)
        for key, field in type(values).model_fields.items():
            yield section, key, field, getattr(values, key)


def option_names() -> list[str]:
    """Every setting as 'section.key', in the order of the file."""
    return [f"{section}.{key}" for section, key, _, _ in _walk(Config())]


def config_help() -> str:
    """A line or two a setting: option, default, meaning; for `run --help-config`."""
    blocks = []
    for section, key, field, value in _walk(Config()):
        shown = "none" if value is None else json.dumps(value).strip('"')
        blocks.append(f"--{section}.{key} {shown}\n      {field.description}")
    return "\n".join(blocks)


def parse_overrides(args: Iterable[str]) -> dict[str, str]:
    """['--shots.min_frames', '5', '--panorama.enabled=false'] to {'shots.min_frames': '5', ...}; order does not matter.

    Raises ConfigError: not an option, no value behind it, given twice. Values get their type in `load_config`.
    """
    overrides: dict[str, str] = {}
    rest = list(args)
    while rest:
        word = rest.pop(0)
        if not word.startswith("--"):
            raise ConfigError(word, "not an option", "options are --section.key value; see run --help-config")
        name, equals, value = word[2:].partition("=")
        name = name.replace("-", "_")
        if name not in option_names():
            raise ConfigError(
                word, "unknown option", _nearest(f"--{name}", [f"--{n}" for n in option_names()])
            )
        if not equals:
            if not rest or (rest[0].startswith("--") and rest[0][2:3].isalpha()):
                raise ConfigError(word, "has no value", f"write {word} VALUE")
            value = rest.pop(0)
        if name in overrides:
            raise ConfigError(word, "given twice", "leave one of them out")
        overrides[name] = value
    return overrides


def load_config(path: str | Path | None = None, overrides: Mapping[str, str] | None = None) -> Config:
    """Defaults, then the file (TOML, or the run.json of an earlier run), then the overrides of the command line.

    Raises ConfigError: unreadable file, unknown key (names the nearest), impossible value.
    """
    data: dict[str, Any] = _read(Path(path)) if path is not None else {}
    for name, text in (overrides or {}).items():
        section, _, key = name.partition(".")
        # A broken file is reported as such below, not hidden by an override.
        if isinstance(data.setdefault(section, {}), dict):
            data[section][key] = None if text.lower() in ("none", "null", "") else text
    source = str(path) if path is not None else "settings"
    return _validate(data, source, frozenset(overrides or {}))


def _validate(data: Mapping[str, Any], source: str, from_command_line: frozenset[str]) -> Config:
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"])
    what = f"--{name}" if name in from_command_line else f"{source}: {name}" if name else source
    if first["type"] == "extra_forbidden":
        raise ConfigError(what, "unknown key", _nearest(name, option_names() + list(Config.model_fields)))
    cause = first["msg"].removeprefix("Value error, ")
    cure = f"it is {first['input']!r}" if not isinstance(first["input"], dict) else "change one of them"
    raise ConfigError(what, cause, cure if len(cure) < 120 else "see run --help-config")


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors on Windows put a mark before the first line
    except FileNotFoundError:
        raise ConfigError(path, "no such file", "check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(path, f"cannot be read ({error})", "it must be a TOML file or a run.json") from None
    try:
        if path.suffix.lower() != ".json":
            return tomllib.loads(text)
        data = json.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        raise ConfigError(path, f"not valid ({error})", "mend that line") from None
    except (ValueError, RecursionError):  # a number of thousands of digits, brackets thousands deep
        raise ConfigError(path, "not valid (no settings file holds this)", "give another file") from None
    if not isinstance(data, dict) or not isinstance(data.get("config"), dict):
        raise ConfigError(
            path, "holds no configuration", "give a run.json written by broadcast-mosaic, or a TOML file"
        )
    return dict(data["config"])


def _nearest(name: str, known: Iterable[str]) -> str:
    """A cure: the known name that looks most like this one; a bare key also matches with its section left out."""
    known = list(known)
    match = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if not match:
        key = name.rpartition(".")[2]
        by_key = {k.rpartition(".")[2]: k for k in known}
        close = difflib.get_close_matches(key, by_key, n=1, cutoff=0.6)
        match = [by_key[close[0]]] if close else []
    return f"did you mean {match[0]}?" if match else "see run --help-config for all of them"
