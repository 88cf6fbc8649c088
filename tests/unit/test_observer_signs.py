"""A sample of what `make mutate` does to the whole observer: every sign of some kernels turned around, each noticed by the oracle."""

import importlib
import types

import numpy as np

from mavquad.estimate import gsmo_implicit, lie
from tests.observer_signs import mutants
from tests.oracles import rates
from tests.unit.test_gsmo_oracle import A0, A1, A2, GYRO, I1, I2, H, Q, W

T, K1, K2, L = 0.02, 3.0, 7.0, 5.0
ERRORS = (0.3, -0.2, 3e-6, -2e-6)


def flat(found):
    return np.concatenate([np.ravel(x) for x in found])


def one_axis(function):
    kinds = (gsmo_implicit.RELAY, gsmo_implicit.SUPER_TWISTING, gsmo_implicit.THIRD_ORDER)
    return flat([function(kind, K1, K2, L, b, T) for kind in kinds for b in ERRORS])


def one_axis_expected():
    def relay(b):
        sigma = np.clip(b / (T * (K1 + T * K2)), -1, 1)
        return b - T * (K1 + T * K2) * sigma, T * K2 * sigma, 0.0

    ways = (relay, lambda b: rates.super_twisting(b, T, K1, K2), lambda b: rates.third_order(b, T, L))
    return flat([way(b) for way in ways for b in ERRORS])


def vectors(*values):
    return [np.array(v) for v in values]


KERNELS = {
    "gsmo_implicit.correct_axis": (one_axis, one_axis_expected),
    "lie.step_1": (
        lambda f: flat(f(lie.CAYLEY, GYRO, Q, W, A0, I1, I2, H)),
        lambda: flat(rates.lie_euler(GYRO, *vectors(Q, W, A0, I1, I2), H)),
    ),
    "lie.step_4": (
        lambda f: flat(f(GYRO, Q, W, A0, A1, A2, I1, I2, H)),
        lambda: flat(rates.classical(GYRO, *vectors(Q, W, A0, A1, A2, I1, I2), H)),
    ),
    "lie.dcay_inv": (lambda f: flat([f(I1, W, 0.5)]), lambda: flat([rates.dcay_inverse(I1, W)])),
}


def noticed(call, wrong, expected):
    """Another result, or a root of something negative."""
    try:
        return not np.allclose(call(wrong), expected, rtol=0.0, atol=1e-9)
    except ValueError:
        return True


def test_every_sign_of_some_kernels_is_noticed_when_it_is_turned_around():
    turned = 0
    for short, (call, expected) in KERNELS.items():
        module = importlib.import_module(f"mavquad.estimate.{short.partition('.')[0]}")
        right = getattr(module, short.partition(".")[2])
        np.testing.assert_allclose(call(right), expected(), atol=1e-12)
        for mutant in mutants(module.__name__):
            if mutant.name() != short:
                continue
            code = compile(mutant.tree, module.__name__, "exec")
            inner = next(c for c in code.co_consts if getattr(c, "co_name", "") == mutant.where)
            wrong = types.FunctionType(inner, vars(module))
            assert noticed(call, wrong, expected()), f"{short}: {mutant.changed}"
            turned += 1
    assert turned > 30
