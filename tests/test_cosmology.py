from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from warmlens.cosmology import Cosmology, LensGeometry

COSMOLOGY = Cosmology()

# z, E, D, age [Gyr], Om(z): integrals done by hand for the paper's cosmology
BACKGROUND = [
    (0.0, 1.0, 1.0, 13.416, 0.315),
    (0.295, 1.170086, 0.855072, 10.021, 0.499671),
    (0.658, 1.456263, 0.710807, 7.330, 0.676994),
    (1.0, 1.790251, 0.606754, 5.685, 0.786271),
    (2.0, 3.031501, 0.417140, 3.183, 0.925462),
    (5.0, 8.290054, 0.211171, 1.138, 0.990033),
    (10.0, 20.49268, 0.115360, 0.459, 0.998369),
]


@pytest.mark.parametrize(("z", "expansion", "growth", "age", "matter"), BACKGROUND)
def test_background_matches_reference_values(z, expansion, growth, age, matter):
    assert COSMOLOGY.expansion(z) == pytest.approx(expansion, rel=1e-6)
    assert COSMOLOGY.growth(z) == pytest.approx(growth, rel=5e-6)
    assert COSMOLOGY.age(z) == pytest.approx(age, abs=6e-4)
    assert COSMOLOGY.matter_density(z) == pytest.approx(matter, rel=3e-6)


def test_densities_match_reference_values():
    assert COSMOLOGY.mean_density_msun_mpc3 == pytest.approx(4.19974e10, rel=1e-5)
    assert COSMOLOGY.critical_density(0.0) == pytest.approx(133.3252, rel=1e-5)
    assert COSMOLOGY.critical_density(0.295) == pytest.approx(182.5355, rel=1e-5)
    assert COSMOLOGY.virial_overdensity(0.295) == pytest.approx(126.863, abs=1e-3)
    assert COSMOLOGY.virial_overdensity(0.0) == pytest.approx(103.183, abs=1e-3)


def test_radius_200c_encloses_200_times_critical():
    radius = COSMOLOGY.radius_200c(1e13, 0.5)
    assert 1e13 / (4 / 3 * math.pi * radius**3) == pytest.approx(200 * COSMOLOGY.critical_density(0.5))


def test_clock_and_redshift_are_inverse():
    z = np.concatenate(([0.0], np.geomspace(1e-3, 100.0, 200)))
    clock = COSMOLOGY.collapse_clock(z)
    assert np.all(np.diff(clock) > 0)
    np.testing.assert_allclose(1 + COSMOLOGY.clock_to_redshift(clock), 1 + z, rtol=1e-6)


@pytest.mark.parametrize("clock", [1.0, np.nan, 1e6])
def test_clock_outside_of_history_is_an_error(clock):
    with pytest.raises(ValueError, match=r"clock must lie between 1\.686"):
        COSMOLOGY.clock_to_redshift(np.array([2.0, clock]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"H0": 0.0}, r"H0 must be finite and > 0, got 0\.0"),
        ({"sigma8": math.nan}, "sigma8 must be finite and > 0, got nan"),
        ({"Om0": 1.2}, r"Om0 must lie between Ob0 = 0\.049 and 1, got 1\.2"),
        ({"Ob0": 0.4}, "Om0 must lie between Ob0"),
    ],
)
def test_impossible_cosmology_is_an_error(change, message):
    with pytest.raises(ValueError, match=message):
        Cosmology(**change)


def test_geometry_of_the_paper():
    lens = LensGeometry.from_redshifts(COSMOLOGY, 0.295, 0.658)
    assert lens.d_lens_mpc == pytest.approx(914.220, rel=2e-6)
    assert lens.d_source_mpc == pytest.approx(1441.704, rel=2e-6)
    assert lens.d_lens_source_mpc == pytest.approx(727.642, rel=2e-6)
    assert lens.kpc_per_arcsec == pytest.approx(4.432263, rel=1e-6)
    assert lens.sigma_crit_msun_kpc2 == pytest.approx(3.60394e9, rel=1e-5)
    assert lens.sigma_crit_msun_arcsec2 == pytest.approx(7.07993e10, rel=1e-5)


def test_cylinder_of_the_papers_perturber():
    # Birrer et al. 2017, section 4.1: theta_E = 0.01", r_trunc = 0.1" hold 10^8.35 Msun in projection
    lens = LensGeometry.from_redshifts(COSMOLOGY, 0.295, 0.658)
    mass = math.pi * lens.sigma_crit_msun_arcsec2 * 0.01 * 0.1
    assert math.log10(mass) == pytest.approx(8.35, abs=5e-3)


@pytest.mark.parametrize(("z_lens", "z_source"), [(0.5, 0.5), (0.0, 1.0), (0.7, 0.3), (math.nan, 1.0)])
def test_impossible_redshifts_are_an_error(z_lens, z_source):
    with pytest.raises(ValueError, match="0 < z_lens < z_source"):
        LensGeometry.from_redshifts(COSMOLOGY, z_lens, z_source)


def test_import_leaves_slow_libraries_alone():
    code = (
        "import sys, warmlens.halos.lens_halo\n"
        "slow = {'astropy', 'colossus', 'lenstronomy', 'scipy.special'} & set(sys.modules)\n"
        "sys.exit(f'imported {sorted(slow)}' if slow else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
