"""Pages that are made from the code: scene, commands, features, tables of files, picture of the rooms.

``python docs/generate.py`` writes them, ``--check`` says which are not current (exit code 1).
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
MADE = "<!-- made by docs/generate.py; do not edit -->\n"
ROOMS = {
    "cli": "a command a file: parse, call, print",
    "api": "every verb as one call of Python",
    "cohort": "many patients: table, statistics",
    "report": "figures and tables",
    "calibration": "one patient: waves, posterior, answer",
    "synthetic": "atria and images whose truth is known",
    "verification": "problems with known answers",
    "inference": "design, emulation, matching, posterior",
    "mechanics": "prepare, write, run, read, keep a scene",
    "freefem": "the external program; knows no atrium",
    "motion": "registration, frames, phases, targets",
    "anatomy": "image or surface to wall, regions, fibres",
    "contracts": "what passes between rooms",
    "geometry": "triangles and tetrahedra; no atrium in it",
    "base": "arrays, errors, files, processes",
}


def plain(text: object) -> str:
    """Text as it is for a Markdown cell: what would be a mark is escaped outside of code."""
    parts = str(text).split("`")
    for i in range(0, len(parts), 2):
        for mark in ("\\", "*", "_", "[", "]", "<", ">", "$"):
            parts[i] = parts[i].replace(mark, f"\\{mark}")
    return "`".join(parts).replace("|", "\\|").replace("\n", " ")


def table(columns: list[str], rows: list[list[object]]) -> str:
    """A Markdown table; cells are taken as they are."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join("| " + " | ".join(str(cell) for cell in line) + " |\n" for line in lines) + "\n"


def code(text: object) -> str:
    """Text set as code; nothing for nothing."""
    words = str(text).replace("|", "\\|")
    return f"`{words}`" if words else ""


def scene_page() -> str:
    """Every key of a scene, from its models and the table of parameters."""
    from pydantic import BaseModel

    from lacli.contracts.scene import Scene

    text = (
        MADE
        + "# Scene reference\n\nA scene is a TOML file. Every key but `anatomy.bundle` may be left out; an unknown key is an "
    )
    text += "error.\nA value outside its *possible* range is refused; one outside the *plausible* range is taken, and said.\n"
    for section, field in Scene.model_fields.items():
        model = field.annotation
        assert isinstance(model, type) and issubclass(model, BaseModel)
        text += f"\n## `[{section}]`\n\n{(model.__doc__ or '').strip()}\n\n".replace("``", "`")
        rows = [_key(section, name, item) for name, item in model.model_fields.items()]
        text += table(["key", "default", "unit", "possible", "plausible", "what"], rows)
    return text


def _key(section: str, name: str, item: Any) -> list[object]:
    from lacli.contracts.labels import BODY_REGIONS
    from lacli.contracts.parameters import BY_KEY

    key = f"{section}.{name}"
    quantity = BY_KEY.get(key) or BY_KEY.get(f"{key}.{BODY_REGIONS[0]}")
    if quantity is None:
        default = "required" if item.is_required() else code(_toml(item.default))
        return [code(key), default, "", _choices(item.annotation), "", plain(item.description or "")]
    regional = key not in BY_KEY
    what = quantity.text.removesuffix(f", {BODY_REGIONS[0]}") + (": one number, or one for each region" if regional else "")
    low, high = quantity.possible
    off = "; 0 leaves it out" if quantity.off else ""
    return [
        code(key), code(f"{quantity.default:g}"), quantity.shown_unit, f"{low:g} to {high:g}",
        "{:g} to {:g}".format(*quantity.plausible), plain(what + off),
    ]  # fmt: skip


def _toml(value: Any) -> str:
    if value is None:
        return ""
    return f'"{value}"' if isinstance(value, str) else str(value).lower() if isinstance(value, bool) else str(value)


def _choices(annotation: Any) -> str:
    if get_origin(annotation) is Literal:
        return ", ".join(code(_toml(choice)) for choice in get_args(annotation))
    if annotation is bool:
        return "`true`, `false`"
    if NoneType in get_args(annotation):
        return "pairs of `[time, value]`"
    return "a path" if annotation is Path else ""


