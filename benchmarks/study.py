"""A synthetic study held against its truth: coverage of the 95 % intervals, and what was claimed of regional against global.

    python benchmarks/study.py COHORT STUDY [--errors]

COHORT is what ``lacli synthesize --cohort N --arm ARM`` wrote, STUDY what ``lacli cohort`` made of it. In the heterogeneous
arm regions that vary about a common level (pooled) should be preferred to one stiffness, in the others (one stiffness
everywhere) they must not be. That regions differ is claimed of a patient where it is strongly preferred, and of the arm where
the study's own table says so of the sum of the patients' log evidence. Regional, with a uniform prior on the box for each
region, is told beside it: it pays for more than moderate differences. Printed last is what is asked, and whether it is met:
coverage of 93 to 97 %, no claim the wrong way round, and of the arm that regions differ where they do. The exit code is 1 for a
claim the wrong way round alone, or where nothing is done that could be judged: few patients may miss the others by chance.
--errors: each patient's scene is also run at the true parameters, and what its numerics change of the truth is held against the
errors stated for them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from lacli.base.documents import read_json
from lacli.cohort.comparison import GLOBAL, POOLED, REGIONAL
from lacli.cohort.files import CONTRASTS
from lacli.contracts.features import parse
from lacli.contracts.scene import load_scene, with_parameters
from lacli.contracts.targets import read_targets
from lacli.mechanics.numerics.stated import with_discretisation
from lacli.mechanics.results import features_at_times
from lacli.mechanics.simulation import run_scene
from lacli.synthetic.cohort import PARTICIPANTS, TRUTHS

LEAST, MOST = 0.93, 0.97  # coverage asked of 95 % intervals


def inside(study: Path, truths: pd.DataFrame) -> pd.DataFrame:
    """By patient (rows, those that are done) and input: whether the truth is in the 95 % interval."""
    rows = {}
    for name, truth in truths.iterrows():
        file = study / str(name) / "calibration" / "result.json"
        if file.is_file():
            posterior = {row["input"]: row for row in read_json(file)["posterior"]}
            rows[name] = {k: r["low95"] <= truth[k] <= r["high95"] for k, r in posterior.items() if k in truth}
    return pd.DataFrame.from_dict(rows, orient="index")


def claims(study: Path, patients: list[str]) -> pd.DataFrame:
    """By patient: log evidence of pooled, and of regional, less that of global with standard errors; the former's verdict."""
    rows = {}
    for name in patients:
        file = study / name / "comparison.json"
        if file.is_file():
            pairs = {(c["model"], c["against"]): c for c in read_json(file)["contrasts"]}
            if (c := pairs.get((POOLED, GLOBAL))) is not None and (other := pairs.get((REGIONAL, GLOBAL))) is not None:
                rows[name] = {
                    "pooled_over_global": c["difference"], "se": c["se"], "verdict": c["verdict"],
                    "regional_over_global": other["difference"], "se_regional": other["se"],
                }  # fmt: skip
    return pd.DataFrame.from_dict(rows, orient="index")


def errors(cohort: Path, patients: list[str]) -> pd.DataFrame:
    """By patient: the least stiffness, and what its numerics do at the true parameters: of all targets, root mean square of the
    true over the stated error, share within twice the stated, and chi^2 by their covariance over their number."""
    rows = {}
    if missing := [name for name in patients if not (cohort / name / "truth.json").is_file()]:
        raise SystemExit(f"--errors: {missing[0]} has no truth.json; patients of `synthesize --cohort` have.")
    for name in patients:
        truth, targets = read_json(cohort / name / "truth.json"), read_targets(cohort / name / "targets.toml")
        times = sorted({time for feature in targets.names if (time := parse(feature)[1]) is not None})
        scene = load_scene(cohort / name / "scene.toml", [f"outputs.times={times}"])
        result = run_scene(with_parameters(scene, truth["parameters"]), cohort / "errors")
        if result.status != "done":
            print(f"{name}: {result.message}")
            continue
        told = {**result.features, **(features_at_times(result.folder)[0] if times else {})}
        wide = with_discretisation(targets, scene)[0]
        assert wide.errors is not None, "the model states errors for all targets"
        error = np.array([told[feature] - truth["features"][feature] for feature in targets.names])
        over = error / np.sqrt(np.diag(wide.errors))
        rows[name] = {
            "least_alpha": min(v for k, v in truth["parameters"].items() if k.startswith("alpha_")),
            "rms_over_stated": np.sqrt((over**2).mean()), "within_twice": (np.abs(over) < 2.0).mean(),
            "chi2_over_number": error @ np.linalg.solve(wide.errors, error) / len(error),
        }  # fmt: skip
    return pd.DataFrame.from_dict(rows, orient="index")


