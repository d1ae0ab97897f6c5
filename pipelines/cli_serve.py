"""The command `serve`: report and deep-zoom panorama of a finished run in a browser, on this machine only."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from pipelines.cli_results import AsJson, Out, Quiet, print_json, refuse_settings
from pipelines.errors import EXIT_OK

DEFAULT_PORT = 8642


def serve(
    context: typer.Context,
    out: Out,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0: any that is free.")
    ] = DEFAULT_PORT,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> int:
    """The report and the panoramas, zooming deep, in a browser on this machine; Ctrl-C ends it."""
    refuse_settings(context, "serve")
    from pipelines.serve.server import make_server

    with make_server(out, port) as server:
        if as_json:
            print_json(
                {
                    "exit_code": EXIT_OK,
                    "url": server.url,
                    "report": f"{server.url}report",
                    "port": server.server_port,
                }
            )
        elif not quiet:
            print(f"{server.url}  (Ctrl-C ends it)")
        sys.stdout.flush()
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            # This is how it is meant to end.
            if not quiet and not as_json:
                print()
    return EXIT_OK