def commands_page() -> str:
    """Every command with its arguments and options, from the Typer application."""
    import typer.main

    from lacli.cli import main
    from lacli.cli.commands import commands

    names = list(commands())
    group: Any = typer.main.get_command(main.build(set(names)))
    text = (
        MADE
        + "# Commands\n\nExit codes: 0 done, 1 failed, 2 wrong usage. With `--json`, standard output is one JSON document.\n\n"
    )
    text += table(["command", "what"], [[f"[{name}](#{name})", plain(one.text)] for name, one in commands().items()])
    for name in names:
        command = group.commands[name]
        text += f"\n## {name}\n\n"
        for paragraph in (command.help or "").split("\n\n"):
            lines = " ".join(paragraph.split())
            example = lines.removeprefix("Example: ")
            text += f"```sh\n{example}\n```\n\n" if example != lines else plain(lines) + "\n\n"
        rows = [_option(parameter) for parameter in command.params if parameter.name != "help"]
        text += table(["argument or option", "default", "what"], rows)
    return text


def _option(parameter: Any) -> list[object]:
    option = parameter.param_type_name == "option"
    names = [*parameter.opts, *parameter.secondary_opts] if option else [parameter.metavar or parameter.name.upper()]
    given = parameter.default
    default = "" if given is None or callable(given) else "required" if parameter.required else str(given)
    if parameter.required:
        default = "required"
    shown = default if default in ("", "required") else code(default.lower() if isinstance(given, bool) else default)
    return [", ".join(code(name) for name in names), shown, plain(parameter.help or "")]


def api_page() -> str:
    """Every public name of Python with its signature and docstring, from the code."""
    import inspect

    import lacli
    import lacli.types

    text = MADE + "# Python\n\nWhat a command does is one call, with `progress` and `cancel` as arguments; "
    text += (
        "`examples/api.py` goes the whole way.\nTypes of results and of settings, and what reads files, are in `lacli.types`.\n"
    )
    modules = (lacli, lacli.types)
    found = [(module, name, getattr(module, name)) for module in modules for name in module.__all__ if name != "__version__"]

    def title(module: Any, one: Any) -> str:
        return "Types" if not inspect.isfunction(one) else "Verbs" if module is lacli else "Files"

    for part in ("Verbs", "Files", "Types"):
        text += f"\n## {part}\n"
        for module, name, one in found:
            if title(module, one) != part:
                continue
            text += f"\n### {name}\n\n"
            if inspect.isfunction(one):
                text += f"```python\n{_signature(f'{module.__name__}.{name}', one)}\n```\n\n"
            for paragraph in (inspect.getdoc(one) or "").split("\n\n"):
                text += plain(" ".join(paragraph.replace("``", "`").split())) + "\n\n"
    return text.rstrip() + "\n"


def _signature(name: str, verb: Any) -> str:
    """A verb's call, an argument a line behind the first ones."""
    import inspect

    given = inspect.signature(verb).parameters.values()
    lines = [p.name if p.default is p.empty else f"{p.name}={_shown(p.default)}" for p in given]
    short = f"{name}({', '.join(lines)})"
    return short if len(lines) < 3 else "\n".join([f"{name}(", *(f"    {line}," for line in lines), ")"])


def _shown(value: Any) -> str:
    return f'Path("{value}")' if isinstance(value, Path) else _toml(value) if isinstance(value, str) else repr(value)


def features_page() -> str:
    """Every feature that images and simulations share, from the table of features."""
    from lacli.contracts.features import FEATURES

    text = MADE + "# Features\n\nThe same functions measure image and simulation, on the same curved faces.\n"
    text += "A name may end in `@<time>`, the time as a fraction of the RR interval from end-diastole (ED);\n"
    text += "without it, it stands at end-systole (ES).\n\n"
    text += (
        "Displacements and strains are from ED as imaged, the bundle's shape, which is a simulation's own ED but where the wall\n"
    )
    text += 'has settled from it (`numerics.settle_ed`) or an unloaded shape was sought (`numerics.unloading = "backward"`):\n'
    text += "there they hold what lies between both too. `edv_ml` is of the simulation's own ED.\n\n"
    return text + table(["key", "unit", "definition"], [[code(f.key), f.unit or "-", plain(f.definition)] for f in FEATURES])


def files_page() -> str:
    """The page of files, whose tables between marks are made from the records of what files hold."""
    from lacli.contracts.tables import records

    text = (HERE / "files.md").read_text(encoding="utf-8")
    made = {"manifest": records.MANIFEST, "run": records.RUN, "table": records.TABLE, "targets": records.TARGET}
    for name, fields in made.items():
        rows = [[code(f.key), f.unit or "-", plain(f.text) + ("" if f.always else " (not always there)")] for f in fields]
        head, begin, rest = text.partition(f"<!-- made: {name} -->\n")
        old, end, tail = rest.partition("<!-- end -->\n")
        if not begin or not end or "<!-- made" in old:
            raise ValueError(f"files.md has no place for the table of {name}")
        text = head + begin + "\n" + table(["key", "unit", "what"], rows) + end + tail
    return text


