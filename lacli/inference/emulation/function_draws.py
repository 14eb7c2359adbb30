"""Functions drawn from an emulator's distribution, evaluated anywhere: a prior draw corrected by the data.

Pathwise conditioning (Wilson et al. 2020): prior draw from random Fourier features of the squared-exponential kernel,
plus the exact kernel's correction towards the runs; the linear mean is refitted for each draw, which carries its own
uncertainty under the flat prior.
"""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.inference.emulation import gp
from lacli.inference.emulation.emulator import Emulator
from lacli.inference.emulation.gradient_process import GradientGP

_FEATURES = 512
# functions drawn with one set of hyperparameters
_EACH = 4


def draw_functions(emulator: Emulator, x: FloatArray, draws: int, seed: int) -> FloatArray:
    """Values (m, draws) at x (m, d) of functions drawn from the emulator (without nugget), in the output's units.

    The hyperparameters are drawn too: at fixed ones an input that the fit calls inactive moves no function, and an index
    near zero would be far more certain than it is.
    """
    rng = np.random.default_rng(seed)
    fitted = emulator.process
    groups = -(-draws // _EACH)
    u = emulator.to_u(x)
    values = []
    for i, theta in enumerate(gp.plausible_thetas(fitted, groups, rng)):
        process = gp.condition(theta, fitted.u, fitted.y, fitted.noise)
        values.append(_draw(process, u, min(_EACH, draws - i * _EACH), emulator.inflation, rng))
    return emulator.output_scale.backward(emulator.shift + emulator.scale * np.hstack(values))


def _draw(g: gp.GP, at: FloatArray, draws: int, inflation: float, rng: np.random.Generator) -> FloatArray:
    """Values (m, draws) of the process at ``at`` (m, d), its coordinates; deviations from the mean widened by inflation."""
    d = g.u.shape[1]
    omega = rng.standard_normal((d, _FEATURES)) / g.lengths[:, None]
    phase = rng.uniform(0.0, 2.0 * np.pi, _FEATURES)
    weights = rng.standard_normal((_FEATURES, draws))
    amplitude = np.sqrt(2.0 * g.s2 / _FEATURES)
    noise = np.sqrt(g.nugget + g.noise)[:, None] * rng.standard_normal((len(g.y), draws))

    def prior(u: FloatArray) -> FloatArray:
        return amplitude * (np.cos(u @ omega + phase) @ weights)

    residual = g.y[:, None] - prior(g.u) - noise
    beta = g.c.T @ (g.c @ (g.g @ residual))
    solved = g.inverse_factor.T @ (g.inverse_factor @ (residual - gp.basis(g.u) @ beta))
    values = np.empty((len(at), draws))
    z = g.u / g.lengths
    for begin in range(0, len(at), 2048):
        u = at[begin : begin + 2048]
        zs = u / g.lengths
        k = g.s2 * np.exp(np.minimum(zs @ z.T - 0.5 * (zs**2).sum(1)[:, None] - 0.5 * (z**2).sum(1), 0.0))
        h = gp.basis(u)
        mean = h @ g.beta + k @ g.alpha
        draw = prior(u) + h @ beta + k @ solved
        values[begin : begin + 2048] = mean[:, None] + np.sqrt(inflation) * (draw - mean[:, None])
    return values


def draw_process(g: GradientGP, at: FloatArray, draws: int, inflation: float, rng: np.random.Generator) -> FloatArray:
    """Values (m, draws) at ``at`` (m, d), the process's coordinates, of functions drawn from a process that has learnt from
    derivatives; deviations from the mean widened by inflation. As ``_draw``: a prior draw has derivatives of its own."""
    data, d = g.data, g.data.u.shape[1]
    omega = rng.standard_normal((d, _FEATURES)) / g.lengths[:, None]
    if g.kind == "matern52":  # its spectral density is Student's with five degrees of freedom
        omega *= np.sqrt(5.0 / rng.chisquare(5, _FEATURES))
    phase = rng.uniform(0.0, 2.0 * np.pi, _FEATURES)
    weights = rng.standard_normal((_FEATURES, draws)) * np.sqrt(2.0 * g.s2 / _FEATURES)
    angle = data.u @ omega + phase
    prior = np.stack([np.cos(angle) @ weights, *(-(np.sin(angle) * omega[j]) @ weights for j in data.active)])[data.rows]
    noise = np.sqrt(g.noise())[:, None] * rng.standard_normal((len(g.alpha), draws))
    residual = data.observed[data.rows][:, None] - prior - noise
    beta = g.c.T @ (g.c @ (g.g @ residual))
    solved = g.inverse_factor.T @ (g.inverse_factor @ (residual - data.basis() @ beta))
    values = np.empty((len(at), draws))
    for begin in range(0, len(at), 512):
        u = at[begin : begin + 512]
        k, h = g.covariances(u), gp.basis(u)
        mean = (h @ g.beta + k @ g.alpha)[:, None]
        draw = np.cos(u @ omega + phase) @ weights + h @ beta + k @ solved
        values[begin : begin + 512] = mean + np.sqrt(inflation) * (draw - mean)
    return values
