from __future__ import annotations

import pytest

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.power_spectrum import cdm_power


@pytest.fixture(scope="session")
def cosmology():
    return Cosmology()


@pytest.fixture(scope="session")
def geometry(cosmology):
    return LensGeometry.from_redshifts(cosmology, 0.295, 0.658)


@pytest.fixture(scope="session")
def spectrum(cosmology):
    return cdm_power(cosmology)
