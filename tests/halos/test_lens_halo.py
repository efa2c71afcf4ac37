from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from warmlens.halos.dark_matter import ThermalRelic
from warmlens.halos.lens_halo import MASS_BINS, VMAX_BINS, HaloGenerator, HaloModel
from warmlens.halos.profiles import nfw_norm, tnfw_total_mass

WHOLE_HALO_ARCSEC = 1e4


@pytest.fixture(scope="module")
def generator(cosmology, geometry):
    return HaloGenerator(cosmology, geometry, HaloModel(min_mass_msun=1e8))


def draw(generator, m_th_kev=math.inf, m_halo=1e13, half_width=WHOLE_HALO_ARCSEC, seed=1):
    return generator.draw(m_th_kev, m_halo, half_width, np.random.default_rng(seed))


def columns(realization):
    return vars(realization.subhalos)


def assert_identical(first, second):
    for name, values in columns(first).items():
        np.testing.assert_array_equal(values, columns(second)[name], err_msg=name)
    for field in dataclasses.fields(first):
        if field.name != "subhalos":
            np.testing.assert_array_equal(
                getattr(first, field.name), getattr(second, field.name), err_msg=field.name
            )


def test_same_seed_same_halo(generator, cosmology, geometry):
    other = HaloGenerator(cosmology, geometry, HaloModel(min_mass_msun=1e8))
    draw(other, m_th_kev=2.0)  # draws in between change nothing
    assert_identical(draw(generator), draw(other))
    assert draw(generator, seed=2).n_accreted != draw(generator).n_accreted


def test_global_random_state_is_neither_used_nor_changed(generator):
    np.random.seed(1)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first = draw(generator)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    assert_identical(first, draw(generator))


def test_limit_of_heavy_particles_is_cold_bit_by_bit(generator):
    assert_identical(draw(generator, m_th_kev=math.inf), draw(generator, m_th_kev=1e30))


def test_columns_are_consistent(generator):
    subhalos = draw(generator, m_th_kev=3.0).subhalos
    assert subhalos.m_bound.size > 50
    for name, values in vars(subhalos).items():
        assert values.dtype == np.float64, name
        assert values.shape == subhalos.m_bound.shape, name
        assert np.all(np.isfinite(values)), name
    assert np.all((subhalos.m_bound >= 1e8) & (subhalos.m_bound < subhalos.m_acc))
    assert np.all((subhalos.z_acc > 0.295) & (subhalos.z_acc < 20.0))
    assert np.all(subhalos.concentration >= 1.5)
    tau = subhalos.r_t_kpc / subhalos.r_s_kpc
    total = nfw_norm(subhalos.r_s_kpc, subhalos.rho_s) * tnfw_total_mass(tau)
    np.testing.assert_allclose(total, subhalos.m_bound, rtol=5e-6)


def test_counts_and_whole_halo_functions_are_consistent(generator):
    r = draw(generator)
    mass, v_max = r.subhalos.m_bound, r.subhalos.v_max_kms
    assert r.n_accreted == r.n_friction + r.n_stripped_below + r.n_surviving
    assert min(r.n_friction, r.n_stripped_below, r.n_surviving) > 0
    assert mass.size == r.n_surviving
    assert r.f_sub == pytest.approx(mass.sum() / 1e13)
    np.testing.assert_array_equal(r.cumulative_mass_function, [(mass > 10**b).sum() for b in MASS_BINS])
    np.testing.assert_array_equal(r.cumulative_vmax_function, [(v_max > b).sum() for b in VMAX_BINS])
    assert r.cumulative_mass_function[0] == r.n_surviving
    assert 0.295 < r.z_half < 20.0
    assert r.tree_steps > r.n_accreted


def test_field_cuts_out_of_the_same_halo(generator):
    whole, field = draw(generator), draw(generator, half_width=15.0)
    x, y = whole.subhalos.x_arcsec, whole.subhalos.y_arcsec
    inside = (np.abs(x) <= 15.0) & (np.abs(y) <= 15.0)
    assert 0 < inside.sum() < inside.size
    for name, values in columns(field).items():
        np.testing.assert_array_equal(values, columns(whole)[name][inside])
    np.testing.assert_array_equal(field.cumulative_mass_function, whole.cumulative_mass_function)


def test_all_subhalos_lie_within_the_host(generator, cosmology, geometry):
    subhalos = draw(generator).subhalos
    radius = cosmology.radius_200c(1e13, 0.295) / geometry.kpc_per_arcsec
    assert np.all(np.hypot(subhalos.x_arcsec, subhalos.y_arcsec) <= radius)


def test_field_without_subhalos_is_valid(generator):
    r = draw(generator, half_width=1e-6)
    assert r.n_surviving > 0
    assert all(values.shape == (0,) for values in columns(r).values())


def test_halo_that_accreted_nothing_is_valid(generator):
    r = draw(generator, m_th_kev=1.0, m_halo=8.2e8)  # 0.1% above twice the resolution
    assert r.n_accreted == r.n_friction == r.n_stripped_below == r.n_surviving == 0
    assert r.f_sub == 0.0
    assert r.z_half >= 0.295 * (1 - 1e-6)
    assert not r.cumulative_mass_function.any()


