"""The posterior as a file that ArviZ reads (``arviz.from_netcdf``)."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from lacli.base import quiet
from lacli.base.files import replacing
from lacli.inference.sampling.posterior import Chain


def write_inference_data(path: Path, chain: Chain) -> None:
    """NetCDF with groups posterior and sample_stats; each walker after the first tenth is a chain, and the coordinate
    ``ensemble`` of both says to which independent ensemble it belongs: walkers of one are not independent of each other, so that
    R-hat is over ensembles. NetCDF has no slash in names: ``kPa/mm`` is
    ``kPa per mm`` there."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        arviz = quiet.arviz()
        kept = chain.samples[chain.steps // 10 :]
        steps, ensembles, walkers, d = kept.shape
        by_walker = kept.reshape(steps, ensembles * walkers, d).transpose(1, 0, 2)
        log_prob = chain.log_prob[chain.steps // 10 :].reshape(steps, -1).T
        data = arviz.from_dict(
            posterior={name.replace("/", " per "): by_walker[..., i] for i, name in enumerate(chain.names)},
            sample_stats={"lp": log_prob},
        )
        ensemble = np.arange(ensembles * walkers) // walkers
        for name in ("posterior", "sample_stats"):
            data[name] = data[name].assign_coords(ensemble=("chain", ensemble))
        data.sample_stats.attrs["walkers_in_each_ensemble"] = walkers
        with replacing(path) as temporary:
            data.to_netcdf(str(temporary), engine="h5netcdf")
