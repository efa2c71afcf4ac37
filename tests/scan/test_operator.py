"""Operator: the folded form against docs/scan.md's formulas written out with dense matrices."""

import dataclasses

import numpy as np
import pytest

from warmlens.imaging.shapelets import ShapeletSet, basis


@pytest.fixture(scope="module")
def dense_whitened_psf(band):
    """W P [npix, npix]."""
    identity = np.eye(band.weights.size).reshape(-1, *band.grid.shape)
    return (band.weights * band.convolution.forward(identity)).reshape(-1, band.weights.size).T


def unpack(shard, position):
    m = np.diff(shard.pixel_offsets)[position]
    packed = shard.matrices[shard.matrix_offsets[position] : shard.matrix_offsets[position + 1]]
    matrix = np.zeros((2 * m, 2 * m))
    matrix[np.tril_indices(2 * m)] = packed
    return matrix + np.tril(matrix, -1).T


def changed_basis(band, center, pixels):
    """dB at the pixels, from the basis at single rays."""
    rays = band.rays
    change = np.zeros((pixels.size, band.model.n_source))
    for sub in range(rays.theta_x.shape[1]):
        x, y = rays.source_x[pixels, sub], rays.source_y[pixels, sub]
        alpha_x, alpha_y = band.perturber.deflection(
            rays.theta_x[pixels, sub] - center[0], rays.theta_y[pixels, sub] - center[1]
        )
        change += basis(band.sets, x - alpha_x, y - alpha_y) - basis(band.sets, x, y)
    return change / rays.theta_x.shape[1]


def test_projection_is_the_factor_times_the_design(band, dense_whitened_psf):
    G = band.model.inverse_factor @ band.model.design.T @ dense_whitened_psf
    np.testing.assert_allclose(band.projection.projected, G.T, rtol=0, atol=1e-9 * np.abs(G).max())


def test_overlap_table_holds_products_of_whitened_psfs(band, dense_whitened_psf):
    S = dense_whitened_psf.T @ dense_whitened_psf
    ny, nx = band.grid.shape
    overlap = band.projection.overlap
    span = overlap.shape[0] - 1
    assert span >= 8  # two pixels moved by one perturber can be 0.4" apart
    rng = np.random.default_rng(2)
    for i in rng.integers(0, ny * nx, 200):
        dy, dx = rng.integers(0, span + 1), rng.integers(-span, span + 1)
        row, column = i // nx + dy, i % nx + dx
        if row < ny and 0 <= column < nx:
            assert overlap[dy, dx + span, i] == pytest.approx(S[i, row * nx + column], abs=1e-12 * S.max())


def test_matrices_fold_the_formulas_of_the_note(band, shard, raster, dense_whitened_psf):
    """-2 t.delta + delta.S delta - q.H q with S, Y, Z, Gam, T, H, q as written in docs/scan.md."""
    model = band.model
    rng = np.random.default_rng(3)
    checked = 0
    for position, center in enumerate(raster.coordinates()):
        pixels = shard.pixels[shard.pixel_offsets[position] : shard.pixel_offsets[position + 1]]
        if pixels.size == 0 or position % 5:
            continue
        m = pixels.size
        U = dense_whitened_psf[:, pixels]
        S = U.T @ U
        dB = np.zeros((m, model.design.shape[1]))
        dB[:, : model.n_source] = changed_basis(band, center, pixels) / model.column_norms[: model.n_source]
        Y = model.inverse_factor @ dB.T
        Z = np.hstack([model.inverse_factor @ model.design.T @ U, Y])
        Gam = Z.T @ Z
        eye = np.eye(m)
        T = np.linalg.inv(np.block([[-S, eye], [eye, np.zeros((m, m))]]) + Gam)
        H = Gam - Gam @ T @ Gam
        delta, t = rng.normal(size=m) / np.sqrt(S.max()), rng.normal(size=m) * np.sqrt(S.max())
        q = np.concatenate([-delta, t - S @ delta])
        expected = -2.0 * t @ delta + delta @ S @ delta - q @ H @ q
        v = np.concatenate([delta, t])
        assert v @ unpack(shard, position) @ v == pytest.approx(expected, rel=1e-7)
        checked += 1
    assert checked > 10


def test_positions_that_move_nothing_unmasked(band):
    x, y = band.grid.to_sky(np.array([6.0, 6.0, 15.0]), np.array([26.0, 10.0, 200.0]))
    positions = np.stack([x, y], axis=1)  # deep in the mask, on the image, off the image
    result = band.shard(positions)
    counts = np.diff(result.pixel_offsets)
    assert counts[0] == counts[2] == 0
    assert counts[1] > 40
    np.testing.assert_array_equal(np.diff(result.matrix_offsets), counts * (2 * counts + 1))
    assert result.matrices.size == result.matrix_offsets[-1]
    nothing = band.shard(positions[[0, 2]])
    assert nothing.pixels.size == nothing.matrices.size == 0


def test_shards_put_together_are_the_whole(band, shard, raster):
    """A position's operator does not depend on its shard."""
    parts = [band.shard(raster.coordinates()[a:b]) for a, b in ((0, 1), (1, 50), (50, raster.n_positions))]
    np.testing.assert_array_equal(np.concatenate([part.pixels for part in parts]), shard.pixels)
    together = np.concatenate([part.matrices for part in parts])
    for first, last in zip(shard.matrix_offsets[:-1], shard.matrix_offsets[1:], strict=True):
        if last > first:
            scale = np.abs(shard.matrices[first:last]).max()
            np.testing.assert_allclose(
                together[first:last], shard.matrices[first:last], rtol=0, atol=1e-10 * scale
            )


def test_other_basis_than_the_model_is_refused(band):
    with pytest.raises(ValueError, match=r"10 functions.*24 source columns.*source\.n_max"):
        dataclasses.replace(band, sets=(ShapeletSet(3, 0.1, 0.0, 0.0),))


def test_bad_positions_are_refused(band):
    with pytest.raises(ValueError, match="positions"):
        band.shard(np.array([[0.0, np.nan]]))
    with pytest.raises(ValueError, match="positions"):
        band.shard(np.zeros(2))


def test_operator_is_frozen(shard):
    with pytest.raises(AttributeError):
        shard.pixels = shard.pixels
