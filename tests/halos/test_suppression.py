from __future__ import annotations

import numpy as np
import pytest

from warmlens.halos.suppression import lovell14, lovell20

M_HM = 2.057e9  # 2 keV


@pytest.mark.parametrize("fit", [lovell14, lovell20])
def test_limits(fit) -> None:
    mass = np.geomspace(1e5, 1e15, 200)
    ratio = fit(mass, M_HM)
    assert np.all(np.diff(ratio) > 0.0)
    assert ratio[-1] == pytest.approx(1.0, abs=1e-4)
    assert np.all(fit(mass, 0.0) == 1.0)  # cold


def test_values_at_2_kev() -> None:
    mass = 10 ** np.array([8.25, 9.25, 10.25])
    np.testing.assert_allclose(lovell14(mass, M_HM), [0.032, 0.25, 0.76], atol=0.01)
    np.testing.assert_allclose(lovell20(mass, M_HM), [0.14, 0.45, 0.97], atol=0.01)
