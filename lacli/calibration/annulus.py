"""What the error of a tracked mitral annulus does to the features that are held against targets.

Simulations hold the annulus where tracking says. What is wrong there is wrong in all frames at once, for it is a share of the
way that was lost or found: so two runs, with the annulus as tracked and by one standard deviation farther, tell how all features
move with it, and that is an error of the targets that has one size and one sign for all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import InputError, LacliError
from lacli.base.files import write_json
from lacli.contracts.motion import FILE as MOTION
from lacli.contracts.targets import Targets

if TYPE_CHECKING:
    from lacli.calibration.simulator import SceneSimulator
    from lacli.contracts.scene import Scene
    from lacli.inference.box import Box

FILE = "annulus.json"
_DIGITS = 6  # of what is kept: more are the solver's rounding, which would make another calibration of the same runs


def known_share(scene: Scene) -> float:
    """The share of its way that the scene's tracked annulus is known to (a standard deviation); 0 where it is not tracked, or its
    error not known. Raises InputError for a damaged motion; of one that is missing the runs say so."""
    from lacli.motion.annulus import known_error

    if scene.motion.annulus != "bundle" or not (scene.anatomy.bundle / MOTION).is_file():
        return 0.0
    return known_error(scene.anatomy.bundle) or 0.0


def left_out(share: float) -> str:
    """What is said where the error of the annulus is not in a posterior."""
    return f"the tracked annulus is known to {100 * share:.0f} % of its way, which is not in the posterior: it may be too narrow"


def annulus_effects(
    scene: Scene, run: Scene, box: Box, targets: Targets, simulator: Callable[[Scene], SceneSimulator]
) -> tuple[dict[str, float], str]:
    """By target what one standard deviation of the annulus's error changes (its unit), and what is told of it in words; nothing
    where the scene's annulus is not tracked or its error not known.

    Of two runs of ``run`` (the scene, or its cheap companion) in the box's middle, at the mean of what is known of an input.
    Where the scene has no answer there, the words say so. Raises LacliError where the machine ended one, InputError.
    """
    import pandas as pd

    if not (error := known_share(scene)):
        return {}, ""
    middle = (box.lower + box.upper) / 2
    known = {prior.name: prior.mean for prior in targets.priors or () if np.isfinite(prior.mean)}
    told = [known.get(name, at) for name, at in zip(box.names, middle, strict=True)]
    row = pd.DataFrame([np.clip(told, box.lower, box.upper)], columns=list(box.names))
    found = []
    for times in (1.0, 1.0 + error):
        moved = run.motion.model_copy(update={"annulus_times": times * run.motion.annulus_times})
        ((_, outcome),) = simulator(run.model_copy(update={"motion": moved}))(row)
        if outcome.lost:  # it says nothing of the scene: an answer without it would be kept for good
            raise LacliError(
                f"calibrate: a run that tells what the annulus's error changes was ended by the machine ({outcome.kind}): "
                f"{outcome.message} Call again."
            )
        if outcome.status != "done":
            return {}, f"{left_out(error)}. A run that would tell what this changes ended by {outcome.kind} ({outcome.message})"
        found.append(outcome.outputs)
    as_tracked, farther = found
    there = [name for name in targets.names if name in as_tracked and name in farther]
    effects = {name: float(f"{farther[name] - as_tracked[name]:.{_DIGITS}g}") for name in there}
    most = max(effects, key=lambda name: abs(effects[name]) / targets.sd[targets.names.index(name)], default="")
    if not most:
        return {}, ""
    share = abs(effects[most]) / targets.sd[targets.names.index(most)]
    return effects, (
        f"the tracked annulus is known to {100 * error:.0f} % of its way: this is in the targets' errors, most in {most} "
        f"({share:.1f} standard deviations of its own)"
    )


def with_annulus(targets: Targets, effects: Mapping[str, float]) -> Targets:
    """The targets with an error that moves all by these effects (their units) at once."""
    if not any(effects.values()):
        return targets
    signs = np.sign([effects.get(name, 0.0) for name in targets.names])
    return targets.widened({name: abs(value) for name, value in effects.items()}, np.outer(signs, signs))


def write_effects(folder: Path, effects: Mapping[str, float]) -> None:
    """Beside a calibration what its targets were widened by; nothing of an earlier one stays where there is none."""
    if effects:
        write_json(folder / FILE, dict(effects))
    else:
        (folder / FILE).unlink(missing_ok=True)


def read_effects(folder: Path) -> dict[str, float]:
    """What ``write_effects`` left. Raises InputError where it is damaged."""
    if not (folder / FILE).is_file():
        return {}
    told = read_json(folder / FILE, error=InputError)
    if not isinstance(told, dict) or not all(isinstance(value, (int, float)) and np.isfinite(value) for value in told.values()):
        raise InputError(f"{folder / FILE}: not the effects of an annulus's error, a finite number for each target.")
    return {str(name): float(value) for name, value in told.items()}
