"""The ``lacli`` program: a command a file, imported only when it is called, so that ``--help`` stays quick."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.base.processes import signals
from lacli.cli.commands import commands

if TYPE_CHECKING:
    import typer


def build(called: set[str]) -> typer.Typer:
    """The application; only the commands in ``called`` are imported, the others are known by name and help."""
    import importlib

    import typer

    from lacli import __version__
    from lacli.cli.terminal.plain import application

    def tell_version(value: bool) -> None:
        if value:
            typer.echo(f"lacli {__version__}")
            raise typer.Exit()

    version_option = typer.Option(False, "--version", callback=tell_version, is_eager=True, help="Print the version.")

    def root(version: bool = version_option) -> None:
        """Find how stiff each region of a patient's left atrium is."""

    app = application(no_args_is_help=True, add_completion=True, callback=root)
    for name, one in commands().items():
        if name in called:
            app.command(name=name, short_help=one.text)(importlib.import_module(one.module).command)
        else:
            app.command(name=name, short_help=one.text, help=one.text)(_unloaded)
    return app


def _unloaded() -> None:
    raise AssertionError("a command was called that was not imported")


def run() -> None:
    """Entry point: expected errors become one message and exit code 1 or 2; tracebacks are for bugs.

    Ctrl-C, SIGTERM and SIGHUP are caught before anything else is imported; they end in one message and exit code 128 + n.
    """
    try:
        signals.catch()
        code = _code_of_the_command()
    finally:
        signals.settle()
    signals.leave(code)


def _code_of_the_command() -> int:
    import typer.main

    from lacli.base.errors import LacliError
    from lacli.cli.terminal.console import fail

    warnings.filterwarnings("ignore", category=FutureWarning)  # what libraries plan is for us to read
    # completion asks for options of any command, so it sees them all
    completing = any(key.startswith("_") and key.endswith("_COMPLETE") for key in os.environ)
    known = set(commands())
    called = known if completing else known & set(sys.argv[1:])
    try:
        try:
            with _caches():
                # not the application itself: it would put a hook for uncaught exceptions in the place of ours
                typer.main.get_command(build(called))()
        except SystemExit as ended:
            sys.stdout.flush()  # here, where a full disk can still be told
            return ended.code if isinstance(ended.code, int) else int(bool(ended.code))
    except LacliError as error:
        if not signals.stopping():
            fail(error)
        return error.exit_code
    except BrokenPipeError:
        return 141  # whoever read our output has enough of it
    except OSError as error:
        from lacli.base.processes.machine import FULL, full_words

        if signals.stopping():
            return 1
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


@contextlib.contextmanager
def _caches() -> Iterator[None]:
    """A home that does not exist is not made, by us or by libraries: what they would keep there is kept for this call."""
    home = Path("~").expanduser()
    if "XDG_CACHE_HOME" in os.environ or home.is_dir():
        yield
        return
    import tempfile

    from lacli.base.notes import note

    note(f"the home folder {home} does not exist: compiled code is made anew by each call. Set XDG_CACHE_HOME to keep it.")
    with tempfile.TemporaryDirectory(prefix="lacli-cache-") as folder:
        os.environ |= {"XDG_CACHE_HOME": folder, "MPLCONFIGDIR": folder}
        yield


def _full_place() -> str:
    """Where the disk is full, of the places that this call writes to; the system does not always say it."""
    import tempfile

    from lacli.base.processes.machine import full_place
    from lacli.base.processes.native import cache_folder

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
