"""The ``lacli`` program: a command a file, imported only when it is called, so that ``--help`` stays quick."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.base import signals

if TYPE_CHECKING:
    import typer

# command -> one line of help; the function ``command`` in lacli/cli/<name>.py does the work
COMMANDS: dict[str, str] = {
    "doctor": "Find FreeFEM, its plugins, BLAS and gmsh; say what is missing and what installs it.",
    "synthesize": "Write a parametric left atrium from a seed (bundle, label map, motion, targets).",
    "mesh": "Turn a label map or a surface into an anatomy bundle.",
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
    import importlib.util

    return importlib.util.find_spec(f"lacli.cli.{name}") is not None


def build(called: set[str]) -> typer.Typer:
    """The application; only the commands in ``called`` are imported, the others are known by name and help."""
    import importlib

    import typer

    from lacli import __version__

    def tell_version(value: bool) -> None:
        if value:
            typer.echo(f"lacli {__version__}")
            raise typer.Exit()

    version_option = typer.Option(False, "--version", callback=tell_version, is_eager=True, help="Print the version.")

    def root(version: bool = version_option) -> None:
        """Find how stiff each region of a patient's left atrium is."""

    app = typer.Typer(no_args_is_help=True, add_completion=True, rich_markup_mode="rich", callback=root)
    for name, text in COMMANDS.items():
        if not _exists(name):
            continue
        if name in called:
            app.command(name=name, short_help=text)(importlib.import_module(f"lacli.cli.{name}").command)
        else:
            app.command(name=name, short_help=text, help=text)(_unloaded)
    return app


def _unloaded() -> None:
    raise AssertionError("a command was called that was not imported")


def run() -> None:
    """Entry point: expected errors become one message and exit code 1 or 2; tracebacks are for bugs.

    Ctrl-C, SIGTERM and SIGHUP are caught before anything else is imported; they end in one message and exit code 128 + n.
    """
    signals.catch()
    try:
        code = _code_of_the_command()
    finally:
        signals.settle()
    sys.exit(code)


def _code_of_the_command() -> int:
    from lacli.base.errors import LacliError
    from lacli.cli.console import fail

    # completion asks for options of any command, so it sees them all
    completing = any(key.startswith("_") and key.endswith("_COMPLETE") for key in os.environ)
    called = set(COMMANDS) if completing else set(sys.argv[1:]) & set(COMMANDS)
    try:
        try:
            build(called)()
        except SystemExit as ended:
            sys.stdout.flush()  # here, where a full disk can still be told
            return ended.code if isinstance(ended.code, int) else int(bool(ended.code))
    except LacliError as error:
        fail(error)
        return error.exit_code
    except OSError as error:
        from lacli.base.machine import FULL, full_words

        if error.errno in FULL:
            fail(LacliError(full_words(error.filename or _full_place(), error.errno)))
        elif error.filename is None or error.strerror is None:
            raise
        else:
            # a path the system refuses is no bug: no permission, links in a circle, a name too long, a disk that fails
            text = f"{error.filename}: {error.strerror}. Check that this path exists and may be read and written."
            fail(LacliError(text))
        return 1
    return 0


def _full_place() -> str:
    """Where the disk is full, of the places that this call writes to; the system does not always say it."""
    import tempfile

    from lacli.base.machine import full_place
    from lacli.base.native import cache_folder

    said = Path("/proc/self/fd/1").resolve()  # standard output may be a file
    words = [word.partition("=")[2] if word.startswith("--") else word for word in sys.argv[1:]]
    named = [Path(word) for word in words if word and not word.startswith("-")]
    places = [*([said] if said.is_file() else []), *(path for path in named if path.parent.is_dir()), Path.cwd()]
    try:
        places += [Path(tempfile.gettempdir()), cache_folder()]
    except OSError:
        return "the folder of temporary files (TMPDIR)"
    return str(full_place(places) or f"one of {', '.join(map(str, places))}")


if __name__ == "__main__":
    run()
