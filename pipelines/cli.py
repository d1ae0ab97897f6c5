"""The command line: run, demo, probe, compare; more commands are in cli_results.py. Exit codes, one-line errors,
progress and logging live here only.

Nothing heavy is imported before a command needs it: --help answers without torch, cv2, scipy, av or numpy.
"""

from __future__ import annotations

import io
import logging
import math
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli_logging import set_up_logging
from pipelines.cli_results import complete_names, format_names, print_json, register
from pipelines.cli_runs import RunResult, exit_code
from pipelines.errors import EXIT_INTERRUPTED, EXIT_OK, EXIT_USAGE, InputError, UserError
from pipelines.stills import is_pattern, is_there

if TYPE_CHECKING:
    from pipelines.config import Config

log = logging.getLogger(__name__)

app = typer.Typer(
    name="broadcast-mosaic",
    help="A calibrated camera and a clean panorama from a sports broadcast clip.",
    epilog="Exit codes: 0 all done, 1 some shots failed, 2 wrong usage or unusable input, 130 interrupted.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

# The base class of usage errors; typer brings its own copy of click in some versions and not in others.
_UsageProblem: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

Clips = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Video file, folder of images, pattern like frames/%06d.png or 'frames/*.png', or - for standard input.",
        show_default=False,
    ),
]
ClipList = Annotated[
    Path | None,
    typer.Option("--list", help="Text file with one clip a line; a folder for each, as for several."),
]
Jobs = Annotated[
    int, typer.Option(min=1, max=256, help="Clips at work at the same time, each in a process of its own.")
]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder for the results; made if it is not there.")]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="Settings: a TOML file, or run.json of an earlier run.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Keep the shots that an interrupted run finished.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document on stdout, errors too.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="No progress, no table; errors only.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Say what is going on, on stderr.")]


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code. A user's mistake is one line on stderr, a bug keeps its traceback."""
    given = list(sys.argv[1:] if args is None else args)
    plain, dotted = _split_settings(given)
    as_json = "--json" in plain
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A terminal without the sign for "plus or minus", or a file name that is no text, must not end an hour's run.
        sys.stdout.reconfigure(errors="replace")
    try:
        code = app(args=plain, prog_name="broadcast-mosaic", standalone_mode=False, obj=dotted)
    except UserError as error:
        return _fail(str(error), error.as_dict(), as_json)
    except _UsageProblem as error:
        message = error.format_message() if hasattr(error, "format_message") else str(error)
        if message:  # empty: help was asked for by giving nothing, and has been shown
            cause, cure = _plain(message), f"see {_asked(plain)} --help"
            what = {"kind": "usage", "what": "arguments", "cause": cause, "cure": cure}
            return _fail(f"{cause}{' ' if cause.endswith('?') else '; '}{cure}", what, as_json)
        return EXIT_USAGE
    except (KeyboardInterrupt, typer.Abort):
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED:
        cure = "--resume goes on with the shots that are done"
        what = {"kind": "interrupted", "what": "run", "cause": "interrupted", "cure": cure}
        return _fail(f"interrupted; {cure}", what, as_json, EXIT_INTERRUPTED)
    return int(code or EXIT_OK)


def _plain(message: str) -> str:
    """A usage error on one line, without the words that the libraries put before and around what we say."""
    words = " ".join(message.split()).removeprefix("Invalid value: ").replace(": Value error, ", ": ")
    return words.rstrip(".")


def _asked(plain: Sequence[str]) -> str:
    """The command that the arguments begin with, as it is typed: its --help lists what it takes."""
    first = next((word for word in plain if not word.startswith("-")), "")
    known = {command.name or getattr(command.callback, "__name__", "") for command in app.registered_commands}
    return f"broadcast-mosaic {first}" if first in known else "broadcast-mosaic"


def _fail(line: str, error: Mapping[str, str], as_json: bool, code: int = EXIT_USAGE) -> int:
    print(f"broadcast-mosaic: {line}", file=sys.stderr)
    if as_json:
        print_json({"exit_code": code, "error": dict(error)})
    return code


