"""``lacli posterior``: sample the posterior by MCMC through the emulators."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lacli.api import posterior as api
from lacli.api.inference import NothingLeft
from lacli.base.errors import LacliError
from lacli.cli.terminal.console import err, one_bar, out, print_json, print_table
from lacli.cli.terminal.tables import BoxFile, Emulators, Fresh, Inputs, Json, Names, Outputs, Seed, fitted, warn

if TYPE_CHECKING:
    from lacli.inference.sampling.posterior import Chain


def command(
    targets_file: Annotated[Path, typer.Option("--targets", help="Targets: mean and sd of each feature (TOML).")],
    inputs: Inputs = None,
    outputs: Outputs = None,
    names: Names = None,
    emulators_file: Emulators = None,
    prior: Annotated[str, typer.Option(help="nroy: uniform on what history matching leaves; box: uniform on the box.")] = "nroy",
    threshold: Annotated[
        float, typer.Option(min=0.1, help="Implausibility from which the nroy prior is zero, and an answer fails.")
    ] = 3.0,
    box_file: BoxFile = None,
    ess: Annotated[float, typer.Option(min=1, help="Effective samples asked for, of every input.")] = 5000,
    rhat: Annotated[float, typer.Option(min=1, help="R-hat asked for.")] = 1.01,
    steps: Annotated[int, typer.Option(min=100, help="Cap of the steps of each walker.")] = 20_000,
    ensembles: Annotated[int, typer.Option(min=2, help="Independent ensembles.")] = 4,
    folder: Annotated[Path, typer.Option("--out", help="Folder of the chain, tables and figures.")] = Path("posterior"),
    fresh: Fresh = False,
    figures: Annotated[bool, typer.Option(help="Draw corner and trace plots.")] = True,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Sample the posterior; a chain in --out made with the same emulators and targets is continued.

    Example: lacli posterior --emulators emulators.npz --targets targets.toml --out posterior
    """
    from lacli.base.files import check_folder
    from lacli.contracts.targets import read_targets
    from lacli.inference.given import box_of
    from lacli.inference.sampling.posterior import Settings

    api.check_prior(prior)
    check_folder(folder)
    targets = read_targets(targets_file)
    emulators, table = fitted(inputs, outputs, names or list(targets.names), emulators_file, seed, box_file)
    settings = Settings(ensembles=ensembles, ess=ess, rhat=rhat, max_steps=steps, seed=seed)
    try:
        with one_bar("steps (tuning first)") as show:
            found = api.posterior(
                emulators, targets, folder, box=box_of(emulators, box_file, table), prior=prior, threshold=threshold,
                settings=settings, fresh=fresh, figures=figures, progress=show,
            )  # fmt: skip
    except NothingLeft as error:
        for text in error.warnings:
            warn(text)
        raise
    chain = found.chain
    if not chain.converged:
        err.print(
            f"Not converged within {steps} steps: R-hat {chain.rhat.max():.3f} (asked {rhat:g}),"
            f" ESS {chain.ess.min():.0f} (asked {ess:.0f})."
            " Run again with a larger --steps to go on from here.", highlight=False, soft_wrap=True,
        )  # fmt: skip
    for text in found.warnings:
        warn(text)
    if as_json:
        print_json(found.document)
    else:
        _show(chain, found.summary, found.folder)
    if found.refused:
        raise LacliError(found.refused)


def _show(chain: Chain, summary: list[dict[str, Any]], folder: Path) -> None:
    from lacli.inference.sampling.posterior import learnt

    print_table(
        f"Posterior ({len(chain.flat()):,} samples, ESS {chain.ess.min():.0f}, R-hat {chain.rhat.max():.3f})",
        ["input", "mean", "sd", "2.5 %", "97.5 %", "most probable", "sd below prior's"],
        [[r["input"], r["mean"], r["sd"], r["low95"], r["high95"], r["map"], learnt(r)] for r in summary],
    )
    out.print(f"Chain, tables and figures in {folder}", highlight=False, soft_wrap=True)