def test_early_subhalos_lie_deeper_in_the_host_at_infall(generator, cosmology, geometry):
    model = dataclasses.replace(generator.model, tau_dyn="jvdb16")
    host = HaloGenerator(cosmology, geometry, model)
    infall = HaloGenerator(cosmology, geometry, dataclasses.replace(model, positions="nfw_infall"))
    at_host, at_infall = draw(host).subhalos, draw(infall).subhalos
    np.testing.assert_array_equal(at_host.m_bound, at_infall.m_bound)  # only positions differ
    ratio = np.hypot(at_infall.x_arcsec, at_infall.y_arcsec) / np.hypot(at_host.x_arcsec, at_host.y_arcsec)
    early = at_host.z_acc > 1.0
    assert np.median(ratio[early]) < 0.6
    assert np.median(ratio[early]) < np.median(ratio[~early]) < 1.0


def test_calibrated_dynamical_time_strips_less(generator, cosmology, geometry):
    slower = HaloGenerator(cosmology, geometry, dataclasses.replace(generator.model, tau_dyn="jvdb16"))
    paper, jvdb16 = draw(generator), draw(slower)
    assert paper.n_accreted == jvdb16.n_accreted
    assert paper.n_friction == jvdb16.n_friction
    assert np.all(paper.cumulative_mass_function <= jvdb16.cumulative_mass_function)
    assert paper.f_sub < jvdb16.f_sub


def test_without_stripping_and_friction_everything_survives(generator, cosmology, geometry):
    model = dataclasses.replace(generator.model, stripping_amplitude=0.0, friction_amplitude=1e9)
    r = draw(HaloGenerator(cosmology, geometry, model))
    assert r.n_surviving == r.n_accreted
    np.testing.assert_allclose(r.subhalos.m_bound, r.subhalos.m_acc, rtol=1e-12)


def test_resolution_is_the_larger_of_floor_and_jeans_mass(generator):
    resolution = generator.population.resolution_msun
    assert resolution(generator.dark_matter(math.inf)) == 1e8
    assert resolution(generator.dark_matter(1.0)) == pytest.approx(4.094e8, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"m_th_kev": 0.0}, r"m_th_kev must be > 0 .*got 0\.0"),
        ({"m_th_kev": -2.0}, r"m_th_kev must be > 0 .*got -2\.0"),
        ({"m_th_kev": math.nan}, "m_th_kev must be > 0 .*got nan"),
        ({"m_halo": 0.0}, r"m_halo_msun must be finite and exceed 2e\+08 Msun.*got 0\.0"),
        ({"m_halo": math.nan}, "m_halo_msun must be finite and exceed .*got nan"),
        ({"m_halo": math.inf}, "m_halo_msun must be finite and exceed .*got inf"),
        ({"half_width": 0.0}, r"half_width_arcsec must be > 0, got 0\.0"),
        ({"half_width": math.nan}, "half_width_arcsec must be > 0, got nan"),
    ],
)
def test_impossible_arguments_are_errors(arguments, message, generator):
    with pytest.raises(ValueError, match=message):
        draw(generator, **arguments)


def test_limit_of_1_gev_is_cold_to_rounding_of_the_break(generator):
    # alpha k < 1e-4 at the smallest scale of the tables: r_T = 1 - 4e-9
    cold, heavy = draw(generator), draw(generator, m_th_kev=1e6)
    assert cold.n_accreted == heavy.n_accreted
    for name, values in columns(cold).items():
        np.testing.assert_allclose(columns(heavy)[name], values, rtol=1e-5, err_msg=name)


def test_any_dark_matter_can_be_drawn(generator, cosmology):
    relic = ThermalRelic(3.0, cosmology)
    general = generator.draw_model(relic, 1e13, WHOLE_HALO_ARCSEC, np.random.default_rng(1))
    assert_identical(draw(generator, m_th_kev=3.0), general)


def test_transfer_function_of_the_model_is_that_of_its_relics(generator, cosmology, geometry):
    model = dataclasses.replace(generator.model, transfer_function="vogel23")
    other = HaloGenerator(cosmology, geometry, model)
    assert other.dark_matter(3.0) == ThermalRelic(3.0, cosmology, "vogel23")
    assert draw(other, m_th_kev=3.0).n_accreted != draw(generator, m_th_kev=3.0).n_accreted
    assert_identical(draw(other), draw(generator))  # cold dark matter has none


def test_sky_positions_are_projected_radii(generator, geometry):
    r = draw(generator)
    halo = generator.population.draw(generator.dark_matter(math.inf), 1e13, np.random.default_rng(1))
    np.testing.assert_array_equal(r.subhalos.m_bound, halo.m_bound)
    distance = np.hypot(r.subhalos.x_arcsec, r.subhalos.y_arcsec) * geometry.kpc_per_arcsec
    assert np.all(distance <= halo.radius_kpc * (1 + 1e-12))
    assert r.f_sub == halo.f_sub