def _split_settings(args: Sequence[str]) -> tuple[list[str], list[str]]:
    """Arguments without, and with, the settings `--section.key value` or `--section.key=value`, wherever they stand."""
    plain: list[str] = []
    dotted: list[str] = []
    rest = list(args)
    while rest:
        word = rest.pop(0)
        if word == "--":
            return [*plain, word, *rest], dotted
        match = re.match(r"--[A-Za-z][\w-]*\.[\w.-]*(=)?", word)
        if match is None:
            plain.append(word)
            continue
        dotted.append(word)
        if match[1] is None and rest and not re.match(r"-+[A-Za-z]", rest[0]):
            dotted.append(rest.pop(0))
    return plain, dotted


def _settings(
    context: typer.Context, path: Path | None, exports: str = "", merge_shots: bool = False
) -> Config:
    from pipelines.config import load_config, parse_overrides
    from pipelines.exports.formats import format_named

    overrides = parse_overrides(context.obj or [])
    if exports:
        overrides["output.exports"] = ",".join(format_names(exports))
    if merge_shots:
        overrides["shots.merge"] = "true"
    settings = load_config(path, overrides)
    for name in settings.output.exports:
        format_named(name).check()  # a missing extra shows now, not after the hours that a run may take
    return settings


def _show_settings(value: bool) -> None:
    if value:
        from pipelines.config import config_help

        print(config_help())
        raise typer.Exit()


def _show_version(value: bool) -> None:
    if value:
        from importlib import metadata

        try:
            print(metadata.version("broadcast-mosaic"))
        except metadata.PackageNotFoundError:
            print("not installed: used from a checkout")
        raise typer.Exit()


HelpConfig = Annotated[
    bool,
    typer.Option(
        "--help-config",
        callback=_show_settings,
        is_eager=True,
        help="List every setting --section.key, and stop.",
    ),
]


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Say it, and stop.")
    ] = False,
) -> None: ...


# ---- run and demo


@app.command(epilog="Every setting is an option too: --shots.min_frames 5; run --help-config lists them.")
def run(
    context: typer.Context,
    out: Out,
    clips: Clips = None,
    clip_list: ClipList = None,
    jobs: Jobs = 1,
    config: ConfigFile = None,
    export: Annotated[
        str,
        typer.Option(
            help="Exports beside the results, with commas: colmap,usd,chan; `export --help` lists them.",
            autocompletion=complete_names,
        ),
    ] = "",
    merge_shots: Annotated[
        bool,
        typer.Option(
            "--merge-shots",
            help="One camera frame and panorama for shots that one camera took from one place.",
        ),
    ] = False,
    resume: Resume = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    help_config: HelpConfig = False,
) -> int:
    """Camera track, homographies, panorama and report of one clip, or of many (a folder each)."""
    settings = _settings(context, config, export, merge_shots)
    set_up_logging(quiet, verbose)
    if clip_list is not None or len(clips or ()) > 1:
        from pipelines.cli_many import run_clips

        return run_clips(clips or (), clip_list, out, settings, jobs, resume, as_json, quiet, verbose)
    if not clips:
        raise typer.BadParameter("no clip was given: name one, or a file of names with --list")
    return _report(_run_one(clips[0], out, settings, resume, quiet), as_json, quiet)