def of_the_sum(study: Path) -> pd.DataFrame:
    """What the study's own table says of each pair of models over all patients; of a single patient there is none."""
    file = study / CONTRASTS
    return pd.read_csv(file) if file.is_file() else pd.DataFrame(columns=["model", "against", "verdict"])


def asked(coverage: float, se: float, no_wrong_claim: bool, wished: str, of_arm: bool) -> str:
    """What is asked of a study, a line each, and whether it is met."""
    covered = LEAST <= coverage <= MOST
    near = "" if covered or not max(LEAST - coverage, coverage - MOST) <= 2 * se else " (within two standard errors of it)"
    rows = (
        (f"coverage of {LEAST:.0%} to {MOST:.0%}", covered, f": {coverage:.1%} ± {se:.1%}{near}"),
        ("no claim the wrong way round", no_wrong_claim, ""),
        (wished, of_arm, ""),
    )
    return "\n".join(f"asked: {what}: {'met' if met else 'NOT MET'}{more}" for what, met, more in rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cohort", type=Path)
    parser.add_argument("study", type=Path)
    parser.add_argument("--errors", action="store_true")
    choice = parser.parse_args()
    truths = pd.read_csv(choice.cohort / TRUTHS, dtype={"participant_id": str}).set_index("participant_id")
    arm = str(pd.read_csv(choice.cohort / PARTICIPANTS)["arm"].iloc[0])
    if choice.errors:
        print(errors(choice.cohort, [str(name) for name in truths.index]).to_string(float_format="{:.2f}".format))
    found = inside(choice.study, truths)
    if found.empty:
        print("no patient is done")
        return 1
    values = found.to_numpy(float)
    by_patient = values.mean(axis=1)
    se = by_patient.std(ddof=1) / np.sqrt(len(by_patient)) if len(by_patient) > 1 else float("nan")
    print(f"{arm}: {len(found)} of {len(truths)} patients done")
    print(f"truths inside 95 % intervals: {int(values.sum())} of {values.size} = {values.mean():.1%} ± {se:.1%}")
    print(found.mean().map("{:.0%}".format).to_string())
    told = claims(choice.study, [str(name) for name in found.index])
    print(told.to_string())
    if told.empty:
        print("no models are compared")
        return 1
    preferred = told[told["verdict"].str.contains("strongly preferred")]
    claimed = preferred["verdict"].str.startswith(POOLED)
    wrong = claimed[claimed != (arm == "heterogeneous")]
    print(f"claims: {len(claimed)} of {len(told)}, the wrong way round: {', '.join(map(str, wrong.index)) or 'none'}")
    contrasts = of_the_sum(choice.study)
    if not contrasts.empty:
        print(contrasts.to_string(index=False))
    words = contrasts.loc[(contrasts["model"] == POOLED) & (contrasts["against"] == GLOBAL), "verdict"]
    of_arm = str(words.iloc[0]) if len(words) else "no contrast can be claimed"
    print(f"the study's own word on {POOLED} against {GLOBAL}: {of_arm}")
    claimed_of_arm = next((model for model in (POOLED, GLOBAL) if of_arm.startswith(f"{model} is strongly preferred")), "none")
    right = (claimed_of_arm == POOLED) == (arm == "heterogeneous")
    wrong_way = claimed_of_arm == (GLOBAL if arm == "heterogeneous" else POOLED)
    wished = (
        "that regions differ is claimed of the arm" if arm == "heterogeneous" else "that regions differ is not claimed of the arm"
    )
    print(asked(float(values.mean()), float(se), not len(wrong) and not wrong_way, wished, right))
    return 1 if len(wrong) or wrong_way else 0


if __name__ == "__main__":
    sys.exit(main())
