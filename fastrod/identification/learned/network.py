"""The paper's mismatch network, kept apart: what a network can still predict of what the physics leaves.
Never part of "after"."""

from __future__ import annotations

import numpy as np

from fastrod.errors import InputError
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.report.result import Result
from fastrod.identification.search.residual_test import features
from fastrod.model.routing import Routing

_LAYERS = (32, 32)


def check_network() -> None:
    """Raise `InputError` where scikit-learn is not installed."""
    try:
        import sklearn.neural_network  # noqa: F401
    except ImportError as error:
        raise InputError(
            "the residual network needs scikit-learn; install fastrod[network], or leave --network out."
        ) from error


def residual_network(samples: LogSamples, wiring: Routing, result: Result) -> dict[str, float]:
    """Train on the residual after the named effects, test on the samples held out: distance rms with it [m],
    and its input count.

    Inputs are those of the audit without time: present inputs, plays, lags, velocities. Raises `InputError`
    without scikit-learn.
    """
    check_network()
    from sklearn.neural_network import MLPRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    every = samples.on(np.arange(len(samples.log)))
    static, memory, _ = features(every, wiring)
    inputs = np.concatenate([static, memory], axis=1)
    residual = result.residual_after
    train = result.used & np.isfinite(residual).all(1)
    test = result.tested & ~result.outlier & np.isfinite(residual).all(1)
    scale = float(residual[train].std())
    model = make_pipeline(
        StandardScaler(),
        MLPRegressor(
            hidden_layer_sizes=_LAYERS, alpha=1e-2, early_stopping=True, max_iter=300, random_state=0
        ),
    )
    model.fit(inputs[train], residual[train] / scale)
    left = residual[test] - scale * model.predict(inputs[test])
    return {"held_out_rms_m": float(np.sqrt((left**2).sum(1).mean())), "inputs": float(inputs.shape[1])}
