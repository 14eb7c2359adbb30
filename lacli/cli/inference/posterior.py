"""``lacli posterior``: sample the posterior by MCMC through the emulators."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lacli.base.errors import LacliError, UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table, progress
from lacli.cli.terminal.tables import (
    BoxFile,
    Emulators,
    Fresh,
    Inputs,
    Json,
    Names,
    Outputs,
    Seed,
    box_of,
    covered,
    fitted,
    superseded,
    warn,
)

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
    import pandas as pd

    from lacli.base.files import check_folder, replacing, write_json
    from lacli.contracts.identity import conflict, parse_identity, settle
    from lacli.contracts.targets import read_targets
    from lacli.inference.matching.matching import Region, Wave
    from lacli.inference.matching.nroy import EmptyRegionError
    from lacli.inference.sampling import posterior as mcmc
    from lacli.inference.sampling.arviz_file import write_inference_data
    from lacli.inference.sampling.coverage import TOO_MUCH, WORTH_SAYING, unvisited
    from lacli.inference.sampling.likelihood import Density
    from lacli.inference.sampling.verdict import judge

    if prior not in ("nroy", "box"):
        raise UsageError(f"--prior {prior}: must be nroy or box.")
    check_folder(folder)
    targets = read_targets(targets_file)
    emulators, table = fitted(inputs, outputs, names or list(targets.names), emulators_file, seed, box_file)
    targets = targets.select(emulators.outputs)
    region = Region(box_of(emulators, box_file, table))
    runs = emulators.training_inputs()
    outside = covered(region.box, runs)
    if prior == "nroy":
        region = region.add(Wave(emulators, targets, threshold))
    density = Density(emulators, targets, region)
    settings = mcmc.Settings(ensembles=ensembles, ess=ess, rhat=rhat, max_steps=steps, seed=seed)
    identity = mcmc.chain_identity(density, settings)

    def in_the_way(place: Path) -> str:
        there = place / "chain.npz"
        return conflict(parse_identity(mcmc.load_chain(there).key), identity, "a chain") if there.is_file() else ""

    folder = settle(folder, in_the_way, fresh)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "chain.npz"
    previous = mcmc.load_chain(file) if file.is_file() else None
    superseded(folder, "summary.csv", "summary.json", "posterior.nc", "corner.png", "trace.png")
    with progress() as bar:
        task = bar.add_task("steps (tuning first)", total=steps)

        def keep(chain: mcmc.Chain) -> None:
            mcmc.save_chain(file, chain)
            worst = float(chain.ess.min())
            text = f"ESS {worst:.0f} of {ess:.0f}, R-hat {chain.rhat.max():.3f}" if worst == worst else "steps"
            expected = steps if worst != worst else min(steps, max(chain.steps, int(chain.steps * ess / max(worst, 1.0))))
            bar.update(task, completed=chain.steps, total=expected, description=text)

        try:
            chain = mcmc.sample_posterior(density, settings, previous=previous, keep=keep)
        except EmptyRegionError as error:
            for text in judge(emulators, targets, region.box, error.best, threshold).warnings():
                warn(text)
            raise LacliError(
                "no point of the box agrees with all targets. Check their units and standard deviations, or widen the box."
            ) from error
    best, log_prob = mcmc.maximum(density, chain)
    summary = mcmc.summary(chain, best, density)
    strayed = float(unvisited(chain.flat(), runs).mean())
    verdict = judge(emulators, targets, region.box, best, threshold, chain.flat())
    with replacing(folder / "summary.csv") as temporary:
        pd.DataFrame(summary).to_csv(temporary, index=False)
    write_inference_data(folder / "posterior.nc", chain)
    result: dict[str, Any] = {
        "converged": chain.converged, "steps": chain.steps, "samples": len(chain.flat()), "acceptance": chain.acceptance,
        "rhat": float(chain.rhat.max()), "ess": float(chain.ess.min()), "log_posterior_at_map": log_prob, "inputs": summary,
        "fit": verdict.document(), "outside_runs": {"box": outside, "posterior": strayed},
    }  # fmt: skip
    write_json(folder / "summary.json", result)
    if figures:
        from lacli.report.inference_figures_posterior import corner_figure, trace_figure

        with err.status("drawing"):
            corner_figure(chain, best, region.box, folder / "corner.png")
            trace_figure(chain, folder / "trace.png")
    if not chain.converged:
        err.print(
            f"Not converged within {steps} steps: R-hat {chain.rhat.max():.3f} (asked {rhat:g}),"
            f" ESS {chain.ess.min():.0f} (asked {ess:.0f})."
            " Run again with a larger --steps to go on from here.", highlight=False, soft_wrap=True,
        )  # fmt: skip
    for text in verdict.warnings():
        warn(text)
    if strayed > WORTH_SAYING:
        warn(f"{strayed:.1%} of the posterior lies where no run has been: the emulators extrapolate there.")
    if as_json:
        print_json(result)
    else:
        _show(chain, summary, folder)
    if not verdict.plausible:
        raise LacliError(
            "the most probable point misses a target by more than the threshold, so this posterior tells nothing of the patient."
            " Check the targets' units and standard deviations, or widen the box."
        )
    if strayed > TOO_MUCH:
        raise LacliError("this posterior lies where no run has been. Add runs there, or narrow the box to the runs' ranges.")


def _show(chain: Chain, summary: list[dict[str, Any]], folder: Path) -> None:
    from lacli.inference.sampling.posterior import learnt

    print_table(
        f"Posterior ({len(chain.flat()):,} samples, ESS {chain.ess.min():.0f}, R-hat {chain.rhat.max():.3f})",
        ["input", "mean", "sd", "2.5 %", "97.5 %", "most probable", "sd below prior's"],
        [[r["input"], r["mean"], r["sd"], r["low95"], r["high95"], r["map"], learnt(r)] for r in summary],
    )
    out.print(f"Chain, tables and figures in {folder}", highlight=False, soft_wrap=True)
