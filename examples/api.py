# %% [markdown]
# From a synthetic atrium to a posterior, in Python: `python examples/api.py [FOLDER]`, or cell by cell in a notebook.
#
# Sizes are coarse and runs few, so that all of it takes minutes. In earnest: an anatomy of your own (`lacli.mesh`), its
# motion (`lacli.track`), cells of 3.5 mm with 10 nodes, nine inputs, 200 runs; or `lacli.calibrate`, which finds the
# posterior from at most 60 runs that tell their derivatives.

# %%
import sys
from pathlib import Path

import numpy as np

import lacli
import lacli.types

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "results/api")


def say(event: lacli.Progress) -> None:
    """Every call tells how far it is; ``cancel``, a function that returns True, ends it in good order."""
    left = "" if event.left_s is None else f", {event.left_s:.0f} s left"
    print(f"{event.stage}: {event.done:.3g} of {event.total:.3g}{left}", file=sys.stderr)


# %% [markdown]
# An atrium from a seed: its wall with regions and fibres, and the motion of its mitral annulus.

# %%
(atrium,) = lacli.synthesize(folder / "atrium", seed=3, cell_size_mm=8.0, order=1, progress=say)
print(f"cavity {atrium.report['cavity_volume_ml']:.1f} mL, {atrium.report['cells']} cells")

# %% [markdown]
# A scene says what is simulated. The roof is twice as stiff as the other regions: that is what is to be found again.

# %%
(folder / "scene.toml").write_text(
    """\
[anatomy]
bundle = "atrium"

[materials]
alpha = 1.0

[loads]
edp_mmhg = 6.0
esp_mmhg = 18.0

[motion]
annulus = "axial"
amplitude_mm = 6.0

[numerics]
order = 1

[outputs]
unloaded = false
fields = "none"
""",
    encoding="utf-8",
)
scene = lacli.types.load_scene(folder / "scene.toml", ["materials.alpha.roof=2.0"])
truth = {"alpha_roof": 2.0, "alpha_posterior": 1.0}

# %% [markdown]
# One simulation. It is kept by its content: the same scene is not run twice.

# %%
run = lacli.simulate(scene, store=folder / "runs", progress=say)
measured = {name: run.features[name] for name in ("d_global_mm", "d_roof_mm", "d_posterior_mm")}
print(", ".join(f"{name} {value:.2f}" for name, value in measured.items()))

# %% [markdown]
# Many simulations: a design that fills the box of two inputs, and its runs. A second call goes on with what is there.

# %%
box = lacli.types.make_box(list(truth), [0.5, 0.5], [4.0, 4.0])
runs = lacli.design(folder / "runs.csv", scene=scene, count=20, box=box, store=folder / "runs", progress=say)
print(f"{len(runs.x) - runs.failed} of {len(runs.x)} runs finished")

# %% [markdown]
# Emulators of the features, with the scores of their cross-validation.

# %%
table = lacli.types.read_one(runs.table, box.names, list(measured))
made = lacli.emulate(table, box=box, progress=say)
for score in made.scores:
    print(f"{score.output}: R2 {score.r2:.4f}, within two standard deviations {score.ise:.0%}")

# %% [markdown]
# Targets: what the patient's images would say, here the simulation at the truth, with the error of a measurement.

# %%
targets = lacli.Targets(tuple(measured), np.array(list(measured.values())), np.full(len(measured), 0.1))

# %% [markdown]
# What history matching leaves of the box, and the posterior there.

# %%
left = lacli.match(made.emulators, targets, box=box, count=1000, following=4, progress=say)
print(f"{left.match.share:.1%} of the box is not ruled out")

# %%
settings = lacli.types.SamplingSettings(ess=400.0, rhat=1.05)
answer = lacli.posterior(made.emulators, targets, folder / "posterior", box=box, settings=settings, progress=say)
for text in answer.warnings:
    print("warning:", text)
if answer.refused:
    raise SystemExit(answer.refused)
for row in answer.summary:
    name = row["input"]
    print(f"{name}: {row['mean']:.2f}, 95 % between {row['low95']:.2f} and {row['high95']:.2f}; true {truth[name]:.2f}")
