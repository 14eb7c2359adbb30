"""The ``lacli`` program: a command a file, imported only when it is called, so that ``--help`` stays quick."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable

import typer

from lacli import __version__
from lacli.base.errors import LacliError
from lacli.cli.console import fail

# command -> one line of help; the function ``command`` in lacli/cli/<name>.py does the work
COMMANDS: dict[str, str] = {
    "doctor": "Find FreeFEM, its plugins, BLAS and gmsh; say what is missing and what installs it.",
    "synthesize": "Write a parametric left atrium from a seed (bundle, label map, motion, targets).",
    "mesh": "Turn a label map or a surface into an anatomy bundle.",
    "track": "Track a gated CT: motion, transients, targets with covariance.",
    "fat": "Segment epicardial fat in a CT volume; volume per region and its mesh.",
    "simulate": "Run a scene: features, transients, fields, pictures.",
    "verify": "Run the verification problems: computed, reference, error.",
    "tradeoff": "Measure speed against accuracy on your scene and machine.",
    "design": "Choose the parameter sets of the next runs, and run them.",
    "emulate": "Fit and check one Gaussian-process emulator per output.",
    "sensitivity": "Rank the inputs by Sobol' indices through the emulators.",
    "match": "History matching: rule out parameters, sample what is left.",
    "posterior": "Sample the posterior by MCMC through the emulators.",
    "calibrate": "All inference steps for one patient, resumable.",
}


def _exists(name: str) -> bool:
    return importlib.util.find_spec(f"lacli.cli.{name}") is not None


def build(called: set[str]) -> typer.Typer:
    """The application; only the commands in ``called`` are imported, the others are known by name and help."""
    app = typer.Typer(no_args_is_help=True, add_completion=True, rich_markup_mode="rich", callback=_root)
    for name, text in COMMANDS.items():
        if not _exists(name):
            continue
        if name in called:
            app.command(name=name, short_help=text)(_interruptible(importlib.import_module(f"lacli.cli.{name}").command))
        else:
            app.command(name=name, short_help=text, help=text)(_unloaded)
    return app


class _Interrupted(LacliError):
    exit_code = 130


def _interruptible(command: Callable[..., None]) -> Callable[..., None]:
    """Ctrl-C as an error of ours: what Typer makes of it changes with its version."""

    @functools.wraps(command)
    def call(*arguments: object, **options: object) -> None:
        try:
            command(*arguments, **options)
        except KeyboardInterrupt as error:
            raise _Interrupted("interrupted. What was finished is kept; run the same command again to go on.") from error

    return call


def _unloaded() -> None:
    raise AssertionError("a command was called that was not imported")


def _version(value: bool) -> None:
    if value:
        typer.echo(f"lacli {__version__}")
        raise typer.Exit()


def _root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    """Find how stiff each region of a patient's left atrium is."""


def run() -> None:
    """Entry point: expected errors become one message and exit code 1 or 2; tracebacks are for bugs."""
    # completion asks for options of any command, so it sees them all
    completing = any(key.startswith("_") and key.endswith("_COMPLETE") for key in os.environ)
    called = set(COMMANDS) if completing else set(sys.argv[1:]) & set(COMMANDS)
    try:
        build(called)()
    except LacliError as error:
        fail(error)
        sys.exit(error.exit_code)
    except OSError as error:
        if error.errno == 28:
            sys.stderr.write(f"lacli: the disk is full ({error.filename or 'unknown file'}). Free some space and run again.\n")
            sys.exit(1)
        if error.filename is None or error.strerror is None:
            raise
        # a path the system refuses is no bug: no permission, links in a circle, a name too long, a disk that fails
        fail(LacliError(f"{error.filename}: {error.strerror}. Check that this path exists and may be read and written."))
        sys.exit(1)
