"""Simulators known exactly, in the shape of an EmulatorSet: closed-form posteriors need no fit."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from lacli.inference.emulation.scales import OutputScale


class ExactEmulators:
    """mean, variance: (m, d) -> (m, p)."""

    def __init__(self, d, p, mean, variance=None):
        self.inputs = tuple(f"x{i}" for i in range(d))
        self.outputs = tuple(f"y{j}" for j in range(p))
        self.mean, self.variance = mean, variance or (lambda x: np.zeros((len(x), p)))
        process = SimpleNamespace(theta=np.zeros(1), y=np.zeros(1), u=np.zeros((1, d)))
        entry = SimpleNamespace(
            log_inputs=np.zeros(d, bool), process=process, inflation=1.0, shift=0.0, scale=1.0, output_scale=OutputScale()
        )
        self.emulators = (entry,) * p
        self.log_share = np.zeros(d)
        self.d = d

    def content_digest(self):
        return f"exact {self.inputs} {self.outputs}"

    def predict(self, x):
        return self.mean(x), self.variance(x) + 1e-300

    def predict_truth(self, x):
        return self.predict(x)  # these runs have no error of their own

    def error_variance(self, j, x):
        return np.zeros(len(x))

    def predict_mean(self, x):
        return self.mean(x)

    def predict_one(self, j, x):
        mean, variance = self.predict(x)
        return mean[:, j], variance[:, j]

    def screen(self, j, x):
        mean, variance = self.predict_one(j, x)
        return mean, mean, variance, variance

    def range(self):
        return -np.ones(self.d), np.ones(self.d)
