"""Where every artifact of a campaign lies under its results folder."""

from __future__ import annotations

from pathlib import Path

from warmlens.artifacts.names import CHUNKED, NULL, SINGLE
from warmlens.config.model import MAX_IN_FILE_NAMES, MAX_PORTIONS, Config
from warmlens.config.types import ConfigError
from warmlens.sampling import Span, chunk_spans, shard_spans, span_name
from warmlens.scan.raster import Raster


def chunks(config: Config) -> list[Span]:
    """Spans of samples, one a chunk."""
    return chunk_spans(config.campaign.n_samples, config.campaign.chunk_size)


def shards(config: Config) -> list[Span]:
    """Spans of scan positions, one a shard of the operator."""
    n_positions, size = _n_positions(config), config.scan.shard_size
    if n_positions > MAX_IN_FILE_NAMES or n_positions > size * MAX_PORTIONS:
        raise ConfigError(
            [
                f"scan: {n_positions} positions in shards of {size}; at most are {MAX_IN_FILE_NAMES} positions "
                f"and {MAX_PORTIONS} shards; raise step_arcsec or shard_size, or narrow the window"
            ]
        )
    return shard_spans(n_positions, size)


def _n_positions(config: Config) -> int:
    scan = config.scan
    if scan.window_arcsec is not None:
        return Raster(*scan.window_arcsec, scan.step_arcsec, scan.center).n_positions
    # Without a window the raster follows the masks, which are in the images themselves.
    from warmlens.products.images import planned_mask

    grid, mask = planned_mask(config.observation)
    return Raster.around(mask, grid, scan.step_arcsec).n_positions


def stage_files(config: Config, stage: str) -> list[Path]:
    """All artifacts of one stage; none of a null test that is switched off."""
    root = Path(config.results)
    if stage in NULL and not config.null_test.n_mocks:
        return []
    if stage in SINGLE:
        return [root / SINGLE[stage]]
    if stage == "scan_operator":
        return [root / f"scan_operator/shard-{span_name(span)}.h5" for span in shards(config)]
    if stage in CHUNKED:
        return [root / f"{stage}/chunk-{span_name(span)}.h5" for span in chunks(config)]
    raise ValueError(f"unknown stage {stage!r}")
