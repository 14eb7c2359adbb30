"""``python -m lacli``: the same program as ``lacli``."""

from lacli.cli.main import run

run()
