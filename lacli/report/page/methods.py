"""A methods paragraph of what was really modelled, with citations and versions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lacli.contracts.scene import Scene
from lacli.report.page.references import SHORT


def of_study(version: str, models: Sequence[str]) -> tuple[str, list[str]]:
    """The paragraph on statistics over patients, and the keys that it cites. models: the names of those compared."""
    words = [
        f"Statistics by lacli {version}: paired t-tests between regions with Bonferroni's and Holm's correction"
        f" ({SHORT['Holm1979']}); mixed models with the region as factor and a random intercept a patient, by REML"
        f" ({SHORT['Lindstrom1988']}); the error of posterior means carried by a structural errors-in-variables model where they"
        f" are predictors (its estimate without the bias of first order, {SHORT['Firth1993']}), and as a known variance where"
        " they are responses."
    ]
    keys = ["Holm1979", "Lindstrom1988", "Firth1993"]
    if models:
        words.append(
            f"Models of each patient ({', '.join(models)}) were compared on its emulators by evidence from sequential Monte Carlo"
            f" ({SHORT['DelMoral2006']}) and by PSIS-LOO ({SHORT['Vehtari2017']})."
        )
        keys += ["DelMoral2006", "Vehtari2017"]
    if "pooled" in models:
        words.append(
            "In the pooled model the regions vary about a common level by a standard deviation that is itself not known"
            f" ({SHORT['Gelman2006']})."
        )
        keys.append("Gelman2006")
    return " ".join(words), keys


def of_run(scene: Scene, versions: Mapping[str, Any]) -> tuple[str, list[str]]:
    """The paragraph on a simulation, and the keys that it cites. versions: of the run's manifest."""
    keys = ["Hecht2012", "Roney2019"]
    law = scene.materials.law
    words = [
        f"Quasi-static equilibria of the left atrium were computed with lacli {versions.get('lacli', '')} and FreeFEM"
        f" {versions.get('freefem', '')} ({SHORT['Hecht2012']}), on tetrahedra of order {scene.numerics.order}, in five regions"
        f" from universal atrial coordinates ({SHORT['Roney2019']})."
    ]
    if law == "guccione":
        keys.append("Guccione1991")
        words.append(f"The wall is transversely isotropic ({SHORT['Guccione1991']}), nearly incompressible")
    else:
        words.append(f"The wall follows the law {law}, nearly incompressible")
    words[-1] += f" (bulk modulus {scene.materials.kappa_kpa:g} kPa)."
    loads = scene.loads
    if loads.transient_mmhg is not None:
        words.append("Endocardial pressure follows a given transient.")
    else:
        words.append(_idealised(loads.edp_mmhg, loads.esp_mmhg))
    if scene.numerics.unloading == "prestrain":
        words.append("The image's shape at end-diastole is balanced by a prestrain.")
    elif loads.edp_mmhg > 0:
        keys.append("Bols2013")
        words.append(f"The unloaded state was found by backward displacement ({SHORT['Bols2013']}).")
    return " ".join(words), keys


def _idealised(edp: float, esp: float) -> str:
    return f"Endocardial pressure rises from {edp:g} mmHg at end-diastole to {esp:g} mmHg at end-systole."


def of_calibration(result: Mapping[str, Any]) -> tuple[str, list[str]]:
    """The paragraph on a calibration, and the keys that it cites. result: the document of ``result.json``."""
    if result.get("method") == "sequential":
        return _sequential(result)
    waves = result["waves"]
    runs = sum(int(w["runs"]) for w in waves[-1:])
    names = ", ".join(str(row["input"]) for row in result["posterior"])
    text = (
        f"The inputs {names} were calibrated to {len(result['fit'])} features with one Gaussian-process emulator each,"
        f" {len(waves)} wave{'s' if len(waves) > 1 else ''} of history matching ({SHORT['Vernon2010']}; {runs} runs in the last"
        f" wave's table) and the affine-invariant sampler emcee ({SHORT['ForemanMackey2013']}; {result['samples']} samples kept)."
    )
    return text, ["Vernon2010", "ForemanMackey2013"]


def _sequential(result: Mapping[str, Any]) -> tuple[str, list[str]]:
    names = ", ".join(str(row["input"]) for row in result["posterior"])
    out = result.get("targets_left_out") or ()
    left = f" ({len(out)} more were left out: the runs do not tell them)" if out else ""
    text = (
        f"The inputs {names} were calibrated to {len(result['fit'])} features{left}. {result['runs']} runs, each with the"
        f" derivatives of its features, were made: {result['runs_to_map']} to the most probable point by damped Gauss-Newton"
        f" steps from several starts ({SHORT['Marquardt1963']}), the others where the error of a Gaussian-process emulator of"
        f" values and derivatives ({SHORT['Morris1993']}) mattered most to the posterior; it may move its mean by"
        f" {max(result['emulator_change_sd'].values()):.2f} standard deviations at most. The posterior was sampled with emcee"
        f" ({SHORT['ForemanMackey2013']}; {result['samples']} samples kept). Other modes hold less than"
        f" {max(float(result['probability_elsewhere']), 1e-4):.1g} of its probability, by the emulator over the whole box."
    )
    references = ["Marquardt1963", "Morris1993", "ForemanMackey2013"]
    if (taken := result.get("error_factor")) and taken["value"] > 1.0:
        text += (
            " By the misfit that was left, errors of the model (of discretisation, and discrepancies stated) were taken for"
            f" {taken['value']:.2f} times those stated (95 % interval {taken['low']:.2f} to {taken['high']:.2f})."
        )
    if fidelity := result.get("fidelity"):
        text += (
            f" Of the runs {fidelity['runs']} had the numerics above; the others had cheaper ones and were corrected by these,"
            f" as an autoregressive Gaussian process ({SHORT['Kennedy2000']})."
        )
        references.append("Kennedy2000")
    return text, references