@app.command()
def demo(
    context: typer.Context,
    out: Out,
    resume: Resume = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> int:
    """The sample clip through `run`, then its truth beside the estimate."""
    settings = _settings(context, None)
    set_up_logging(quiet, verbose)
    clip, truth = sample_clip()
    result = _run_one(clip, out, settings, resume, quiet)
    from pipelines.compare import compare_run, comparison_table

    comparison = compare_run(out, truth)
    code = _report(result, False, quiet or as_json)
    if as_json:
        print_json({"exit_code": code, "clips": [result.as_dict()], "comparison": comparison})
    elif not quiet:
        print(f"\ntruth ({truth}) against estimate:\n{comparison_table(comparison)}")
    return code


def _run_one(clip: Path, out: Path, config: Config, resume: bool, quiet: bool) -> RunResult:
    from pipelines.progress import TerminalProgress

    given: AbstractContextManager[Path] = nullcontext(clip)
    if clip == Path("-"):
        from pipelines.stdin import spooled

        given = spooled(sys.stdin.buffer, out, int(config.decode.stdin_max_gb * 1e9))
    elif not is_there(clip) and not is_pattern(clip):
        # Before the seconds that the heavy imports take.
        raise InputError(clip, "no such file", "check the path")
    from pipelines.run import process

    with TerminalProgress(show=not quiet) as progress, given as path:
        record = process(path, out, config, progress=progress, resume=resume or config.run.resume)
    return RunResult(clip=clip, out=out, record=record)


def sample_clip() -> tuple[Path, Path]:
    """The sample clip and its truth: in assets/ of a checkout, inside the package in a wheel."""
    package = Path(__file__).parent
    for folder in (package / "assets", package.parent / "assets"):
        clip, truth = folder / "sample.mp4", folder / "sample-truth.csv"
        if clip.is_file() and truth.is_file():
            return clip, truth
    raise InputError("sample.mp4", "the sample clip is not installed", "install broadcast-mosaic again")


def _report(result: RunResult, as_json: bool, quiet: bool) -> int:
    code = exit_code([result])
    if as_json:
        print_json({"exit_code": code, "clips": [result.as_dict()]})
        return code
    if not quiet and result.record is not None:
        from pipelines.summary import print_summary

        print_summary(result.out, result.record)
    for line in result.failures():
        print(f"broadcast-mosaic: {line}", file=sys.stderr)
    return code


# ---- probe and compare


@app.command("probe")
def _probe(
    context: typer.Context,
    clip: Annotated[
        Path, typer.Argument(help="As for `run`: a video file, a folder of images, a pattern, or -.")
    ],
    shots: Annotated[
        bool,
        typer.Option(
            "--shots/--no-shots", help="Look for shots and fixed graphics; else read the header only."
        ),
    ] = True,
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Seconds of the clip that are looked at; 0: all of it.")
    ] = 60.0,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> int:
    """What a file is: size, rate, scan, colour, time code; shots and overlays by a quick look."""
    settings = _settings(context, None)
    set_up_logging(quiet, False)
    from pipelines.probe import probe, probe_text
    from pipelines.progress import TerminalProgress

    given: AbstractContextManager[Path] = nullcontext(clip)
    if clip == Path("-"):
        import tempfile

        from pipelines.stdin import spooled

        # Where the results of a run would be stored there is no folder for probe.
        given = spooled(
            sys.stdin.buffer, Path(tempfile.gettempdir()), int(settings.decode.stdin_max_gb * 1e9)
        )
    with TerminalProgress(show=not quiet) as progress, given as path:
        facts = probe(
            path,
            settings,
            shots=shots,
            seconds=seconds if 0 < seconds < math.inf else None,
            progress=progress,
        )
    if as_json:
        print_json({"exit_code": EXIT_OK, **facts})
    else:
        print(probe_text(facts))
    return EXIT_OK


@app.command("compare")
def _compare(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    truth: Annotated[Path, typer.Argument(help="CSV of the true camera, columns as in camera.csv.")],
    as_json: AsJson = False,
) -> int:
    """Errors of a run against a known camera track."""
    if context.obj:
        raise typer.BadParameter(f"compare has no settings, but was given {context.obj[0]}")
    from pipelines.compare import compare_run, comparison_table

    comparison = compare_run(out, truth)
    if as_json:
        print_json({"exit_code": EXIT_OK, **comparison})
    else:
        print(comparison_table(comparison))
    return EXIT_OK


register(app)


if __name__ == "__main__":
    sys.exit(main())
