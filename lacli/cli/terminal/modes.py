"""Options that would do nothing in the mode in which a command is called: refused, never ignored."""

from __future__ import annotations

from typing import Any

import typer

from lacli.base.errors import UsageError


def refuse(ctx: typer.Context, mode: str, *names: str) -> None:
    """Refuse these options (``--box``) and arguments (``SCENE``) where the call gives them: they would do nothing.

    mode: when they would do nothing, as it ends a sentence (``without --gated``); a switch is named by its first name. A dry
    run is no such mode: it is told of the very call that will be made. Raises UsageError, which names both.
    """
    said = given(ctx, *names)
    if said:
        raise UsageError(f"{', '.join(said)} would do nothing {mode}; leave {'it' if len(said) == 1 else 'them'} out.")


def given(ctx: typer.Context, *names: str) -> list[str]:
    """Those of these options and arguments that the call gives, by the names by which it gives them."""
    known = {_names(parameter)[0]: parameter for parameter in ctx.command.params}
    return [_said(ctx, known[name]) for name in names if _is_given(ctx, known[name])]


def _names(parameter: Any) -> list[str]:
    """An option's names, the long ones first; an argument's as its help shows it."""
    if parameter.param_type_name == "option":
        return sorted(parameter.opts, key=lambda name: not name.startswith("--"))
    return [(parameter.metavar or parameter.name.upper()).strip("[].")]


def _is_given(ctx: typer.Context, parameter: Any) -> bool:
    # by the call itself: what is as its default may have been said all the same
    source = ctx.get_parameter_source(parameter.name)
    return source is not None and source.name == "COMMANDLINE"


def _said(ctx: typer.Context, parameter: Any) -> str:
    """The name by which the call gave it: ``--no-figures`` of a switch that is off."""
    off = ctx.params[parameter.name] is False and parameter.param_type_name == "option" and parameter.secondary_opts
    return str(parameter.secondary_opts[0] if off else _names(parameter)[0])
