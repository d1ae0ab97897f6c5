"""The command `render`: new video from a finished run: stabilised, with an inlay, or a new camera over the panorama."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli_results import AsJson, Out, Quiet, print_json, refuse_settings
from pipelines.errors import EXIT_OK, OutputError

if TYPE_CHECKING:
    from pipelines.progress import Progress
    from pipelines.render.encode import EncodeOptions
    from pipelines.render.job import Rendered
    from pipelines.render.opened import OpenedRun


class What(StrEnum):
    """What is rendered."""

    stabilised = "stabilised"
    overlay = "overlay"
    move = "move"


class To(StrEnum):
    """What a stabilised clip is held to."""

    reference = "reference"
    smooth = "smooth"


class Fill(StrEnum):
    """What the borders of a stabilised clip show."""

    black = "black"
    panorama = "panorama"


class CodecName(StrEnum):
    """How the video is encoded."""

    h264 = "h264"
    hevc10 = "hevc10"
    prores = "prores"


class Space(StrEnum):
    """What the corners of an overlay are given in."""

    frame = "frame"
    panorama = "panorama"
    pan_tilt = "pan-tilt"
    pitch = "pitch"


# A line break in a paragraph would be kept by typer, wherever the terminal's width wraps the words.
EPILOG = (
    "stabilised: every frame as the shot's reference frame sees it, or along the smoothed path (--to smooth).\n\n"
    'overlay: a picture put into the scene, players in front of it. --image board.png --at 120 --corners "610,400 '
    '700,402 705,440 612,438": top left, top right, bottom right, bottom left, in px of frame 120; with --in panorama '
    "px of panorama.tif, with --in pan-tilt degrees, with --in pitch metres (and --clicks, as for `pitch`).\n\n"
    "move: keyframes (CSV or JSON: time_s, pan_deg, tilt_deg, hfov_deg, roll_deg) over the panorama, without the clip."
)


def render(
    context: typer.Context,
    out: Out,
    what: Annotated[What, typer.Option("--what", help="What to render.")],
    path: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Video to write (.mp4, .mov, .mkv); default: OUT/WHAT.mp4 (prores: .mov)."
        ),
    ] = None,
    shot: Annotated[int | None, typer.Option(min=0, help="This shot only; default: the whole clip.")] = None,
    clip: Annotated[
        Path | None, typer.Option(help="Where the clip is now, if it is no longer where it was run.")
    ] = None,
    to: Annotated[
        To, typer.Option(help="stabilised: to the reference frame, or along the smoothed path.")
    ] = To.reference,
    smooth_s: Annotated[
        float, typer.Option(min=0.04, max=60, help="stabilised: sigma of the smoothing, in seconds.")
    ] = 1.0,
    fill: Annotated[Fill, typer.Option(help="stabilised: what the borders show.")] = Fill.black,
    zoom: Annotated[
        float, typer.Option(min=0.1, max=10, help="stabilised: focal length over that of the camera.")
    ] = 1.0,
    image: Annotated[Path | None, typer.Option(help="overlay: the picture, PNG with alpha.")] = None,
    corners: Annotated[
        str, typer.Option(help='overlay: "X,Y X,Y X,Y X,Y", from the top left clockwise.')
    ] = "",
    space: Annotated[
        Space, typer.Option("--in", help="overlay: what the corners are given in.")
    ] = Space.frame,
    at: Annotated[int | None, typer.Option(min=0, help="overlay: the frame whose pixels they are.")] = None,
    clicks: Annotated[
        Path | None, typer.Option(help="overlay: clicked points of the pitch, for --in pitch.")
    ] = None,
    template: Annotated[str, typer.Option(help="overlay: the field whose points the clicks name.")] = "",
    camera: Annotated[
        str,
        typer.Option(
            "--camera", help="overlay: X,Y,Z in m of the camera, if known: two clicks are enough then."
        ),
    ] = "",
    click_px: Annotated[
        float, typer.Option("--click-px", min=0.05, max=50, help="overlay: one-sigma error of a click, px.")
    ] = 1.0,
    opacity: Annotated[float, typer.Option(min=0, max=1, help="overlay: 0 to 1.")] = 1.0,
    in_front: Annotated[
        bool, typer.Option("--in-front", help="overlay: before the players too; needs no panorama.")
    ] = False,
    keys: Annotated[Path | None, typer.Option("--keys", help="move: keyframes, CSV or JSON.")] = None,
    size: Annotated[str, typer.Option(help="move: WxH of the video; default: the clip's.")] = "",
    fps: Annotated[
        float | None, typer.Option(min=1, max=240, help="move: pictures per second; default: the clip's.")
    ] = None,
    sound: Annotated[bool, typer.Option("--sound/--no-sound", help="Copy the clip's sound.")] = True,
    codec: Annotated[
        CodecName,
        typer.Option(help="h264 (8 bits), hevc10 (10 bits) or prores (422 HQ, 10 bits, .mov or .mkv)."),
    ] = CodecName.h264,
    crf: Annotated[
        float, typer.Option(min=0, max=51, help="Quality of H.264 and HEVC; lower is better and larger.")
    ] = 18.0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a file that is there already (never the clip).")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> int:
    """New video from a finished run: stabilised clip, picture in the scene, or a camera move over the panorama."""
    refuse_settings(context, "render")
    _check_options(what, image, corners, keys)
    from pipelines.progress import TerminalProgress
    from pipelines.render.encode import EncodeOptions
    from pipelines.render.opened import open_run

    run = open_run(out)
    target = path or out / f"{what.value}{'.mov' if codec is CodecName.prores else '.mp4'}"
    # In OUT the name says what it is, and a new one takes its place as it does with `run` and `export`.
    if path is not None and path.exists() and not overwrite:
        raise OutputError(path, "is there already", "give another name, or --overwrite")
    encode = EncodeOptions(codec=codec.value, crf=crf)
    with TerminalProgress(show=not quiet) as progress:
        if what is What.stabilised:
            from pipelines.render.stabilise import StabiliseOptions, stabilise

            stabilising = StabiliseOptions(
                to=to.value, smooth_s=smooth_s, fill=fill.value, zoom=zoom, shot=shot, sound=sound, clip=clip
            )
            done = stabilise(run, target, stabilising, encode=encode, progress=progress)
        elif what is What.overlay:
            from pipelines.render.overlay import OverlayOptions, overlay

            assert image is not None  # _check_options
            pitch = None
            if space is Space.pitch:
                from pipelines.cli_pitch import fitted

                pitch = fitted(out, clicks, template, camera, click_px)
            placing = OverlayOptions(
                picture=image, corners=_pairs(corners), space=space.value, at=at, opacity=opacity,
                in_front=in_front, shot=shot, sound=sound, clip=clip, pitch=pitch,
            )  # fmt: skip
            done = overlay(run, target, placing, encode=encode, progress=progress)
        else:
            assert keys is not None  # _check_options
            done = _move(run, target, keys, size, fps, shot, encode, progress)
    if as_json:
        print_json({"exit_code": EXIT_OK, **done.as_dict()})
    elif not quiet:
        print(in_words(done))
    return EXIT_OK


def _check_options(what: What, image: Path | None, corners: str, keys: Path | None) -> None:
    if what is What.overlay and (image is None or not corners):
        raise typer.BadParameter("--what overlay needs --image FILE and --corners")
    if what is What.move and keys is None:
        raise typer.BadParameter("--what move needs --keys FILE with its keyframes")


def _move(
    run: OpenedRun,
    target: Path,
    keys: Path,
    size: str,
    fps: float | None,
    shot: int | None,
    encode: EncodeOptions,
    progress: Progress,
) -> Rendered:
    from pipelines.render.move import MoveOptions, move

    options = MoveOptions(path=keys, size_px=_size(size), fps=fps, shot=shot)
    return move(run, target, options, encode=encode, progress=progress)


def in_words(done: Rendered) -> str:
    """What the command says of a rendered video: a line, and one more for frames that went through."""
    from pipelines.report.words import STATUS_SIGNS, reason_words

    lines = [f"{done.path}: {done.n_frames} frames, {done.size_px[0]}x{done.size_px[1]}, sound: {done.sound}"]
    black = done.facts.get("black_share")
    if black is not None and black >= 0.001:
        lines.append(f"black where nothing was seen: {100 * black:.1f} % of the pixels")
    blind = done.facts.get("unknown_share")
    if blind is not None and blind >= 0.001:
        lines.append(
            f"{100 * blind:.1f} % of the picture lies where the panorama is empty: nobody is kept in front there"
        )
    if done.what == "overlay" and not done.n_changed:
        lines.append("the picture is in none of the frames: look at the corners")
    n = sum(s.last_frame - s.first_frame + 1 for s in done.passed)
    if n:
        first = done.passed[0]
        words = (
            reason_words(first.reason)[0]
            if first.reason
            else STATUS_SIGNS.get(first.status, ("", "no camera"))[1]
        )
        lines.append(
            f"{n} frames went through unchanged, first {first.first_frame} to {first.last_frame}: {words}"
        )
    return "\n".join(lines)


def _pairs(text: str) -> list[tuple[float, float]]:
    try:
        pairs = [tuple(float(part) for part in pair.split(",")) for pair in text.split()]
    except ValueError:
        raise typer.BadParameter(f"--corners is four pairs X,Y, not {text!r}") from None
    if len(pairs) != 4 or any(len(pair) != 2 for pair in pairs):
        raise typer.BadParameter(f"--corners is four pairs X,Y, not {text!r}")
    return [(pair[0], pair[1]) for pair in pairs]


def _size(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise typer.BadParameter(f"--size is WxH, for example 1920x1080, not {text!r}")
    return int(width), int(height)
