"""The posterior in one call: what emulators and targets say of the inputs, sampled by MCMC."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.api.inference import NothingLeft
from lacli.api.progress import Cancel, OnProgress, Stage, check
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.base.arrays import FloatArray
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box
    from lacli.inference.emulation.emulator_set import AnyEmulators
    from lacli.inference.sampling.posterior import Chain, Settings
    from lacli.inference.sampling.verdict import Verdict

FILES = ("summary.csv", "summary.json", "posterior.nc", "corner.png", "trace.png")
IMPLAUSIBLE = (
    "the most probable point misses a target by more than the threshold, so this posterior tells nothing of the patient."
    " Check the targets' units and standard deviations, or widen the box."
)
ELSEWHERE = "this posterior lies where no run has been. Add runs there, or narrow the box to the runs' ranges."


@dataclass(frozen=True)
class Posterior:
    """A posterior's chain, its most probable point (d,) and summary by input, and the folder of its files.

    Values are in the units of the inputs' names. verdict: how well that point meets the targets; document: what
    summary.json holds; warnings: what a user must know of it; refused: why it is no answer, empty where it is one.
    """

    folder: Path
    chain: Chain
    best: FloatArray
    summary: list[dict[str, Any]]
    verdict: Verdict
    document: dict[str, Any]
    warnings: tuple[str, ...]
    refused: str


def posterior(
    emulators: AnyEmulators,
    targets: Targets,
    folder: Path,
    *,
    box: Box | None = None,
    prior: str = "nroy",
    threshold: float = 3.0,
    settings: Settings | None = None,
    fresh: bool = False,
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Posterior:
    """The posterior of the inputs (d) given the targets, sampled through the emulators; a chain in ``folder`` is gone on with.

    Emulators and targets are in the same units; targets of outputs without an emulator are left out. box: ranges of the
    inputs (default: published ranges of known inputs, the runs' ranges of others); prior: ``nroy``, uniform on what history
    matching leaves at ``threshold`` (implausibility, in standard deviations), or ``box``; settings: ensembles, effective
    samples and R-hat asked for, steps at most, seed; fresh: start in a sub-folder where ``folder`` holds another chain.
    Raises NothingLeft, UsageError, LacliError where next to no run lies in the box, StorageError, Cancelled (the steps made
    are kept).
    """
    import numpy as np
    import pandas as pd

    from lacli.base.files import check_folder, replacing, superseded, write_json
    from lacli.contracts.identity import conflict, parse_identity, settle
    from lacli.inference.box import table_box
    from lacli.inference.given import check_logarithms
    from lacli.inference.matching.matching import Region, Wave
    from lacli.inference.matching.nroy import EmptyRegionError
    from lacli.inference.sampling import posterior as mcmc
    from lacli.inference.sampling.arviz_file import write_inference_data
    from lacli.inference.sampling.coverage import check_coverage, extrapolation
    from lacli.inference.sampling.likelihood import Density
    from lacli.inference.sampling.verdict import judge

    check_prior(prior)
    check_folder(folder)
    settings = settings or mcmc.Settings()
    targets = targets.select(emulators.outputs)
    if box is None:
        box = table_box(emulators.inputs, np.vstack(emulators.range()))
    elif box.names != emulators.inputs:
        raise UsageError(f"posterior: the box must hold exactly the inputs {', '.join(emulators.inputs)}, in this order.")
    check_logarithms(emulators, box)
    region = Region(box)
    runs = emulators.training_inputs()
    covered = check_coverage(box, runs)
    if prior == "nroy":
        region = region.add(Wave(emulators, targets, threshold))
    density = Density(emulators, targets, region)
    identity = mcmc.chain_identity(density, settings)

    def in_the_way(place: Path) -> str:
        there = place / "chain.npz"
        return conflict(parse_identity(mcmc.load_chain(there).key), identity, "a chain") if there.is_file() else ""

    folder = settle(folder, in_the_way, fresh)
    check(cancel, "the posterior")
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "chain.npz"
    previous = mcmc.load_chain(file) if file.is_file() else None
    superseded(folder, *FILES)
    steps = settings.max_steps
    stage = Stage("steps (tuning first)", steps, progress, cancel).begin()

    def keep(chain: mcmc.Chain) -> None:
        mcmc.save_chain(file, chain)
        worst = float(chain.ess.min())
        known = np.isfinite(worst)
        words = f"ESS {worst:.0f} of {settings.ess:.0f}, R-hat {chain.rhat.max():.3f}" if known else "steps"
        expected = min(steps, max(chain.steps, int(chain.steps * settings.ess / max(worst, 1.0)))) if known else steps
        stage.name, stage.total = words, expected
        stage.reach(chain.steps)

    said = [text] if (text := covered.words()) else []
    try:
        chain = mcmc.sample_posterior(density, settings, previous=previous, keep=keep)
    except EmptyRegionError as error:
        raise NothingLeft(
            "no point of the box agrees with all targets. Check their units and standard deviations, or widen the box.",
            (*said, *judge(emulators, targets, box, error.best, threshold).warnings()),
        ) from error
    best, log_prob = mcmc.maximum(density, chain)
    summary = mcmc.summary(chain, best, density.region.box, density.targets.priors)
    beyond = extrapolation(covered, chain.flat(), runs)
    verdict = judge(emulators, targets, box, best, threshold, chain.flat())
    with replacing(folder / "summary.csv") as temporary:
        pd.DataFrame(summary).to_csv(temporary, index=False)
    write_inference_data(folder / "posterior.nc", chain)
    document: dict[str, Any] = {
        "converged": chain.converged, "steps": chain.steps, "samples": len(chain.flat()), "acceptance": chain.acceptance,
        "rhat": float(chain.rhat.max()), "ess": float(chain.ess.min()), "log_posterior_at_map": log_prob, "inputs": summary,
        "fit": verdict.document(), "outside_runs": {"box": beyond.box, "posterior": beyond.posterior},
    }  # fmt: skip
    write_json(folder / "summary.json", document)
    if figures:
        from lacli.report.inference_figures_posterior import corner_figure, trace_figure

        stage.of("drawing", 0, 1)
        corner_figure(chain, best, box, folder / "corner.png")
        trace_figure(chain, folder / "trace.png")
    refused = IMPLAUSIBLE if not verdict.plausible else ELSEWHERE if beyond.refused else ""
    return Posterior(folder, chain, best, summary, verdict, document, (*beyond.warnings, *verdict.warnings()), refused)


def check_prior(prior: str) -> None:
    """Raises UsageError where a prior is neither ``nroy`` nor ``box``."""
    if prior not in ("nroy", "box"):
        raise UsageError(f"--prior {prior}: must be nroy or box.")
