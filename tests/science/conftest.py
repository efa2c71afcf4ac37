"""The independent code for the background and the power spectrum."""

from __future__ import annotations

from typing import Any

import pytest

from warmlens.cosmology import Cosmology


@pytest.fixture(scope="session")
def peer() -> Any:
    """colossus with the cosmology of the paper, without its global state and its disk cache."""
    from colossus.cosmology.cosmology import Cosmology as Peer

    ours = Cosmology()
    return Peer(
        name="peer",
        flat=True,
        H0=ours.H0,
        Om0=ours.Om0,
        Ob0=ours.Ob0,
        sigma8=ours.sigma8,
        ns=ours.ns,
        Tcmb0=ours.Tcmb0,
        relspecies=False,
        persistence="",
        power_law=False,
    )