def rooms() -> list[list[str]]:
    """The rooms from top to bottom, those on one floor together, as the contract in pyproject.toml has them."""
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = document["tool"]["importlinter"]["contracts"][0]["layers"]
    return [[name.strip().removeprefix("lacli.") for name in layer.split("|")] for layer in layers]


def uses() -> set[tuple[str, str]]:
    """(room, room it imports), measured in the code."""
    import grimp

    graph = grimp.build_graph("lacli")
    known = {room for floor in rooms() for room in floor}
    pairs = {
        (module.split(".")[1], other.split(".")[1])
        for module in graph.modules if "." in module
        for other in graph.find_modules_directly_imported_by(module) if "." in other
    }  # fmt: skip
    return {(a, b) for a, b in pairs if a != b and {a, b} <= known}


def direct(pairs: set[tuple[str, str]]) -> list[tuple[str, str]]:
    """The arrows that do not follow from others (transitive reduction)."""
    below: dict[str, set[str]] = {}
    for a, b in pairs:
        below.setdefault(a, set()).add(b)

    def reach(room: str) -> set[str]:
        return set().union(*({b} | reach(b) for b in below.get(room, ()))) if below.get(room) else set()

    return sorted((a, b) for a, b in pairs if not any(b in reach(c) for c in below[a] if c != b))


def rooms_picture() -> str:
    """The rooms as an SVG, each above those that it imports."""
    floors = rooms()
    width, height, gap = 300, 40, 24
    place = {}
    for row, floor in enumerate(floors):
        for column, room in enumerate(floor):
            shift = (column - (len(floor) - 1) / 2) * (width + 20)
            place[room] = (340 + shift, 20 + row * (height + gap))
    lines = []
    for a, b in direct(uses()):
        (xa, ya), (xb, yb) = place[a], place[b]
        ya += height
        floors_apart = int((yb - ya) // (height + gap))  # floors between
        side = 1 if xa + xb >= 680 else -1
        bend = 0 if floors_apart <= 0 else side * (width / 2 + 40 + 12 * floors_apart)
        if bend:  # past the boxes between
            x = side * width / 2 - side * 4
            path = f"M{xa + x:g},{ya:g} C{340 + bend:g},{ya + 20:g} {340 + bend:g},{yb - 20:g} {xb + x:g},{yb:g}"
        else:
            path = f"M{xa:g},{ya:g} L{xb:g},{yb:g}"
        lines.append(f'<path d="{path}" fill="none" stroke="#777" marker-end="url(#tip)"/>')
    boxes = [
        f'<rect x="{x - width / 2:g}" y="{y:g}" width="{width}" height="{height}" rx="5" fill="#e8eef5" stroke="#456"/>'
        f'<text x="{x:g}" y="{y + 17:g}" font-weight="bold">{room}</text><text x="{x:g}" y="{y + 33:g}">{ROOMS[room]}</text>'
        for room, (x, y) in place.items()
    ]
    bottom = 20 + len(floors) * (height + gap)
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 680 {bottom}" '
        'font-family="sans-serif" font-size="12" text-anchor="middle">'
        '<rect width="100%" height="100%" fill="white"/>'
        '<defs><marker id="tip" markerWidth="8" markerHeight="8" refX="7" refY="4" orient="auto">'
        '<path d="M0,0 L8,4 L0,8 z" fill="#777"/>'
        "</marker></defs>"
    )
    return "\n".join([head, *lines, *boxes, "</svg>"]) + "\n"


PAGES = {
    "scene.md": scene_page,
    "commands.md": commands_page,
    "features.md": features_page,
    "files.md": files_page,
    "api.md": api_page,
    "rooms.svg": rooms_picture,
}


def main(arguments: list[str]) -> int:
    """Write the pages, or say which are not current."""
    stale = []
    for name, make in PAGES.items():
        file, text = HERE / name, make()
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            stale.append(name)
            if "--check" not in arguments:
                file.write_text(text, encoding="utf-8")
    if stale and "--check" in arguments:
        print(f"not current: {', '.join(stale)}; run: python docs/generate.py")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
